"""What a gate found, for people and programs: lines, Markdown for a pull request, JSON, JUnit XML."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from semstab.comparison.gate import POWER, GateResult, Verdict
from semstab.core.files import write_text
from semstab.core.json_form import to_json
from semstab.errors import ConfigError

SCHEMA = 1
INDENT = 10
OUTCOMES: Mapping[Verdict, str] = {"passes": "passes", "fails": "fails", "undecided": "is undecided"}
SIGNS: Mapping[Verdict, str] = {"passes": "✅", "fails": "❌", "undecided": "❔"}


def headline(result: GateResult) -> str:
    """'1 fails, 2 pass: the gate fails'; a gate with rules that the data leave open is undecided, never passed."""
    counts = [(n, verdict) for verdict in ("fails", "undecided", "passes") if (n := result.count(verdict))]
    plural = {"fails": "fail", "passes": "pass", "undecided": "undecided"}
    listed = ", ".join(f"{n} {verdict if n == 1 else plural[verdict]}" for n, verdict in counts)
    return f"{listed}: the gate {OUTCOMES[result.outcome]}"


def lines(result: GateResult, width: int = 80) -> Iterator[str]:
    """For the terminal: the outcome, a line a rule, and why rules are undecided or fail."""
    yield headline(result)
    against = f" against {result.against}" if result.against else ""
    yield from _wrapped(f"  {result.new}{against}, {_scenes(result)}; {_ends(result)}", width, 2)
    for note in result.notes:
        yield from _wrapped(f"  {note}", width, 2)
    yield ""
    longest = max((len(each.rule.text) for each in result.judgements), default=0)
    for each in result.judgements:
        yield from _wrapped(f"  {each.verdict.upper():<9}  {each.rule.text:<{longest}}  {each.values}", width, 13)
    yield ""
    for why in dict.fromkeys(f"{each.verdict}: {each.reason} ({each.about})" for each in result.judgements):
        yield from _wrapped(f"  {why}", width, 4)
    if result.count("undecided"):
        yield "  more     --plan: how many frames each rule needs; --out gate.md"


def plan(result: GateResult) -> Iterator[str]:
    """For the terminal: how many frames each rule needs, by the spread of these runs."""
    yield f"frames from which on a rule is decided with a probability of {POWER:.0%}, by the spread of these runs"
    for each in result.judgements:
        needed, now = each.frames_needed(result.level), each.found.frames
        text = f"{needed:,} ({now} now)" if needed else "no number of frames tells"
        yield f"  {each.rule.text}: {text}"


def _wrapped(line: str, width: int, indent: int) -> list[str]:
    return textwrap.wrap(line, max(width, 40), subsequent_indent=" " * indent, break_on_hyphens=False)


def _ends(result: GateResult) -> str:
    return f"either end of an interval is missed in {100 * result.level:g} % of cases"


def _scenes(result: GateResult) -> str:
    some = ", ".join(result.scenes[:3])
    return some if len(result.scenes) <= 3 else f"mean of {len(result.scenes)} scenes: {some}, ..."


# --- Files ------------------------------------------------------------------------------------------------------------


def markdown(result: GateResult) -> str:
    """A summary for a pull request."""
    against = f" against {_code(result.against)}" if result.against else ""
    rows = [
        f"| {SIGNS[each.verdict]} {each.verdict} | {_code(each.rule.text)} | {each.values} | {_cell(each.reason)}"
        f" ({each.about}) |"
        for each in result.judgements
    ]
    text = [
        f"### {SIGNS[result.outcome]} semstab gate: {headline(result)}",
        "",
        f"{_code(result.new)}{against}, {_cell(_scenes(result))}; {_ends(result)}.",
        *(f"\n{_cell(note)}" for note in result.notes),
        "",
        "| | rule | found | why (for which data) |",
        "|---|---|---|---|",
        *rows,
    ]
    return "\n".join(text) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _code(text: str) -> str:
    return "`" + _cell(text).replace("`", "'") + "`"


def as_json(result: GateResult) -> str:
    """For programs."""
    rows = [
        {
            "rule": each.rule.text, "verdict": each.verdict, "measure": each.rule.measure.name,
            "class": each.rule.class_name, "scene": each.rule.scene, "change": each.rule.change,
            "limit": each.rule.limit, "new": each.new, "base": each.base, "found": each.found, "reason": each.reason,
            "about": each.about,
        }
        for each in result.judgements
    ]  # fmt: skip
    content = {
        "schema": SCHEMA, "gate": result.outcome, "new": result.new,
        "against": result.against or None, "scenes": result.scenes, "level": result.level,
        "undecided": result.undecided, "notes": result.notes, "rules": [to_json(row) for row in rows],
    }  # fmt: skip
    return json.dumps(to_json(content), indent=2) + "\n"


def junit(result: GateResult) -> str:
    """JUnit XML: a test case a rule; one that is undecided is skipped, or a failure where that fails."""
    undecided_fails = result.undecided == "fail"
    failures = result.count("fails") + (result.count("undecided") if undecided_fails else 0)
    skipped = 0 if undecided_fails else result.count("undecided")
    suite = ElementTree.Element(
        "testsuite", name="semstab gate", tests=str(len(result.judgements)), failures=str(failures), errors="0",
        skipped=str(skipped),
    )  # fmt: skip
    for each in result.judgements:
        case = ElementTree.SubElement(suite, "testcase", classname="semstab.gate", name=_xml(each.rule.text), time="0")
        if each.verdict == "fails" or (each.verdict == "undecided" and undecided_fails):
            ElementTree.SubElement(case, "failure", message=_xml(f"{each.values}: {each.reason}"))
        elif each.verdict == "undecided":
            ElementTree.SubElement(case, "skipped", message=_xml(f"undecided: {each.reason}"))
        ElementTree.SubElement(case, "system-out").text = _xml(f"{each.values}; {each.reason} ({each.about})")
    ElementTree.indent(suite)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(suite, encoding="unicode") + "\n"


def _xml(text: str) -> str:
    """Without what XML 1.0 has no way to write."""
    return re.sub(r"[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)


WRITERS: Mapping[str, Callable[[GateResult], str]] = {".xml": junit, ".md": markdown, ".json": as_json}


def require_formats(files: Sequence[Path]) -> None:
    """Raise ConfigError for a file whose suffix names no format, before anything is computed."""
    for file in files:
        if file.suffix.lower() not in WRITERS:
            raise ConfigError(f"{file}: format '{file.suffix}' is not known; use .xml (JUnit), .md or .json")


def write(result: GateResult, file: Path) -> None:
    """In the format that the file's suffix names."""
    write_text(file, WRITERS[file.suffix.lower()](result))
