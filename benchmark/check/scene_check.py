"""The check of a scene: geometry, overlap, noise, persistence and labels, from a bounded sample of its frames."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.check.continuity import Chain, Neighbours, with_continuity
from semstab.check.conventions import Reading, reading
from semstab.check.coverage import (
    FUSED_FRAMES,
    Coverage,
    Noise,
    Overlap,
    Persistence,
    Suggestion,
    fused_stride,
    persistence,
    suggest,
)
from semstab.check.geometry import assess, shifts_and_turns, with_mistakes
from semstab.check.histogram import Histogram, Tally
from semstab.check.intrinsics import with_intrinsics
from semstab.check.label_order import remarks_on_maps, wrong_ids
from semstab.check.labels import LabelFindings, check_labels
from semstab.check.no_depth import with_invalid_depth
from semstab.check.precision import with_precision
from semstab.check.registration import assess_surface, match_images, notes
from semstab.check.reprojection import Sample, View, clusters, frames_at, label_source, pairs_within, reader
from semstab.check.scan_sample import ScanSample, quick_sample_of_scans
from semstab.check.scans import ScanCoverage, assess_scans
from semstab.check.sweep import with_sweep
from semstab.check.timing import with_lateness
from semstab.check.verdict import Verdict
from semstab.config import Config
from semstab.core.arrays import evenly
from semstab.core.json_form import to_json
from semstab.core.prefetch import prefetch
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace
from semstab.datasets import Scene, open_dataset
from semstab.errors import DataError
from semstab.task import frame_indices, models_of, require_posed, selected

SCHEMA = 2
"""Version of the file that --json writes."""

CLUSTERS, SCAN_CLUSTERS = 4, 2
POINTS = 8000
LEAST_POINTS_A_VIEW, MOST_POINTS_A_VIEW = 50, 500
"""The number of points that are reprojected, from neighbouring frames at so many positions of the sequence; and the
number of positions of a sequence of scans."""

QUICK_POINTS = 2400
"""The quick check takes so many points from one position, and looks as thoroughly as the check before it refuses."""

LABEL_RUNS = 6
"""Number of runs of five frames in which label maps are compared with depth, colour and each other."""

LABELLED_FRAMES = 8
"""Frames in which the labels of every model but the first are counted."""

MOST_VOXELS = 2**20
"""Voxels from a map's origin to its end, along an axis."""

VOXEL_FACTORS = (0.5, 1.0, 2.0)
"""Voxel sizes for which the distribution of OP is reported, relative to the configured or the suggested one."""


Ordered = Mapping[str, tuple[Neighbours, Chain]]
"""Frames in order, by the model whose labels they have."""


@dataclass(frozen=True)
class Depth:
    """The depth of the sampled frames: share of valid pixels, and percentiles, metres."""

    valid: float
    p5: float
    p50: float
    p95: float


@dataclass(frozen=True)
class Motion:
    """The motion between the compared frames, smallest and largest: share of the depth, and degrees."""

    shift: tuple[float, float]
    turn: tuple[float, float]


@dataclass(frozen=True)
class SceneCheck:
    """All that is known about a scene from its sample; `verdict` alone is about geometry.

    `notes` name what looks wrong, but may be right: values that mean 'no depth', labels that are not registered.
    `depth_from` names the source of depth, where no file holds it;
    `sources` say where its parts come from, where that was found, a line each;
    `refused` is what a run refuses besides;
    `unread` names images in a folder of label maps of which none is read;
    `placed` says where its georeference comes from and how well it fits.
    If the geometry is unsound, overlap, noise and voxels are not measured.
    """

    scene: str
    frames: int
    selected: int
    size: tuple[int, int]
    depth: Depth
    motion: Motion | None
    verdict: Verdict
    labels: tuple[Histogram, ...]
    overlaps: tuple[Overlap, ...] = ()
    noise: Noise | None = None
    fused_frames: int = 0
    fused_stride: int = 1
    persistence: tuple[Persistence, ...] = ()
    suggestion: Suggestion | None = None
    label_findings: tuple[LabelFindings, ...] = ()
    notes: tuple[str, ...] = ()
    depth_from: str | None = None
    placed: str | None = None
    sources: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    unread: str | None = None

    @property
    def of_scans(self) -> bool:
        """Return whether it is a scene of scans: their size is (points, 1)."""
        return self.size[1] == 1

    @property
    def problems(self) -> tuple[str, ...]:
        """Return what makes the scene unsound, one line each."""
        return self.problems_of_geometry + self.problems_of_labels

    @property
    def problems_of_geometry(self) -> tuple[str, ...]:
        """Return those of depth and poses."""
        geometry = [self.verdict.text] if self.verdict.state == "unsound" else []
        if self.depth.valid == 0:
            geometry.append("no pixel of the sampled frames has valid depth; check the files and depth_scale")
        return (*geometry, *self.refused)

    @property
    def problems_of_labels(self) -> tuple[str, ...]:
        """Return those of label maps."""
        ids = [labels.problem for labels in self.labels if labels.problem is not None]
        unread = [] if self.unread is None or self.labels else [self.unread]
        return (*unread, *ids, *(line for each in self.label_findings for line in each.wrong))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        said = {"verdict": self.verdict.to_dict(), "problems": self.problems, "sound": not self.problems}
        return {name: to_json(value) for name, value in (content | said).items()}


def check(config: Config) -> Iterator[SceneCheck]:
    """Check the scenes that a resolved configuration selects, one by one.

    Raises:
        ConfigError, DataError: If there is no such scene or a file cannot be read.
    """
    dataset = open_dataset(config.dataset.name, config.dataset.options)
    for name in selected(config.scenes, dataset.scenes, (), "scene", config.dataset.name):
        scene = dataset.scene(name)
        require_posed(scene)
        changed, gaps = with_invalid_depth(config, {name: scene})
        if gaps:
            scene = open_dataset(changed.dataset.name, changed.dataset.options).scene(name)
        yield check_scene(scene, changed, [*gaps.values()])


def check_scene(scene: Scene, config: Config, told: Sequence[str] = ()) -> SceneCheck:
    """Check one scene under the configuration's selection of frames, models, taxonomy, voxel size and stride.

    `told` are notes on how it was opened.
    """
    models, begun = _whole(scene, config)
    indices = frame_indices(scene, config, models)
    first = models[0] if models else label_source(scene)
    if scene.of_scans:
        return _check_scans(scene, config, models, begun, indices, first)
    scene.require_one_size(indices)
    inspection = Inspection(
        scene, indices, first, clusters(len(indices), CLUSTERS), POINTS, fused=FUSED_FRAMES, with_color=True
    )
    sample, how = inspection.sample(config.dataset.options), inspection.reading(config.dataset.options)
    verdict = inspection.verdict(config.dataset.options, thorough=True)
    findings = tuple[LabelFindings, ...]()
    if verdict.state != "unsound":
        chained = {} if first is None or inspection.chained is None else {first: inspection.chained}
        findings = tuple(label_findings(scene, indices, models, config.dataset.options, chained, thorough=True))
    checked = SceneCheck(
        scene=scene.name,
        frames=len(scene),
        selected=len(indices),
        size=how.size,
        depth=inspection.depth(),
        motion=_motion(sample),
        verdict=verdict,
        depth_from=scene.depth_from,
        placed=scene.placed,
        sources=scene.sources,
        unread=scene.unread,
        labels=tuple(_labels(scene, name, indices, config, inspection.tally) for name in models),
        label_findings=findings,
        notes=(
            *told,
            *verdict.remarks,
            *(line for each in findings for line in each.remarks),
            *notes(scene, [inspection.views[at] for at in sorted(inspection.views)], inspection.tally.model),
            *begun,
        ),
    )
    return checked if verdict.state == "unsound" else _with_coverage(checked, inspection, sample, config)


def _check_scans(
    scene: Scene, config: Config, models: Sequence[str], begun: Sequence[str], indices: Sequence[int], first: str | None
) -> SceneCheck:
    """Check a scene of scans: their poses, what they share, voxels, and the ids of their labels."""
    sample = ScanSample(scene, indices, first, clusters(len(indices), SCAN_CLUSTERS), fused=FUSED_FRAMES)
    verdict, coverage = with_sweep(assess_scans(sample), sample), ScanCoverage(sample)
    scans, ranges = [*sample.scans.values()], sample.ranges
    p5, p50, p95 = np.percentile(np.concatenate(ranges), (5, 50, 95)) if sum(map(len, ranges)) else (np.nan,) * 3
    valid = float(np.mean([len(own) / scan.depth.size for own, scan in zip(ranges, scans, strict=True)]))
    tally = Tally(first or "")
    for scan in scans if first is not None else ():
        tally.add(scan)
    checked = SceneCheck(
        scene=scene.name,
        frames=len(scene),
        selected=len(indices),
        size=(int(np.median([scan.depth.size for scan in scans])), 1),
        depth=Depth(valid, float(p5), float(p50), float(p95)),
        motion=None,
        verdict=verdict,
        sources=scene.sources,
        labels=tuple(_labels(scene, name, indices, config, tally) for name in models),
        notes=(*verdict.remarks, *begun),
    )
    if verdict.state == "unsound" or not sample.pairs:
        return checked
    overlaps = coverage.overlaps()
    suggestion = coverage.suggestion(overlaps, len(indices), config.frames.stride)
    size = config.voxel_size
    if not config.sets_voxel_size and suggestion.voxel_size is not None:
        size = suggestion.voxel_size
    return dataclasses.replace(
        checked,
        overlaps=tuple(overlaps),
        noise=coverage.noise(),
        fused_frames=len(sample.fused),
        persistence=tuple(filter(None, (coverage.persistence(size * factor) for factor in VOXEL_FACTORS))),
        suggestion=suggestion,
    )


def _whole(scene: Scene, config: Config) -> tuple[list[str], list[str]]:
    """Return the models to check, and a note on each whose maps lack frames while another one has them all.

    Models that the configuration names are all checked.
    """
    models = list(models_of(scene, config))
    if config.models is not None or scene.skips_incomplete or len(models) < 2:
        return models, []
    indices = frame_indices(scene, config)
    there = {name: sum(not scene.missing(index, [name]) for index in indices) for name in models}
    whole = [name for name in models if there[name] == len(indices)]
    if not whole:
        return models, []
    begun = [
        f"labels of {name}: {there[name]} of {len(indices)} selected frames have a map, so they were not checked;"
        " predict the others, or delete the folder"
        for name in models
        if name not in whole
    ]
    return whole, begun


def quick_check(scene: Scene, indices: Sequence[int], options: Mapping[str, Any] | None = None) -> Verdict:
    """Check that depth and poses of a scene agree, by a few frames, and by more before they are called unsound.

    `options` are the dataset's, for the advice. A frame that cannot be read is passed over.
    """
    return quick_sample(scene, indices, options)[0]


def quick_sample(
    scene: Scene, indices: Sequence[int], options: Mapping[str, Any] | None = None, model: str | None = None
) -> tuple[Verdict, Sample | None, Ordered]:
    """Return the verdict of `quick_check`, the frames that it looked at, and frames in order by label source.

    There is no sample where there are not two frames. Frames in order have the labels of `model`, whose files are read.
    """
    verdict, sample = Verdict("unclear", "it takes two frames to tell whether depth and poses agree"), None
    ordered: Ordered = {}
    if scene.of_scans:
        scans = quick_sample_of_scans(scene, indices)
        return with_sweep(assess_scans(scans), scans), None, ordered
    for count, points, thorough in ((1, QUICK_POINTS, False), (CLUSTERS, POINTS, True)):
        inspection = Inspection(scene, indices, None, clusters(len(indices), count), points, passing_over=True)
        if len(inspection.views) < 2:
            continue
        sample = inspection.sample(options or {})
        verdict = inspection.verdict(options or {}, thorough=thorough, labels_of=model)
        if model is not None and inspection.chained is not None:
            ordered = {model: inspection.chained}
        if verdict.state in ("sound", "imprecise"):
            break
    return verdict, sample, ordered


def label_findings(
    scene: Scene,
    indices: Sequence[int],
    models: Sequence[str],
    options: Mapping[str, Any] | None = None,
    known: Ordered | None = None,
    *,
    thorough: bool,
) -> Iterator[LabelFindings]:
    """Yield what label maps show to be wrong with them, for each model that has files of its own; nothing of scans.

    Args:
        scene: The scene.
        indices: Indices of the selected frames.
        models: Label sources.
        options: The dataset's, for the convention of the poses.
        known: Frames in order with their labels, by model, where they were compared already.
        thorough: Whether as many frames are compared as `check` does.
    """
    for model in () if scene.of_scans else models:
        space = None
        with contextlib.suppress(DataError):
            space = scene.label_space(model)
        found = check_labels(scene, indices, model, space, LABEL_RUNS, thorough=thorough)
        if scene.surface is None:
            with contextlib.suppress(DataError):
                chained = (known or {}).get(model) or chain_of(scene, indices, model, options or {}, thorough=thorough)
                found = with_order(found, *chained)
        yield found


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


def require_sound(scene: Scene, indices: Sequence[int], options: Mapping[str, Any] | None = None) -> Verdict:
    """Return the verdict of `quick_check`.

    Raises:
        DataError: If depth and poses contradict each other.
    """
    verdict = quick_check(scene, indices, options)
    refuse_unsound(scene, verdict)
    return verdict


def refuse_unsound(scene: Scene, verdict: Verdict) -> None:
    """Raise DataError where the verdict on that scene is that depth and poses contradict each other."""
    if verdict.state == "unsound":
        then = "`semstab-bench check` reports more, --no-geometry-check fuses the scene as it is"
        raise DataError(
            f"{scene.name}: {verdict.text}; {'check_geometry=False fuses it as it is' if scene.in_program else then}"
        )


class Inspection:
    """The frames of a scene that a check reads, thinned as they come in.

    Attributes:
        source: Label source to read frames with; None needs no labels.
        groups: Positions in `indices` of frames that are compared with each other.
        points: About how many points are reprojected in all.
        fused: Number of frames, evenly spaced, that are also held in memory for fusion.
        chained: Frames in order, once a verdict compared them.
        passing_over: Leave out frames that cannot be read, instead of raising what reading them raises.
        with_color: Whether to read also the size of a colour image: intrinsics may be for that.
    """

    def __init__(
        self,
        scene: Scene,
        indices: Sequence[int],
        source: str | None,
        groups: Sequence[Sequence[int]],
        points: int,
        *,
        fused: int = 0,
        passing_over: bool = False,
        with_color: bool = False,
    ) -> None:
        self.scene, self.indices, self.source = scene, indices, source
        self.tally = Tally(source or "")
        self.views: dict[int, View] = {}
        self.fused = evenly(len(indices), fused)
        self.chained: tuple[Neighbours, Chain] | None = None
        self._first: Frame | None = None
        self.farthest: tuple[float, Frame, tuple[int, int]] | None = None
        self._pairs = pairs_within(groups)
        self._compared = {position for group in groups for position in group}
        self._points = min(MOST_POINTS_A_VIEW, max(LEAST_POINTS_A_VIEW, points // max(1, len(self._pairs))))
        self._labelled = source is not None
        color = scene.color(indices[0]) if with_color else None
        self._color_shape = None if color is None else color.shape
        self._read(indices, reader(scene, source), passing_over)

    def _read(self, indices: Sequence[int], read: Callable[[int], Frame], passing_over: bool) -> None:
        positions = self._compared | set(self.fused)
        for position, frame in frames_at(positions, indices, read, passing_over=passing_over):
            self._first = self._first or frame
            self._take_note(frame)
            if self._labelled:
                self.tally.add(frame)
            self.views[position] = View.of(frame, self._points, labelled=self._labelled)

    def _take_note(self, frame: Frame) -> None:
        """Remember the farthest pixel of all frames."""
        depth = np.where(frame.depth < np.inf, frame.depth, np.float32(0))  # NaN is not less
        at = int(depth.argmax())
        if self.farthest is None or float(depth.flat[at]) > self.farthest[0]:
            v, u = divmod(at, depth.shape[1])
            self.farthest = float(depth.flat[at]), dataclasses.replace(frame.every(64), files=frame.files), (u, v)

    def too_far(self, voxel_size: float) -> str | None:
        """Return the farthest pixel where a map of voxels of that size does not reach it."""
        if self.farthest is None or self.farthest[0] < MOST_VOXELS * voxel_size:
            return None
        depth, frame, (u, v) = self.farthest
        return (
            f"{frame.where('depth')}: pixel ({u}, {v}) has depth {depth:,.0f} m, more than 2^20 voxels of"
            f" {voxel_size:g} m away, so that a run refuses it; set max_depth: METRES, from which depth is not valid"
        )

    def reading(self, options: Mapping[str, Any]) -> Reading:
        """Return how the scene is configured."""
        assert self._first is not None
        return reading(self.scene, self._first, options, self._color_shape)

    def sample(self, options: Mapping[str, Any]) -> Sample:
        """Return the frames that are compared."""
        views = {position: view for position, view in self.views.items() if position in self._compared}
        pairs = [pair for pair in self._pairs if pair[0] in views and pair[1] in views]
        return Sample(views, pairs, self.reading(options).convention)

    def verdict(self, options: Mapping[str, Any], *, thorough: bool, labels_of: str | None = None) -> Verdict:
        """Assess depth by reprojection from frame to frame, and depth that is cast at a surface by the images.

        Frames in order are read with the labels of `labels_of`, by default those of `source`.
        """
        sample = self.sample(options)
        if self.scene.surface is not None:
            return assess_surface(match_images(self.scene, sample.views, sample.pairs), len(sample.views))
        how = self.reading(options)
        verdict = assess(sample, how, thorough=thorough)
        if (mistaken := with_mistakes(verdict, sample)) != verdict:
            return mistaken
        timed = with_lateness(verdict, self.scene, sample, how)
        verdict = with_intrinsics(verdict, sample, how) if timed == verdict else timed
        verdict = with_precision(verdict, sample)
        if self.scene.made and not thorough:
            return verdict  # rendering its frames takes longer than fusing them
        if verdict.mend:
            return verdict
        source = labels_of or self.source
        known = self.views if source == self.source else None
        neighbours = Neighbours(self.scene, self.indices, source, how.convention, known)
        chain = neighbours.chain({*neighbours.spread(how.size, thorough=thorough), *neighbours.striking()})
        self.chained = neighbours, chain
        return with_continuity(verdict, neighbours, chain)

    def depth(self) -> Depth:
        """Return the depth of all frames that were read."""
        valid = [np.mean((view.depth > 0) & (view.depth < np.inf)) for view in self.views.values()]
        depths = np.concatenate([view.depth[view.v, view.u] for view in self.views.values()])
        p5, p50, p95 = np.percentile(depths, (5, 50, 95)) if len(depths) else (np.nan,) * 3
        return Depth(float(np.mean(valid)), float(p5), float(p50), float(p95))


def _with_coverage(checked: SceneCheck, inspection: Inspection, sample: Sample, config: Config) -> SceneCheck:
    """Return overlap, noise and voxels, where depth and poses may agree."""
    coverage = Coverage(sample)
    overlaps = coverage.overlaps()
    noise = coverage.noise() if overlaps and any(row.covisible > 0 for row in overlaps) else None
    views = [inspection.views[position] for position in inspection.fused]
    stride = fused_stride(checked.size, config.pixel_stride)
    suggestion = None if noise is None else suggest(coverage, overlaps, checked.selected, config.frames.stride)
    if suggestion is not None and checked.verdict.state == "imprecise":
        reason = f"{suggestion.voxel_size_reason}, which are that large because depth and poses are imprecise"
        suggestion = dataclasses.replace(suggestion, voxel_size_reason=reason)
    size = config.voxel_size
    if not config.sets_voxel_size and suggestion is not None and suggestion.voxel_size is not None:
        size = suggestion.voxel_size
    faces = None if noise is None else coverage.faces(size)
    fused = [_persistence(views, coverage, size * factor, stride) for factor in VOXEL_FACTORS]
    return dataclasses.replace(
        checked,
        refused=tuple(filter(None, (inspection.too_far(size),))),
        notes=checked.notes if faces is None else (*checked.notes, str(faces)),
        overlaps=tuple(overlaps),
        noise=noise,
        fused_frames=len(views),
        fused_stride=stride,
        persistence=tuple(row for row in fused if row is not None),
        suggestion=suggestion,
    )


def _persistence(views: Sequence[View], coverage: Coverage, voxel_size: float, stride: int) -> Persistence | None:
    """Return the distribution of OP; None where points lie so far out that voxels of that size cannot be counted."""
    try:
        return persistence(views, coverage, voxel_size, stride)
    except DataError:
        return None


def _motion(sample: Sample) -> Motion | None:
    """Return how far the camera moves and turns from one compared frame to another.

    The result is None where there is no depth to compare it with.
    """
    if not sample.pairs:
        return None
    shifts, turns = shifts_and_turns(sample)
    if np.isnan(shifts).any():
        return None
    return Motion((float(shifts.min()), float(shifts.max())), (float(turns.min()), float(turns.max())))


def _labels(scene: Scene, model: str, indices: Sequence[int], config: Config, tally: Tally) -> Histogram:
    """Return the labels of a model: of the frames that were read already, or of a few read for it."""
    if model != tally.model:
        tally = Tally(model)
        chosen = [indices[position] for position in evenly(len(indices), LABELLED_FRAMES)]
        for fetched in prefetch(reader(scene, model), chosen):
            tally.add(fetched.item)
    try:
        space = scene.label_space(model)
    except DataError as error:
        return tally.histogram(None, str(error))
    if config.taxonomy is not None:
        space.mapping_to(LabelSpace.load(config.taxonomy))
    return tally.histogram(space)
