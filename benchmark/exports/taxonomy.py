"""Write the classes of a model, grouped so that views agree on them, as a taxonomy for `--taxonomy`."""

from __future__ import annotations

from pathlib import Path

from semstab.configure import settings_of_folder
from semstab.core.files import write_text
from semstab.data.labels import LabelSpace
from semstab.data.records import Record
from semstab.data.statistics import Grouping
from semstab.errors import ConfigError

TAXONOMY = (".yaml", ".yml")


def holds_taxonomy(file: Path) -> bool:
    """Return whether a file gets a taxonomy."""
    return file.suffix.lower() in TAXONOMY


def write_taxonomy(run: Path, record: Record, file: Path) -> Grouping:
    """Write the finest grouping of a unit's classes that is stable, else usable; return it.

    Raises:
        ConfigError: If the unit has none: all its classes hold, or no groups of them do.
    """
    statistics = record.statistics
    groupings = None if statistics is None else statistics.groupings
    if statistics is None or groupings is None or groupings.told is None:
        where = f"{record.unit.scene}, {record.unit.model}"
        raise ConfigError(f"{file}: {where} has no groups of classes to write; semstab-bench show RUN merges says more")
    with settings_of_folder(run) as config:
        taxonomy = config.taxonomy
    space = (
        LabelSpace(record.taxonomy, tuple(row.name for row in record.map_summary.classes))
        if taxonomy is None
        else LabelSpace.load(taxonomy)
    )
    grouped = grouped_taxonomy(space, groupings.told)
    alpha = groupings.told.alpha.text()
    write_text(file, f"# Views of {record.unit.model} agree on these groups: alpha {alpha}.\n{grouped.text()}")
    return groupings.told


def grouped_taxonomy(space: LabelSpace, grouping: Grouping) -> LabelSpace:
    """Return a taxonomy in which each group is a class, called 'door + curtain', with the colour of its first class."""
    group = {name: names for names in grouping.merged for name in names}
    classes: dict[str, int] = {}
    members: dict[str, tuple[str, ...]] = {}
    for k, name in enumerate(space.classes):
        title = " + ".join(group.get(name, (name,)))
        classes.setdefault(title, k)
        merged_names = (name,) if name in group else ()
        members[title] = (*members.get(title, ()), *merged_names, *space.members[k])
    return LabelSpace(
        f"{space.name}, {len(classes)} groups",
        tuple(classes),
        colors=tuple(space.colors[k] for k in classes.values()),
        members=tuple(members.values()),
        ignored=space.ignored,
    )
