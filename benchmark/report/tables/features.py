"""Make the tables of features: alpha of each model, and its worst places."""

from __future__ import annotations

from collections.abc import Iterator

from semstab.data.records import Record, Result
from semstab.data.statistics import FeatureAgreement, FeaturePlace
from semstab.report.tables.statistics import INTERVALS, SCENE, assessed_records
from semstab.report.tables.table import Column, Group, Row, Table
from semstab.statistics.agreement import ALPHA


def _with_features(result: Result) -> Iterator[tuple[str, list[tuple[Record, FeatureAgreement]]]]:
    """Yield the models whose frames have features, with the agreement of these by scene."""
    for name, rows in assessed_records(result).items():
        if assessed := [(record, stats.features) for record, stats in rows if stats.features is not None]:
            yield name, assessed


def features(result: Result) -> list[Table]:
    """Return alpha of features, scene by scene."""
    groups = [
        Group(
            name,
            tuple(
                (
                    record.unit.scene,
                    agreement.alpha,
                    agreement.cosine,
                    agreement.chance,
                    agreement.components,
                    agreement.spots,
                    agreement.one_in,
                )
                for record, agreement in rows
            ),
        )
        for name, rows in _with_features(result)
    ]
    if not groups:
        return []
    columns = (
        SCENE, Column.for_quantity(ALPHA), Column("cosine", "of two views", 3, over="Mean cosine"),
        Column("chance", "of any two", 3, over="Mean cosine"), Column("components", "Components", 0),
        Column("spots", "Spots", 0), Column("one_in", "Kept, 1 in", 0),
    )  # fmt: skip
    caption = (
        "Alpha of features is 1 - (1 - cosine of two views at a spot) / (1 - cosine of any two observations): 1 is"
        " perfect, 0 is chance. Features of one network cannot be compared with those of another by the size of alpha."
        f" If memory does not suffice, a fraction of the spots is kept. {INTERVALS}"
    )
    return [Table("features", "Agreement of features", caption, columns, tuple(groups))]


def feature_places(result: Result) -> list[Table]:
    """Return the places where features of two views differ most."""
    groups = []
    for name, rows in _with_features(result):
        places = tuple(_row(record, place) for record, agreement in rows for place in agreement.places)
        groups += [Group(name, places)] if places else []
    if not groups:
        return []
    columns = (
        SCENE, *(Column(axis, f"{axis} (m)") for axis in "xyz"), Column("spots", "Spots", 0),
        Column("cosine", "Mean cosine", 3, "higher"), Column("disagreement_percent", "Disagreement (%)", 1, "lower"),
        Column("frames", "Frames"),
    )  # fmt: skip
    caption = (
        "The places are cubes of space where the features of two views differ most, all spots together: centre,"
        " spots that two views saw, mean cosine of two views, share of the disagreement of the map, and the indices of"
        " the frames that see most of it."
    )
    return [Table("feature_places", "Worst places of features", caption, columns, tuple(groups))]


def _row(record: Record, place: FeaturePlace) -> Row:
    """Return a row of `feature_places`."""
    x, y, z = (f"{value:.2f}" for value in place.centre)
    frames = ", ".join(map(str, place.frames))
    return record.unit.scene, x, y, z, place.spots, place.cosine, 100 * place.share, frames
