"""The tables of a comparison with other programs' maps, and what the screen says of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from semstab.core.console import WIDTH, Console, wrapped
from semstab.other_maps.agreement import DifferingPlace, MapAgreement
from semstab.report.tables.table import Column, Group, Row, Table, to_terminal

MOST_PLACES = 20
"""The most places of a table."""


OVERVIEW = ("map", "voxels", "covers", "covered", "same", "accuracy_run", "accuracy_map")
"""The columns of the table of maps on the screen."""

LONGEST = 24
"""The most letters of the name of a map on the screen."""


def short(name: str) -> str:
    """Return a name that fits a table of the screen."""
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 3]}..."


def tables(agreements: tuple[MapAgreement, ...], run: str) -> list[Table]:
    """Return a table with a row for each map, then tables of classes, strata of OP, and places."""
    made = [overview(agreements, run), _classes(agreements, run), _strata(agreements, run), _places(agreements, run)]
    return [table for table in made if any(group.rows for group in table.groups)]


def overview(agreements: tuple[MapAgreement, ...], run: str) -> Table:
    """Return the table with a row for each map."""
    columns = (
        Column("map", "Map"), Column("voxels", "Voxels", 0), Column("covers", "Run in map %", 1),
        Column("covered", "Map in run %", 1), Column("outside", "Points outside %", 1),
        Column("unlabelled", "No class %", 1), Column("same", "Same class %", 1),
        Column("accuracy_run", "run", 3, over="Acc."), Column("accuracy_map", "map", 3, over="Acc."),
        Column("miou_run", "run", 3, over="mIoU"), Column("miou_map", "map", 3, over="mIoU"),
    )  # fmt: skip
    rows = tuple(
        (row.name, row.voxels, 100 * row.covers, 100 * row.covered, 100 * row.outside, 100 * row.unlabelled,
         100 * row.same, *row.accuracy, *row.miou)
        for row in agreements
    )  # fmt: skip
    caption = (
        f"Run in map: the share of the voxels of {run} that are in the map; map in run: the share of the map's voxels"
        f" that are in {run}. Same class: of the voxels that both have and label. Accuracy (acc.) and mIoU are"
        " of those voxels whose true class is known."
    )
    return Table("maps", f"Maps of other programs and {run}", caption, columns, (Group("", rows),), "")


def _classes(agreements: tuple[MapAgreement, ...], run: str) -> Table:
    columns = (
        Column("class", "Class"), Column("voxels", "Voxels", 0), Column("same", "Same class %", 1),
        Column("instead", "Most often instead"), Column("recall_run", "run", 3, over="Recall"),
        Column("recall_map", "map", 3, over="Recall"),
    )  # fmt: skip
    groups = tuple(
        Group(agreement.name, tuple((c.name, c.voxels, 100 * c.same, c.instead, *c.recall) for c in agreement.classes))
        for agreement in agreements
    )
    caption = f"Voxels that both have and label, by their class in {run}; recall is by the true class."
    return Table("maps_classes", "By class", caption, columns, groups, "map")


def _strata(agreements: tuple[MapAgreement, ...], run: str) -> Table:
    columns = (
        Column("op", "OP"), Column("voxels", "Voxels", 0), Column("covers", "Run in map %", 1),
        Column("same", "Same class %", 1), Column("accuracy_run", "run", 3, over="Acc."),
        Column("accuracy_map", "map", 3, over="Acc."),
    )  # fmt: skip
    groups = tuple(
        Group(
            agreement.name,
            tuple((s.name, s.voxels, 100 * s.covered, 100 * s.same, *s.accuracy) for s in agreement.strata),
        )
        for agreement in agreements
    )
    caption = f"Voxels of {run} by the number of frames that saw them; run in map: the share that is in the other map."
    return Table("maps_op", "By OP", caption, columns, groups, "map")


def _places(agreements: tuple[MapAgreement, ...], run: str) -> Table:
    columns = (
        Column("number", "Place"), Column("run", "Run"), Column("map", "Map"), Column("true", "True class"),
        Column("voxels", "Voxels", 0), Column("x", "x", 2), Column("y", "y", 2), Column("z", "z", 2),
        Column("size", "Size, m", 1),
    )  # fmt: skip
    groups = tuple(
        Group(agreement.name, tuple(map(_place, agreement.places[:MOST_PLACES])))
        for agreement in agreements
        if agreement.places
    )
    caption = (
        f"Neighbouring voxels to which {run} and the map give two different classes, the most voxels first; coordinates"
        " of the scene, metres."
    )
    return Table("maps_places", "Where they differ", caption, columns, groups, "map")


def _place(place: DifferingPlace) -> Row:
    x, y, z = place.centre
    return (str(place.number), place.ours, place.theirs, place.true, place.voxels, x, y, z, place.size)


def lines(agreement: MapAgreement) -> Iterator[str]:
    """Yield what to know about a map: what fits better, and how its classes were read."""
    if agreement.outside:
        yield f"{agreement.name}: {agreement.outside:.1%} of its points lie in no voxel of the run"
    if agreement.unlabelled:
        yield f"{agreement.name}: {agreement.unlabelled:.1%} of its points have no class of the run"
    if agreement.better:
        yield f"{agreement.name}: {agreement.better}"
    for note in agreement.notes:
        yield f"{agreement.name}: {note}"


def print_maps(agreements: tuple[MapAgreement, ...], run: str, console: Console, *, verbose: bool = False) -> None:
    """Print the table of maps and what to know about each; verbose: also classes, strata of OP and places."""
    for table in tables(agreements, run):
        if table.name == "maps" or verbose:
            display_table = table.only(*OVERVIEW) if table.name == "maps" else table
            groups = tuple(
                Group(short(group.name), tuple((short(str(row[0])), *row[1:]) for row in group.rows))
                for group in display_table.groups
            )
            text = to_terminal(dataclasses.replace(display_table, caption="", groups=groups), WIDTH)
            console.print(f"{text.rstrip()}\n", highlight=False, markup=False, soft_wrap=True)
    for agreement in agreements:
        for line in lines(agreement):
            console.print("\n".join(wrapped(line, console.width)), highlight=False, markup=False)
