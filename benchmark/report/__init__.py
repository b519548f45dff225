"""report.html: what a run or a study found, on one page that needs no other file, no script and no network."""

from __future__ import annotations

import base64
import io
import itertools
import json
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semstab.core.files import write_text
from semstab.engine.observer import Observer
from semstab.engine.units import PlannedUnit
from semstab.model.records import Failure, Result, UnitContent
from semstab.model.results import slug
from semstab.report import figures
from semstab.report.averages import describe
from semstab.report.figures.style import COLUMN, DPI, Figure
from semstab.report.findings import Answer, Finding, findings
from semstab.report.narrative import reading, verdicts
from semstab.report.remedies import advice, of_interest, remedies
from semstab.report.tables import tables, write_tables
from semstab.report.tables.table import ARROWS, Table, relations, sections

if TYPE_CHECKING:
    from semstab.engine.units import Plan, Planned
    from semstab.model.voxels import VoxelTable
    from semstab.report.figures import DrawingProcess


# The parts of a page that needs no other file: its style, tables and figures.

SCREEN_DPI = 200
"""Dense images are embedded with that many pixels an inch and in 256 colours: a quarter of the file's size."""

CSS_INCH = 122
"""Pixels of the page an inch of a figure: its smallest type then is as large as the text of the tables."""


ABSENT = "absent"
"""What a table notes of a class that covers no voxel: the page names such classes in a line."""


def filled(template: str, **content: Any) -> str:
    """A page, from its template; `style` is there already."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    here = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(here), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    style = (here / "style.css").read_text(encoding="utf-8")
    page: str = environment.get_template(template).render(style=style, **content)
    return page


def blocks(own: Sequence[Table], shown: Sequence[Figure], folder: Path) -> Iterator[dict[str, Any]]:
    """Tables, each with the figure of its name beneath it, then the other figures."""
    beside = {figure.name: figure for figure in shown}
    ordered: list[Table | Figure] = []
    for table in own:
        ordered.append(table)
        if table.name in beside:
            ordered.append(beside.pop(table.name))
    for item in (*ordered, *beside.values()):
        if isinstance(item, Table):
            yield {"kind": "table", "content": table_block(item)}
        else:
            yield {"kind": "figure", "content": figure_block(item, folder)}


def table_block(table: Table) -> dict[str, Any]:
    """A table as the page shows it."""
    headers = [f"{column.header} {ARROWS[column.better]}".strip() for column in table.columns]
    absent = [*dict.fromkeys(row[0] for _, rows in sections(table) for row in rows if row[-1] == ABSENT)]
    left_out = f" Absent: {', '.join(absent)}." if absent else ""
    return {
        "name": table.name,
        "title": relations(table.title),
        "caption": relations(table.caption + left_out),
        "headers": [relations(header) for header in headers],
        "over": _runs([relations(column.over) for column in table.columns]),
        "numeric": [column.digits is not None for column in table.columns],
        "sections": [
            (relations(name), [[_cell(cell) for cell in row] for row in rows if row[-1] != ABSENT])
            for name, rows in sections(table)
        ],
    }


def _runs(names: Sequence[str]) -> list[tuple[str, int]]:
    """Equal neighbours and how many they are; nothing where all are empty."""
    return [(name, len(list(run))) for name, run in itertools.groupby(names)] if any(names) else []


def _cell(text: str) -> str:
    """A cell as typography has it: minus signs, a dash for what is undefined."""
    if text == "--":
        return "\N{EN DASH}"
    number = text[-1:].isdigit() or re.fullmatch(r"[-+]?[\d.,]+ \([-+\d., ]+\)", text)
    return relations(re.sub(r"(^|(?<=\()|(?<=, )|(?<=e))-(?=\d)", "\N{MINUS SIGN}", text) if number else text)


def figure_block(figure: Figure, folder: Path) -> dict[str, Any]:
    """A figure as the page holds it; drawn where FOLDER/figures lacks it."""
    from PIL import Image

    png, svg = (folder / "figures" / f"{figure.name}.{suffix}" for suffix in ("png", "svg"))
    if not (png.exists() and svg.exists()):
        figure.save(folder / "figures")
    with Image.open(png) as image:
        width, height = (edge / DPI for edge in image.size)
        data = _screen_png(image) if figure.dense else svg.read_bytes()
    kind = "png" if figure.dense else "svg+xml"
    return {
        "name": figure.name,
        "title": figure.title,
        "caption": relations(figure.caption),
        "alt": figure.alt,
        "source": f"data:image/{kind};base64,{base64.b64encode(data).decode()}",
        "width": round(width * CSS_INCH),
        "height": round(height * CSS_INCH),
        "narrow": width <= COLUMN * 1.01,
    }


def _screen_png(image: Any) -> bytes:
    """The image at the resolution of a screen, in few colours."""
    from PIL import Image

    size = tuple(round(edge * SCREEN_DPI / DPI) for edge in image.size)
    small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    data = io.BytesIO()
    # the octree keeps colours of small areas, which the median cut merges, and takes a fortieth of its time
    small.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(data, "PNG")
    return data.getvalue()


__all__ = ["Reporting", "write_report"]

MOST_NAMED = 3
"""Scenes that are named in the title."""

WORTH_A_PROCESS = 5.0
"""Seconds of work from which on figures are drawn by two processes."""


class Reporting(Observer):
    """Writes tables, figures and report.html into the folder when all has been computed, by one process or two."""

    def __init__(self, folder: str | Path, *, processes: int = 1) -> None:
        self._folder = Path(folder)
        self._processes = processes
        self._began = time.monotonic()
        self._beside: DrawingProcess | None = None
        self._views = figures.Views()
        self._watched = ""

    def run_started(self, plan: Plan, finished: Mapping[str, UnitContent]) -> None:
        """Figures show the units of the first backend; of the statistics they show more than the map says."""
        self._watched = "" if plan.config.statistics else plan.config.backends[0].name

    def unit_finished(
        self, planned: Planned, content: UnitContent | None, table: VoxelTable | None, error: str | None
    ) -> None:
        """Take from the map what figures show of it."""
        if table is not None and isinstance(planned, PlannedUnit) and planned.unit.backend == self._watched:
            self._views.see(planned.unit, table, planned.task.scene.up)

    def advanced(self, frames: int, what: str) -> None:
        """What takes a while is worth a second process for its figures."""
        if self._beside is None and self._processes > 1 and time.monotonic() - self._began > WORTH_A_PROCESS:
            from semstab.report.figures import DrawingProcess

            self._beside = DrawingProcess()

    def run_finished(self, result: Result) -> None:
        """Write them; nothing where every unit failed."""
        if result.select():
            write_tables(result, self._folder)
            figures.write_figures(result, self._folder, self._views, self._beside)
            write_report(result, self._folder)

    def close(self) -> None:
        """End the second process."""
        if self._beside is not None:
            self._beside.close()


def write_report(result: Result, folder: str | Path) -> list[Path]:
    """Write FOLDER/report.html; return its path.

    Figures are taken from FOLDER/figures, where `write_figures` puts them; one that is missing is drawn.
    """
    path = Path(folder) / "report.html"
    write_text(path, render(result, Path(folder)))
    return [path]


def render(result: Result, folder: Path) -> str:
    """The page."""
    everything, result = result, of_interest(result)
    found = findings(result)
    return filled(
        "report.html.j2",
        kind="Study of temporal semantic stability" if result.sweeps() else "Temporal semantic stability",
        title=_title(result),
        subtitle=_subtitle(result),
        verdicts=[
            *(sentence for each in remedies(everything) for sentence in advice(each)),
            *(relations(sentence) for sentence in verdicts(result)),
        ],
        reading=[relations(sentence) for sentence in reading(result, found) if sentence not in verdicts(result)],
        findings=[_finding(row) for row in found if row.verdict is not Answer.UNTESTED],
        untested=[_finding(row) for row in found if row.verdict is Answer.UNTESTED],
        topics=list(_topics(everything, folder)),
        without_map=[scene for scene in result.scenes if scene not in result.up],
        failures=[_failure(row) for row in result.failures],
        facts=list(_facts(result.manifest)),
        manifest=json.dumps(result.manifest, indent=2, default=str),
    )


# --- What the page says -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Topic:
    """A section: the tables and figures whose names begin with one of the prefixes.

    one_per_backbone  of its figures only the first of each backbone is open at once
    """

    id: str
    title: str
    lead: str
    prefixes: tuple[str, ...]
    one_per_backbone: bool = False


TOPICS = (
    Topic(
        "remedies",
        "What would steady it?",
        "Filters over the same model and frames. Labels that do not change are not yet right: read flicker beside what"
        " it costs.",
        ("remedies",),
    ),
    Topic("glance", "At a glance", "", ("glance", "verdicts", "overview")),
    Topic(
        "flicker",
        "In image space",
        "Flicker compares two frames at the same pixel. A moving camera alone makes labels change there, so that the"
        " motion-compensated share is the one to read.",
        ("flicker",),
    ),
    Topic(
        "scenes",
        "By scene",
        "VSS is the share of a voxel's evidence that its dominant class has, SBD how far the belief moves from one"
        " observation to the next, OP how many frames saw the voxel.",
        ("scenes", "ecdf"),
    ),
    Topic(
        "persistence",
        "By observation persistence",
        "The question behind every number on this page: how often was the place seen?",
        ("persistence",),
    ),
    Topic(
        "classes",
        "By class",
        "A class whose places are seen more often has had more chances to be contradicted.",
        ("classes",),
    ),
    Topic(
        "agreement_of_frames",
        "Do the frames agree about a place?",
        "These measures are unchanged by random thinning of the frames. Read alpha between frames beside its ceiling: 1"
        " is perfect, 0 is what chance gives; where its interval is wide, the data do not decide. How much frames agree"
        " depends on how far apart they look from. Agreement is not truth.",
        ("temporal_agreement", "correlogram", "class_agreement"),
    ),
    Topic(
        "drift",
        "Does the belief drift?",
        "SBD is largest for noise seen twice and falls with every further look. Where it equals what a random order of"
        " the same observations gives, that fall is arithmetic. A belief that moves one way over time shows in the"
        " trend, not in SBD.",
        ("drift",),
    ),
    Topic(
        "backbones",
        "Backbones in one taxonomy",
        "Compare backbones where voxels recur, and look at their recurrent shares beside.",
        ("cross_backbone",),
    ),
    Topic(
        "comparison",
        "Which backbone is steadier?",
        "On the same places, and at the same number of looks. A difference counts where its interval leaves out 0; look"
        " at what each map covers before.",
        ("comparison",),
    ),
    Topic(
        "ceiling",
        "Geometry or model?",
        "Labels that never err disagree as well, where pixels fall into the wrong voxel or a voxel holds two things."
        " Only the rest can be the model's.",
        ("ceiling",),
    ),
    Topic(
        "correctness",
        "Is what is stable also right?",
        "Stable and wrong is the dangerous part: no second look reveals it. Do not compare accuracy between strata as"
        " if the number of looks caused it: what is seen often is another part of the scene.",
        ("correctness", "quadrants"),
    ),
    Topic(
        "rules",
        "Does the rule of fusion matter?",
        "The same observations under other rules. If the order of the backbones changes, do not rest a choice on it.",
        ("rules",),
    ),
    Topic(
        "maps",
        "Where it is unstable",
        "Stable: seen three times or more, a clear answer, little drift. Low persistence says nothing either way."
        " Entropy within frames lies at borders and in voxels larger than things, entropy between them where frames"
        " disagree.",
        ("uncertainty", "stability_map"),
        one_per_backbone=True,
    ),
    Topic(
        "sensitivity",
        "What the association does to the numbers",
        "Voxel size, noise and sampling change which observations meet in a voxel, and so how many voxels could be"
        " contradicted at all. Compare the values over all voxels with those of the recurrent ones and their share, and"
        " with the share that agreement reaches of its ceiling, which hardly moves.",
        ("sensitivity",),
    ),
    Topic(
        "fusion",
        "Fusion implementations",
        "The same frames through other code: does the map, and what is measured on it, stay the same?",
        ("fusion", "agreement"),
    ),
)


def _topics(result: Result, folder: Path) -> Iterator[dict[str, Any]]:
    """The sections for which the study has tables or figures."""
    all_tables, all_figures = tables(result), figures.figures(result, folder)
    for topic in TOPICS:
        shown = [figure for figure in all_figures if figure.name.startswith(topic.prefixes)]
        first, folded = _unfolded(shown, result) if topic.one_per_backbone else (shown, [])
        own = [table for table in all_tables if table.name.startswith(topic.prefixes)]
        if own or shown:
            yield {
                "id": topic.id,
                "title": topic.title,
                "lead": topic.lead,
                "blocks": list(blocks(own, first, folder)),
                "folded": [figure_block(figure, folder) for figure in folded],
            }


def _unfolded(shown: Sequence[Figure], result: Result) -> tuple[list[Figure], list[Figure]]:
    """The first figure of each kind and backbone, and the rest."""
    first: dict[tuple[str, str], Figure] = {}
    for figure in shown:
        for backbone in result.backbones:
            if figure.name.endswith(f"__{slug(backbone)}"):
                first.setdefault((figure.name.partition("__")[0], backbone), figure)
    return list(first.values()), [figure for figure in shown if figure not in first.values()]


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "claim": finding.claim,
        "rule": relations(finding.rule),
        "caveat": relations(finding.caveat),
        "verdict": finding.said,
        "kind": finding.verdict.name.lower() if finding.said == finding.verdict.value else "part",
        "evidence": [
            {
                "what": ", ".join(filter(None, (row.backbone, row.condition))),
                "verdict": row.verdict.value,
                "kind": row.verdict.name.lower(),
                "numbers": relations(row.outcome.numbers),
                "why": relations(row.outcome.why),
                "scenes": f"{row.scenes[0]} of {row.scenes[1]} scenes" if row.scenes[1] > 1 else "",
            }
            for row in finding.evidence
        ],
    }


def _title(result: Result) -> str:
    """The name of a study; of a run, which has none, its scenes."""
    if result.sweeps():
        return result.name
    scenes = result.scenes
    return ", ".join(scenes) if len(scenes) <= MOST_NAMED else f"{len(scenes)} scenes"


def _subtitle(result: Result) -> str:
    units = {record.key for record in result.records}  # a sweep shares some with the base, as the manifest counts them
    counts = [(len(result.scenes), "scene"), (len(result.backbones), "backbone"), (len(units), "unit")]
    parts = [f"{n:,} {name}{'' if n == 1 else 's'}" for n, name in counts]
    return " · ".join([*parts, f"fused by {result.backend}"])


def _failure(failure: Failure) -> dict[str, str]:
    unit, variation = failure.unit, failure.variation
    value = "" if variation.value is None else f" {describe(variation.sweep).text(variation.value)}"
    return {
        "unit": f"{unit.scene}, {unit.backbone}, {unit.backend}",
        "variation": f"{describe(variation.sweep).title}{value}, repeat {variation.repeat}",
        "message": failure.message,
    }


def _facts(manifest: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The manifest's short entries, by name."""
    for key, value in manifest.items():
        if isinstance(value, Mapping):
            short = len(value) <= 12 and not any(isinstance(item, Mapping | list) for item in value.values())
            text = ", ".join(f"{name} {_short(item)}" for name, item in value.items()) if short else ""
        elif isinstance(value, Sequence) and not isinstance(value, str):
            text = " ".join(str(item) for item in value)
        else:
            text = "" if value is None else _short(value)
        if text:
            yield key.replace("_", " "), text


def _short(value: Any) -> str:
    return f"{value:,.1f}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)
