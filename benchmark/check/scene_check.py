"""The check of a scene: geometry, overlap, noise, persistence and labels, from a bounded sample of its frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.check.coverage import (
    FUSED_FRAMES,
    Coverage,
    Covers,
    DepthNoise,
    Overlap,
    Persistence,
    Suggestion,
    fused_stride,
    persistence,
    suggest,
    without_labels,
)
from semstab.check.geometry import shifts_and_turns
from semstab.check.histogram import Histogram, LabelTally
from semstab.check.inspection import Depth, Inspection
from semstab.check.labels import LabelFindings, Ordered, label_findings
from semstab.check.no_depth import with_invalid_depth
from semstab.check.registration import notes
from semstab.check.reprojection import Sample, clusters, label_source, reader
from semstab.check.scan_sample import ScanSample, quick_sample_of_scans
from semstab.check.scan_verdict import verdict_of_scans
from semstab.check.scans import assess_scans
from semstab.check.sweep import with_sweep
from semstab.check.verdict import Verdict
from semstab.config import Config
from semstab.core.arrays import evenly
from semstab.core.json_form import to_json
from semstab.core.prefetch import prefetch
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace
from semstab.data.statistics import poses_that_do_not_fit
from semstab.datasets import Scene, open_dataset
from semstab.errors import DataError
from semstab.statistics import Sampler
from semstab.statistics.moving import misplaced_frames
from semstab.task import frame_indices, models_of, require_posed, selected

SCHEMA = 1
"""Version of the file that --json writes."""

CLUSTERS, SCAN_CLUSTERS = 4, 2
POINTS = 8000
"""Positions of the sequence at which neighbouring frames are read, positions of a sequence of scans, and the number of
points that are reprojected."""

QUICK_POINTS = 2400
"""Points that the quick check takes, from one position; before it refuses, it looks as thoroughly as the check."""

LABELLED_FRAMES = 8
"""Frames in which the labels of every model but the first are counted."""

VOXEL_FACTORS = (0.5, 1.0, 2.0)
"""Voxel sizes for which the distribution of OP is reported, relative to the configured or the suggested one."""


@dataclass(frozen=True)
class Motion:
    """The motion between the compared frames, smallest and largest: share of the depth, and degrees."""

    shift: tuple[float, float]
    turn: tuple[float, float]


@dataclass(frozen=True)
class SceneCheck:
    """All that is known about a scene from its sample; `verdict` alone is about geometry.

    `notes` name what looks wrong, but may be right: values that mean 'no depth', labels that are not registered.
    `depth_from` names the source of depth, if no file holds depth;
    `sources` name the sources of its parts that were found, a line each;
    `refused` names what a run also refuses;
    `unread` names images in a folder of label maps from which no image is read;
    `placed` names the source of its georeference and its fit.
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
    noise: DepthNoise | None = None
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
        return (*unread, *ids, *(line for findings in self.label_findings for line in findings.wrong))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        derived = {"verdict": self.verdict.to_dict(), "problems": self.problems, "sound": not self.problems}
        return {name: to_json(value) for name, value in (content | derived).items()}


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
            *(line for of_model in findings for line in of_model.remarks),
            *notes(
                scene, [inspection.views[position] for position in sorted(inspection.views)], inspection.tally.model
            ),
            *begun,
        ),
    )
    stride = fused_stride(checked.size, config.pixel_stride)
    fused = [without_labels(inspection.views[position], stride) for position in inspection.fused]
    if text := _poses_that_do_not_fit(scene, fused):
        checked = dataclasses.replace(checked, notes=(*checked.notes, text))
    if verdict.state == "unsound":
        return checked
    checked = dataclasses.replace(checked, fused_stride=stride)
    return _with_coverage(checked, Coverage(sample), fused, config, inspection.too_far)


def _poses_that_do_not_fit(scene: Scene, frames: Sequence[Frame]) -> str:
    """Return which of some frames see through what the others see, all over the image; '' if none does."""
    sampler = Sampler(1)
    for frame in frames:
        sampler.add(frame)
    return poses_that_do_not_fit(misplaced_frames(sampler.sample(), scene.frame_name))


def _check_scans(
    scene: Scene, config: Config, models: Sequence[str], begun: Sequence[str], indices: Sequence[int], first: str | None
) -> SceneCheck:
    """Check a scene of scans: their poses, what they share, voxels, and their labels."""
    sample = ScanSample(scene, indices, first, clusters(len(indices), SCAN_CLUSTERS), fused=FUSED_FRAMES)
    verdict, findings = verdict_of_scans(sample, indices, models)
    scans, ranges = [*sample.scans.values()], sample.ranges
    valid = [len(valid_ranges) / scan.depth.size for valid_ranges, scan in zip(ranges, scans, strict=True)]
    tally = LabelTally(first or "")
    for scan in scans if first is not None else ():
        tally.add(scan)
    checked = SceneCheck(
        scene=scene.name,
        frames=len(scene),
        selected=len(indices),
        size=(int(np.median([scan.depth.size for scan in scans])), 1),
        depth=Depth.from_samples(valid, ranges),
        motion=None,
        verdict=verdict,
        sources=scene.sources,
        labels=tuple(_labels(scene, name, indices, config, tally) for name in models),
        label_findings=findings,
        notes=(*verdict.remarks, *begun),
    )
    if verdict.state == "unsound" or not sample.pairs:
        return checked
    fused = [sample.scans[position] for position in sample.fused]
    of_one_class = [dataclasses.replace(s, labels=np.zeros(s.shape, np.uint8), scores=None) for s in fused]
    return _with_coverage(checked, sample, of_one_class, config)


def _whole(scene: Scene, config: Config) -> tuple[list[str], list[str]]:
    """Return the models to check, and a note on each whose maps lack frames while another one has them all.

    Models that the configuration names are all checked.
    """
    models = list(models_of(scene, config))
    if config.models is not None or scene.skips_incomplete or len(models) < 2:
        return models, []
    indices = frame_indices(scene, config)
    num_maps = {name: sum(not scene.missing(index, [name]) for index in indices) for name in models}
    complete = [name for name in models if num_maps[name] == len(indices)]
    if not complete:
        return models, []
    begun = [
        f"labels of {name}: {num_maps[name]} of {len(indices)} selected frames have a map, so they were not checked;"
        " predict the others, or delete the folder"
        for name in models
        if name not in complete
    ]
    return complete, begun


def quick_check(scene: Scene, indices: Sequence[int], options: Mapping[str, Any] | None = None) -> Verdict:
    """Check that depth and poses of a scene agree, by a few frames, and by more before they are called unsound.

    `options` are the dataset's, for the advice. A frame that cannot be read is passed over.
    """
    return quick_sample(scene, indices, options)[0]


def quick_sample(
    scene: Scene, indices: Sequence[int], options: Mapping[str, Any] | None = None, model: str | None = None
) -> tuple[Verdict, Sample | None, Ordered]:
    """Return the verdict of `quick_check`, the frames that it looked at, and frames in order by label source.

    The sample is None with fewer than two frames. Frames in order have the labels of `model`, whose files are read.
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
        advice = "`semstab-bench check` reports more, --no-geometry-check fuses the scene as it is"
        raise DataError(
            f"{scene.name}: {verdict.text}; {'check_geometry=False fuses it as it is' if scene.in_program else advice}"
        )


def _with_coverage(
    checked: SceneCheck,
    coverage: Covers,
    fused: Sequence[Frame],
    config: Config,
    too_far: Callable[[float], str | None] = lambda size: None,
) -> SceneCheck:
    """Return overlap, noise and voxels, where the frames, or scans, may agree; those to fuse have one class."""
    overlaps = coverage.overlaps()
    noise = coverage.noise() if any(row.covisible > 0 for row in overlaps) else None
    suggestion = None if noise is None else suggest(coverage, overlaps, checked.selected, config.frames.stride)
    if suggestion is not None and checked.verdict.state == "imprecise":
        reason = f"{suggestion.voxel_size_reason}, which are that large because depth and poses are imprecise"
        suggestion = dataclasses.replace(suggestion, voxel_size_reason=reason)
    size = config.voxel_size
    if not config.sets_voxel_size and suggestion is not None and suggestion.voxel_size is not None:
        size = suggestion.voxel_size
    faces = None if noise is None else coverage.faces(size)
    return dataclasses.replace(
        checked,
        refused=tuple(filter(None, (too_far(size),))),
        notes=checked.notes if faces is None else (*checked.notes, str(faces)),
        overlaps=tuple(overlaps),
        noise=noise,
        fused_frames=len(fused),
        persistence=tuple(filter(None, (persistence(fused, coverage, size * factor) for factor in VOXEL_FACTORS))),
        suggestion=suggestion,
    )


def _motion(sample: Sample) -> Motion | None:
    """Return how far the camera moves and turns from one compared frame to another, or None without pairs of frames."""
    if not sample.pairs:
        return None
    shifts, turns = shifts_and_turns(sample)
    if np.isnan(shifts).any():
        return None
    return Motion((float(shifts.min()), float(shifts.max())), (float(turns.min()), float(turns.max())))


def _labels(scene: Scene, model: str, indices: Sequence[int], config: Config, tally: LabelTally) -> Histogram:
    """Return the labels of a model: of the frames that were read already, or of a few read for it."""
    if model != tally.model:
        tally = LabelTally(model)
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
