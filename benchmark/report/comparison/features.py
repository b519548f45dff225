"""The comparison of runs of features: sentences and a table."""

from __future__ import annotations

import math
from collections.abc import Sequence

from semstab.comparison.entries import RunHandle, shared_scenes
from semstab.comparison.features import FEATURE_ALPHA, FeatureDifference, agreement_of, feature_differences
from semstab.report.tables.table import Cell, Column, Group, Table

BY_SIZE = "alpha of features depends on how a network spreads its vectors, so networks are not compared by its size"


def compared_features(runs: Sequence[RunHandle]) -> tuple[list[str], Table]:
    """Return sentences on runs of features alone, and alpha of features within each; the first run is the base.

    Raises:
        DataError: As `shared_scenes` and `feature_differences` do.
    """
    scenes = shared_scenes(runs)
    differences = feature_differences(runs, scenes)
    sentences = [_sentence(runs[0].name, difference) for difference in differences]
    of_run = {difference.other: difference for difference in differences}
    groups = []
    for k, scene in enumerate(scenes):
        rows: list[tuple[Cell, ...]] = []
        for run in runs:
            by_scene = of_run[run.name].by_scene if run.name in of_run else ()
            found = agreement_of(run.scenes[scene])
            assert found is not None
            rows.append((run.name, found.alpha, by_scene[k] if by_scene else math.nan, found.components))
        groups.append(Group(scene, tuple(rows)))
    columns = (
        Column("run", "Run"), Column.for_quantity(FEATURE_ALPHA), Column("change", "Change", 3, "higher", signed=True),
        Column("components", "Components", 0),
    )  # fmt: skip
    caption = (
        f"Change is alpha of features minus alpha of {runs[0].name}, for runs of one network: of one name and one"
        " number of components. Runs over the same frames are paired, frame by frame and place by place."
    )
    return sentences, Table("features", "Alpha of features", caption, columns, tuple(groups), by="scene")


def _sentence(base: str, found: FeatureDifference) -> str:
    if found.difference is None:
        return f"{found.other} is not compared with {base}: {found.why}; {BY_SIZE}"
    change = f"alpha of features {found.difference.text('+')}"
    if found.difference.undecided:
        return f"{found.other} is not compared with {base}: {change}; {found.difference.undecided}"
    if found.difference.low <= 0 <= found.difference.high:
        return f"features of {found.other} do not differ significantly in stability from {base}: {change}"
    more = "more" if found.difference.value > 0 else "less"
    return f"features of {found.other} are {more} stable than of {base}: {change}"
