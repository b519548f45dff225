"""The folder of a comparison: numbers for programs, pages for people, and what changed in each voxel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from semstab.comparison.comparing import Found, Progress, find
from semstab.comparison.figures import figures
from semstab.comparison.narrative import sentences
from semstab.comparison.tables import heading, tables
from semstab.core.files import keep_only, read_json, write_json, write_text
from semstab.core.json_form import from_json
from semstab.errors import ConfigError
from semstab.model import parquet
from semstab.model.contrast import RunComparison
from semstab.report import blocks, filled
from semstab.report.figures.style import Figure
from semstab.report.tables import save_tables
from semstab.report.tables.table import Table, relations, to_markdown

CONTENT, PAGE, REPORT, RECORDING = "comparison.json", "comparison.md", "report.html", "recording.rrd"
KIND = "Changes"
"""Of the files with a row a voxel."""


def compare(
    runs: Sequence[str | Path], out: str | Path | None = None, *, progress: Progress = lambda what: None
) -> RunComparison:
    """What differs between runs and the first of them, by scene and over all scenes: by how much, how surely, where.

    runs  folders of runs or studies, 'FOLDER:BACKBONE' where there are several label sources, or small summaries
    out   a folder for tables, figures, report.html, comparison.json and .md, columns of voxels, and a recording

    Raises ConfigError and DataError, in one line, for what cannot be opened, or has no scene or no classes in common.
    """
    if out is not None:
        _require_own(Path(out))
    found = find(runs, progress)
    if out is not None:
        write(found, out)
    return found.result


def load_comparison(folder: str | Path) -> RunComparison:
    """What `compare` wrote. Raises DataError where it is not there or damaged."""
    path = Path(folder) / CONTENT
    return from_json(RunComparison, read_json(path), path)


def write(found: Found, out: str | Path) -> None:
    """Write the folder; of an earlier comparison nothing is left in it."""
    folder, made, drawn = Path(out), tables(found.result), figures(found)
    _require_own(folder)
    write_json(folder / CONTENT, found.result)
    write_text(folder / PAGE, markdown(found.result, made))
    save_tables(made, folder)
    keep_only([path for figure in drawn for path in figure.save(folder / "figures")], folder / "figures")
    _write_columns(found, folder)
    write_text(folder / REPORT, page(found.result, made, drawn, folder))
    if found.changes:
        from semstab.recording.changes import record_changes

        record_changes(folder / RECORDING, dict(_recorded(found)), found.up, sentences(found.result))


def markdown(found: RunComparison, made: Sequence[Table] | None = None) -> str:
    """The comparison for a pull request: what was found, then the tables."""
    shown = [table for table in (made or tables(found)) if table.name != "comparison_all"]
    names = ", ".join(each.name for each in found.runs[1:])
    head = [f"## {names} against {found.base}", "", *(f"- {relations(text)}" for text in sentences(found)), ""]
    return "\n".join([*head, *map(to_markdown, shown)])


def page(found: RunComparison, made: Sequence[Table], drawn: Sequence[Figure], folder: Path) -> str:
    """report.html."""
    shown = [table for table in made if table.name != "comparison_all"]
    return filled(
        "comparison.html.j2",
        title=f"{', '.join(each.name for each in found.runs[1:])} against {found.base}",
        runs=found.runs,
        scenes=[scene.scene for scene in found.scenes],
        reading=[relations(text) for text in sentences(found)],
        topics=list(_topics(shown, drawn, folder)),
    )


# --- Parts ------------------------------------------------------------------------------------------------------------

TOPICS = (
    ("differences", "What differs", ("comparison",)),
    ("classes", "By class", ("comparison_classes",)),
    ("where", "Where", ("comparison_places", "comparison_frames", "comparison_map")),
    ("compared", "What was compared", ("comparison_coverage", "comparison_ignored")),
)


def _topics(made: Sequence[Table], drawn: Sequence[Figure], folder: Path) -> Iterator[dict[str, Any]]:
    for key, title, names in TOPICS:
        own = [table for table in made if table.name in names]
        shown = [figure for figure in drawn if figure.name.partition("__")[0] in names]
        if own or shown:
            yield {"id": key, "title": title, "blocks": list(blocks(own, shown, folder))}


def _write_columns(found: Found, folder: Path) -> None:
    written = []
    for scene in found.result.scenes:
        for own in scene.against:
            if own.columns is not None:
                changes = found.changes[scene.scene, own.other]
                written.append(folder / own.columns)
                table = changes.shown.table
                parquet.write(written[-1], changes.parts(), KIND, table.voxel_size, table.classes)
    if written:
        keep_only(written, written[0].parent)


def _recorded(found: Found) -> Iterator[tuple[tuple[str, str], tuple[Any, ...]]]:
    for scene in found.result.scenes:
        for own in scene.against:
            if (changes := found.changes.get((scene.scene, own.other))) is not None:
                places = [(place.what, f"{place.number} {place.of}", place.centre) for place in own.places]
                title, shown = heading(found.result, scene.scene, own), changes.shown
                yield (scene.scene, own.other), (title, shown.table, shown.change, shown.right, places)


def _require_own(folder: Path) -> None:
    """Raise ConfigError where the folder holds something else than a comparison: a run's is not written into."""
    if folder.is_file():
        raise ConfigError(f"{folder}: is a file; name a folder")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / CONTENT).exists():
        raise ConfigError(f"{folder}: is not empty and holds no comparison; choose another folder")
