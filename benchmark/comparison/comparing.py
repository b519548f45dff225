"""Runs beside the first one, scene by scene and over all scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from semstab.comparison.contrasts import by_class, contrasts, corrected, over_scenes
from semstab.comparison.opening import Contender, open_contenders, shared_scenes
from semstab.comparison.pairing import Common, pair
from semstab.comparison.places import Changes, worse_places
from semstab.errors import ConfigError
from semstab.model.contrast import Against, Compared, RunComparison, SceneComparison
from semstab.model.results import slug

SCHEMA = 1
COLUMNS = "columns"
"""Folder of the files SCENE__BASE__RUN.parquet: what changed in each voxel."""

Up = tuple[float, float, float]
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Found:
    """What was found, and what figures and files show of it.

    changes  in each voxel, by scene and run, where voxels could be paired
    up       the up axis of each scene, where it is known
    """

    result: RunComparison
    changes: Mapping[tuple[str, str], Changes]
    up: Mapping[str, Up]


def find(runs: Sequence[str | Path], progress: Progress = lambda what: None) -> Found:
    """Compare runs with the first one; `progress` is told what is done.

    Raises ConfigError for fewer than two, and what `open_contenders`, `shared_scenes` and `pair` raise.
    """
    if len(runs) < 2:
        raise ConfigError("there is nothing to compare it with; name two runs or more, the one to compare with first")
    contenders = open_contenders(runs)
    scenes: list[SceneComparison] = []
    changes: dict[tuple[str, str], Changes] = {}
    for scene in shared_scenes(contenders):
        progress(scene)
        found, own = _scene(scene, contenders)
        scenes.append(found)
        changes |= {(scene, name): each for name, each in own.items()}
    result = RunComparison(
        schema=SCHEMA,
        base=contenders[0].name,
        runs=tuple(Compared(each.name, each.source, each.backbone) for each in contenders),
        overall=_over_all(scenes),
        scenes=tuple(scenes),
    )
    ups = {scene: up for each in reversed(contenders) for scene, own in each.scenes.items() if (up := own.up)}
    return Found(result, changes, ups)


def _scene(scene: str, contenders: Sequence[Contender]) -> tuple[SceneComparison, dict[str, Changes]]:
    entries, names = [each.scenes[scene] for each in contenders], [each.name for each in contenders]
    common = pair(entries, names)
    numbers = range(1, len(entries))
    everything = corrected([contrasts(common, entries[0], entries[n], n) for n in numbers])
    classes = corrected([by_class(common, entries[0], entries[n], n) for n in numbers])
    against, changes = [], {}
    for n, own, of_classes in zip(numbers, everything, classes, strict=True):
        found = Against(names[n], own, of_classes)
        if common.regions is not None:
            worse = worse_places(common, n)
            changes[names[n]] = worse.changes
            found = dataclasses.replace(
                found,
                compared=worse.changes.compared,
                worse=worse.changes.worse,
                better=worse.changes.better,
                places=worse.places,
                blamed=worse.blamed,
                columns=Path(COLUMNS) / f"{slug(scene, names[0], names[n])}.parquet",
            )
        against.append(found)
    return _found(scene, common, tuple(against)), changes


def _found(scene: str, common: Common, against: tuple[Against, ...]) -> SceneComparison:
    frames = min((sums.frames * sums.step for sums in common.sums), default=0)
    voxels = len(common.tables[0]) if common.tables else 0
    voxels = int((common.tables[0].op >= 2).sum()) if voxels else 0
    return SceneComparison(scene, common.basis, common.remarks, voxels, frames, common.coverage, common.looks, against)


def _over_all(scenes: Sequence[SceneComparison]) -> tuple[Against, ...]:
    """Macro means; of one scene what was found there."""
    if len(scenes) == 1:
        return tuple(Against(own.other, own.contrasts, own.by_class) for own in scenes[0].against)
    runs = list(zip(*(scene.against for scene in scenes), strict=True))
    everything = corrected([over_scenes([own.contrasts for own in run]) for run in runs])
    classes = corrected([over_scenes([own.by_class for own in run]) for run in runs])
    return tuple(
        Against(run[0].other, own, of_classes, *(sum(getattr(each, name) for each in run) for name in _COUNTS))
        for run, own, of_classes in zip(runs, everything, classes, strict=True)
    )


_COUNTS = ("compared", "worse", "better")
