"""Mistakes that no setting mends: mirrored depth, transposed rotations, quaternions in the other order, ...

Each is assessed as another convention is (`geometry`): by the error of depth that is reprojected as if it were mended.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import Convention
from semstab.check.geometry import GOOD, LEAST_PAIRS, WON_PAIRS, Fit, Verdict, fits_of, pairs_won
from semstab.check.quaternions import first_number_last, last_number_first
from semstab.check.reprojection import Sample, View
from semstab.core.types import Float64
from semstab.datasets.geometry.cameras import CAMERA_AXES

BETTER = 0.5
"""A mistake is named where its mend leaves at most this part of the error; files have to be written anew for it."""

LEAST_FOCAL = 8.0
"""Pixels; a shorter focal length is one divided by the image's size."""


def _in_pixels_already(view: View) -> bool:
    return bool(view.camera.fx >= LEAST_FOCAL)


def _is_off_centre(view: View) -> bool:
    """Return whether cx and cy may be exchanged: each is nearer to the middle of the other side."""
    (W, H), K = view.size, view.camera
    return abs(K.cx - H / 2) + abs(K.cy - W / 2) < abs(K.cx - W / 2) + abs(K.cy - H / 2)


@dataclass(frozen=True)
class Mistake:
    """A mistake of a scene's files.

    Attributes:
        name: What it is.
        mended: From a view as it is read to the view as it would be.
        mend: What to do about it.
        applies: Whether it can be, by a view.
    """

    name: str
    mended: Callable[[View, Convention], View]
    mend: str
    applies: Callable[[View], bool] = _in_pixels_already


def _mirrored(*axes: int) -> Callable[[View, Convention], View]:
    """Return how to read images mirrored along axes: 0 upside down, 1 left to right."""

    def mended(view: View, _: Convention) -> View:
        places, camera, principal = [view.v, view.u], view.camera, [view.camera.cy, view.camera.cx]
        for axis in axes:
            last = view.depth.shape[axis] - 1
            places[axis] = last - places[axis]
            principal[axis] -= view.size[1 - axis] - 1 - last * view.stride  # the first sampled pixel is not the first
        cy, cx = principal
        return dataclasses.replace(
            view, depth=np.flip(view.depth, axes), camera=dataclasses.replace(camera, cx=cx, cy=cy),
            v=places[0], u=places[1],
        )  # fmt: skip

    return mended


def _of_file(change: Callable[[Float64], Float64]) -> Callable[[View, Convention], View]:
    """Return how to read poses whose matrices in the file, (4, 4), would be others."""

    def mended(view: View, configured: Convention) -> View:
        file = view.T_wc.copy()
        file[:3, :3] = file[:3, :3] @ CAMERA_AXES[configured.axes].T
        inverse = configured.pose == "world_to_camera"
        file = change(np.linalg.inv(file).astype(np.float64) if inverse else file)
        pose = np.linalg.inv(file).astype(np.float64) if inverse else file
        pose[:3, :3] = pose[:3, :3] @ CAMERA_AXES[configured.axes]
        return dataclasses.replace(view, T_wc=pose)

    return mended


def _transposed(file: Float64) -> Float64:
    changed = file.copy()
    changed[:3, :3] = file[:3, :3].T
    return changed


def _in_pixels(view: View, _: Convention) -> View:
    (W, H), camera = view.size, view.camera
    fx, cx, fy, cy = camera.fx * W, camera.cx * W, camera.fy * H, camera.cy * H
    return dataclasses.replace(view, camera=dataclasses.replace(camera, fx=fx, fy=fy, cx=cx, cy=cy))


def _exchanged(view: View, _: Convention) -> View:
    camera = dataclasses.replace(view.camera, cx=view.camera.cy, cy=view.camera.cx)
    return dataclasses.replace(view, camera=camera)


ONE = np.array([1.0])
ANEW = "no setting mends it: write the files anew"
OR_LEFT_HANDED = f"{ANEW}, or convert the poses where these are left-handed (Unity, Unreal), which looks alike"
MISTAKES = (
    Mistake("depth images mirrored left to right", _mirrored(1), OR_LEFT_HANDED),
    Mistake("depth images upside down", _mirrored(0), OR_LEFT_HANDED),
    Mistake("depth images turned by 180 degrees", _mirrored(0, 1), ANEW),
    Mistake("poses with transposed rotations", _of_file(_transposed), "transpose the rotation (3, 3) of each"),
    Mistake("quaternions w x y z that are read as x y z w", _of_file(first_number_last), "write them as x y z w"),
    Mistake("quaternions x y z w that are read as w x y z", _of_file(last_number_first), "write them as w x y z"),
    Mistake(
        "intrinsics with cx and cy exchanged",
        _exchanged,
        "exchange them",
        lambda view: _in_pixels_already(view) and _is_off_centre(view),
    ),
    Mistake(
        "intrinsics as shares of the image's size",
        _in_pixels,
        "multiply fx and cx by its width, fy and cy by its height",
        lambda view: not _in_pixels_already(view),
    ),
)


def with_mistakes(verdict: Verdict, sample: Sample) -> Verdict:
    """Return the verdict, or that the files hold a mistake, where depth agrees far better without it."""
    if not sample.views or not sample.pairs or not verdict.fits:
        return verdict
    configured, tried = verdict.fits[0][1], list[tuple[Fit, Sample, Mistake]]()
    for mistake in MISTAKES:
        if all(mistake.applies(view) for view in sample.views.values()):
            views = {position: mistake.mended(view, sample.configured) for position, view in sample.views.items()}
            mended = dataclasses.replace(sample, views=views)
            (fit,) = fits_of(mended, sample.configured, ONE)
            tried.append((fit, mended, mistake))
    fit, mended, best = min(tried, key=lambda each: (not each[0].has_evidence, each[0].error))
    others = [other for _, other in verdict.fits if other.has_evidence]
    if not fit.has_evidence or fit.error > GOOD or not all(fit.clearly_beats(other) for other in others):
        return verdict
    if configured.has_evidence:
        errors = (each.errors(sample.configured, ONE) for each in (mended, sample))
        won = pairs_won(*errors)
        if fit.error > BETTER * configured.error or len(won) < LEAST_PAIRS or np.mean(won) < WON_PAIRS:
            return verdict
    now = f"reprojects with {configured.error:.1%} error" if configured.has_evidence else "hardly reprojects at all"
    text = f"{best.name}, as it seems: depth {now}, but with {fit.error:.2%} without this mistake; {best.mend}"
    return dataclasses.replace(
        verdict, state="unsound", text=text, mend=(), undetermined=(), reason="",
        fits=(verdict.fits[0], (f"without {best.name}", fit), *verdict.fits[1:]),
    )  # fmt: skip
