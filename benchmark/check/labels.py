"""A check of label maps against depth, colour and each other: do they belong to these frames, and are they ids?

Each alternative reading of the files (another frame's map, mirrored, turned, of a part of the image) is compared with
the given one by two numbers: the correlation of the labels' edges with those of depth and colour, frame by frame, and
the agreement of labels that are reprojected from frame to frame, pair by pair.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.check.chain import Chain
from semstab.check.continuity import Neighbours
from semstab.check.conventions import reading
from semstab.check.label_ids import id_remarks, remarks_on_maps, wrong_ids
from semstab.check.label_maps import IN_A_RUN, STEPS, LabelRun, readable, runs_of, shifted
from semstab.check.label_order import ORDER_PIXELS, QUICK_PIXELS, from_a_frame_on, in_another_order
from semstab.check.reprojection import reader
from semstab.check.trials import BETTER_FIT, LEAST_TOLD, FitContrast, Hypothesis
from semstab.data.labels import LabelSpace
from semstab.datasets import Scene
from semstab.errors import DataError

FEWER = 0.85
"""The part of the disagreement that remains where an alternative is better, if its edges do not tell."""

LABEL_RUNS = 6
"""Number of runs of five frames in which label maps are compared with depth, colour and each other."""

FIRST_RUNS = 2
"""Runs of frames that are read first."""

TELLING = 0.9
"""An alternative whose edges fit this part as well as the given ones cannot be told from them."""

MOST_OPEN = 2
"""Alternatives that are named where they cannot be told from the given maps; of more the reason is said."""


Ordered = Mapping[str, tuple[Neighbours, Chain]]
"""Frames in order, by the model whose labels they have."""


@dataclass(frozen=True)
class LabelFindings:
    """The result for one model.

    Attributes:
        wrong: Lines on label maps that do not belong to the frames as they are, each with the mend.
        remarks: Lines on ids that look wrong, but may be right.
        open: Line on what these frames cannot tell, or None.
    """

    model: str
    wrong: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    open: str | None = None


# --- the comparison --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Comparison:
    """An alternative with what speaks for it: edges frame by frame, agreement pair by pair."""

    hypothesis: Hypothesis[LabelRun]
    edges: FitContrast
    agreement: FitContrast

    @property
    def is_better(self) -> bool:
        """Return whether one measure is clearly better, and the other is not worse."""
        edges, agreement = self.edges, self.agreement
        by_edges = edges.fits_better
        by_agreement = agreement.is_clear and 1 - agreement.other <= FEWER * (1 - agreement.given)
        if by_edges:
            return by_agreement or not agreement.other < agreement.given - 0.01
        return by_agreement and not edges.other < edges.given

    @property
    def is_doubt(self) -> bool:
        """Return whether the alternative fits better, clearly or not."""
        return self.edges.other >= BETTER_FIT * self.edges.given

    @property
    def is_open(self) -> bool:
        """Return whether edges fit about as well under the alternative, so that nothing is told."""
        return not self.edges.other < TELLING * self.edges.given

    def __str__(self) -> str:
        text = (
            f"their edges correlate {self.edges.other:.2f} with those of depth and colour, {self.edges.given:.2f} now"
        )
        if math.isfinite(self.agreement.other):
            text += f"; {self.agreement.other:.0%} agree between frames, {self.agreement.given:.0%} now"
        return f"{self.hypothesis.name} ({text}): {self.hypothesis.mend}"


def compare(runs: Sequence[LabelRun]) -> list[Comparison]:
    """Compare every hypothesis with the maps as they are."""
    trials = zip(*(run.tried for run in runs), strict=True)
    return [_compared(tried[0][0], runs, [other for _, other in tried]) for tried in trials]


def counted(found: Comparison, runs: Sequence[LabelRun]) -> Comparison:
    """Return the comparison with maps as many frames late, or early, as fit best, where one of these was found."""
    if (step := STEPS.get(found.hypothesis.name)) is None:
        return found
    hypotheses = [shifted(count if step > 0 else -count) for count in range(1, IN_A_RUN)]
    compared = [_compared(hypothesis, runs, [hypothesis.change(run) for run in runs]) for hypothesis in hypotheses]
    return max(
        compared, key=lambda comparison: -math.inf if math.isnan(comparison.edges.other) else comparison.edges.other
    )


def _compared(
    hypothesis: Hypothesis[LabelRun], runs: Sequence[LabelRun], changed_runs: Sequence[LabelRun]
) -> Comparison:
    pairs = [*zip(runs, changed_runs, strict=True)]
    fits = [row[1:] for run, other in pairs for row in run.by_frame(other)]
    return Comparison(
        hypothesis, _contrast(fits), _contrast([pair for run, other in pairs for pair in run.by_pair(other)])
    )


def _contrast(rows: Sequence[tuple[float, float]]) -> FitContrast:
    return FitContrast.between(*np.reshape(rows, (-1, 2)).T)


# --- findings --------------------------------------------------------------------------------------------------------


def check_labels(
    scene: Scene,
    indices: Sequence[int],
    model: str,
    space: LabelSpace | None,
    runs: int,
    *,
    thorough: bool = True,
) -> LabelFindings:
    """Compare the label maps of a model with depth, colour and each other, in `runs` times five frames.

    Two of them come first; the others are read where these do not show that the maps are right, or, unless `thorough`,
    where they fit better another way. Then frames are read to find maps in another order. Frames
    that cannot be read are passed over.
    """
    runs_read = dict[int, LabelRun]()
    few = _findings(scene, indices, model, space, min(runs, FIRST_RUNS), runs_read)
    if few.clear or not (thorough or few.doubted):
        return few.found
    all_findings = _findings(scene, indices, model, space, runs, runs_read)
    if all_findings.clear or all_findings.found.wrong:
        return all_findings.found
    pixels = ORDER_PIXELS if thorough else QUICK_PIXELS
    if (other := in_another_order(scene, indices, model, pixels)) is None:
        return all_findings.found
    return dataclasses.replace(all_findings.found, wrong=(f"labels of {model} {other}",), open=None)


@dataclass(frozen=True)
class _Findings:
    """Findings of some runs of frames.

    Attributes:
        clear: Whether maps as they are fit clearly better than any other way.
        doubted: Whether another way fits better, however few frames show it.
    """

    found: LabelFindings
    clear: bool = False
    doubted: bool = False


def _findings(
    scene: Scene,
    indices: Sequence[int],
    model: str,
    space: LabelSpace | None,
    count: int,
    runs_read: dict[int, LabelRun],
) -> _Findings:
    """Return what some runs show; those that are read are kept in `runs_read`, by their first frames."""
    frame_runs = runs_of(scene, indices, model, count)
    for run in frame_runs:
        if run[0] not in runs_read:
            runs_read[run[0]] = LabelRun([*readable(scene, run, model)])
    runs = [runs_read[run[0]] for run in frame_runs if len(runs_read[run[0]].frames) > 1]
    frames = [frame for run in runs for frame in run.frames]
    if len(frames) < 2 or any(frame.labels.shape != frames[0].labels.shape for frame in frames):
        return _Findings(LabelFindings(model))
    texts = id_remarks(
        [frame.labels for frame in frames], frames[0].view.ignore_id, space, [run.frames[0].whole for run in runs]
    )
    remarks = tuple(f"labels of {model} {text}" for text in texts)
    if (identical := _identical(runs)) is not None:
        return _Findings(LabelFindings(model, (f"labels of {model} {identical}",), remarks), clear=True)
    comparisons = compare(runs)
    everywhere = max((comparison.edges.other for comparison in comparisons if comparison.is_better), default=math.nan)
    if (turned := from_a_frame_on(scene, model, runs, everywhere)) is not None:
        return _Findings(LabelFindings(model, (f"labels of {model} {turned}",), remarks), doubted=True)
    better = sorted(
        (comparison for comparison in comparisons if comparison.is_better),
        key=lambda comparison: -comparison.edges.other,
    )
    wrong = tuple(f"labels of {model} {counted(comparison, runs)}" for comparison in better[:1])
    return _Findings(
        LabelFindings(model, wrong, remarks, None if wrong else _open(comparisons)),
        clear=not better and all(map(_is_right, runs)),
        doubted=any(comparison.is_doubt for comparison in comparisons),
    )


def _is_right(run: LabelRun) -> bool:
    """Return whether maps of a run fit better as they are than in any other way."""
    fits = [_contrast([row[1:] for row in run.by_frame(other)]) for _, other in run.tried]
    return all(contrast.other < TELLING * contrast.given for contrast in fits)


def _identical(runs: Sequence[LabelRun]) -> str | None:
    """Return the finding where all maps are the same, of several classes, though the camera moves."""
    frames = [frame for run in runs for frame in run.frames]
    first = frames[0].labels
    if len(frames) < LEAST_TOLD or len(np.unique(first)) < 2:
        return None
    if any(not np.array_equal(first, frame.labels) for frame in frames[1:]) or not any(run.moves() for run in runs):
        return None
    return f"are the same map in all {len(frames)} frames that were read, though the camera moves: predict them again"


def _open(comparisons: Sequence[Comparison]) -> str | None:
    """Return what the frames cannot tell, in one line."""
    says = [comparison.hypothesis.name for comparison in comparisons if comparison.is_open]
    if len(says) > MOST_OPEN:
        return "their edges lie on those of depth and colour no better than mirrored, turned or of another frame"
    return f"their edges fit as well if they {', or '.join(says)}: these frames do not exclude it" if says else None


def label_findings(
    scene: Scene,
    indices: Sequence[int],
    models: Sequence[str],
    options: Mapping[str, Any] | None = None,
    ordered: Ordered | None = None,
    *,
    thorough: bool,
) -> Iterator[LabelFindings]:
    """Yield what label maps show to be wrong with them, for each model that has files of its own; nothing of scans.

    Args:
        scene: The scene.
        indices: Indices of the selected frames.
        models: Label sources.
        options: The dataset's, for the convention of the poses.
        ordered: Frames in order with their labels, by model, where they were compared already.
        thorough: Whether as many frames are compared as `check` does.
    """
    for model in () if scene.of_scans else models:
        space = None
        with contextlib.suppress(DataError):
            space = scene.label_space(model)
        findings = check_labels(scene, indices, model, space, LABEL_RUNS, thorough=thorough)
        if scene.surface is None:
            with contextlib.suppress(DataError):
                chained = (ordered or {}).get(model) or chain_of(
                    scene, indices, model, options or {}, thorough=thorough
                )
                findings = with_order(findings, *chained)
        yield findings


def chain_of(
    scene: Scene, indices: Sequence[int], model: str, options: Mapping[str, Any], *, thorough: bool
) -> tuple[Neighbours, Chain]:
    """Return the frames of a scene in order, with the labels of a model.

    Raises:
        DataError: If the first frame cannot be read.
    """
    first = reader(scene, model)(indices[0])
    how = reading(scene, first, options, None)
    neighbours = Neighbours(scene, indices, model, how.convention)
    return neighbours, neighbours.chain(neighbours.spread(how.size, thorough=thorough))


def with_order(found: LabelFindings, neighbours: Neighbours, chain: Chain) -> LabelFindings:
    """Return findings with those of label maps from frame to frame."""
    wrong = found.wrong
    if not wrong and (text := wrong_ids(neighbours, chain)) is not None:
        wrong = (f"labels of {found.model} {text}",)
    remarks = [f"labels of {found.model} {text}" for text in remarks_on_maps(neighbours, chain)]
    single = [] if wrong else neighbours.said_of_labels(chain)
    return dataclasses.replace(
        found, wrong=wrong, remarks=(*found.remarks, *remarks, *single), open=None if wrong else found.open
    )
