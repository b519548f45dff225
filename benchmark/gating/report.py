"""The result of a gate for people and programs: lines, Markdown for a pull request, JSON, JUnit XML."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from semstab.core.console import wrapped
from semstab.core.files import write_text
from semstab.core.json_form import to_json
from semstab.core.types import SCOPE_WORDS
from semstab.errors import ConfigError
from semstab.gating.result import POWER, GateResult, Verdict

SCHEMA = 1
INDENT = 10
MOST_NAMED = 4
"""Most rules of each verdict that the headline names."""

OUTCOMES: Mapping[Verdict, str] = {"passes": "passes", "fails": "fails", "undecided": "is undecided"}
SIGNS: Mapping[Verdict, str] = {"passes": "✅", "fails": "❌", "undecided": "❔"}


def headline(result: GateResult) -> str:
    """Return the outcome and the rules that decided.

    An example is "the gate fails: 'alpha > 0.8' fails; 1 of 2 rules is undecided: ...".
    """
    return f"the gate {OUTCOMES[result.outcome]}: {'; '.join(decided_by(result))}"


def decided_by(result: GateResult) -> tuple[str, ...]:
    """Return sentences on the rules that decided a gate, then on the others."""
    texts = {
        verdict: _summary_of(result, verdict)
        for verdict in ("fails", "undecided", "passes")
        if result.count(verdict) and not (verdict == "passes" and result.count("fails"))
    }
    if result.passed:
        texts = dict(reversed(texts.items()))
    return tuple(texts.values())


def _summary_of(result: GateResult, verdict: Verdict) -> str:
    """Return '2 of 4 rules are undecided: ...'."""
    n, rules = result.count(verdict), len(result.judgements)
    if verdict == "fails":
        return f"{_named(result, verdict)} {'fails' if n == 1 else 'fail'}"
    many = f"{n} of {rules} rules"
    if verdict == "passes":
        return f"{_named(result, verdict)} passes" if rules == 1 else f"{many} {'passes' if n == 1 else 'pass'}"
    counts = {"report": "", "pass": ", which counts as passed", "fail": ", which counts as failed"}[result.undecided]
    if rules == 1:
        return f"{_named(result, verdict)} is undecided{counts}"
    return f"{many} {'is' if n == 1 else 'are'} undecided{counts}: {_named(result, verdict, ', ')}"


def _named(result: GateResult, verdict: Verdict, last: str = " and ") -> str:
    """Return the rules of a verdict, the first ones by their text."""
    rules = [f"'{judgement.rule.text}'" for judgement in result.judgements if judgement.verdict == verdict]
    if len(rules) > MOST_NAMED:
        return f"{', '.join(rules[:MOST_NAMED])}{last}{len(rules) - MOST_NAMED} more"
    return last.join(filter(None, [", ".join(rules[:-1]), rules[-1]]))


def lines(result: GateResult, width: int = 80) -> Iterator[str]:
    """Yield lines for the terminal: the outcome, a line per rule, and why rules are undecided or fail."""
    width = max(width, 40)
    yield from wrapped(headline(result), width, begin="", hanging=2)
    against = f" against {result.against}" if result.against else ""
    yield from wrapped(f"{result.new}{against}, {_scenes(result)}; {_ends(result)}", width, hanging=2)
    for note in result.notes:
        yield from wrapped(note, width, hanging=2)
    yield ""
    longest = max((len(judgement.rule.text) for judgement in result.judgements), default=0)
    for judgement in result.judgements:
        text = f"{judgement.verdict.upper():<9}  {judgement.rule.text:<{longest}}  {judgement.values}"
        yield from wrapped(text, width, hanging=13)
    yield ""
    reasons: dict[str, list[str]] = {}
    for judgement in result.judgements:
        reasons.setdefault(f"{judgement.verdict}: {judgement.reason} ({SCOPE_WORDS[judgement.about]})", []).append(
            judgement.rule.text
        )
    for why, rules in reasons.items():
        rules_text = f": {', '.join(rules)}" if len(reasons) > 1 else ""
        yield from wrapped(f"{why}{rules_text}", width)
    if result.count("undecided"):
        yield "  more     --plan: how many frames each rule needs; --out gate.md"


def plan(result: GateResult) -> Iterator[str]:
    """Yield lines for the terminal: how many frames each rule needs, by the spread of these runs."""
    yield f"frames in all that decide a rule with a probability of {POWER:.0%}, if they vary as these runs do"
    for judgement in result.judgements:
        needed, now = judgement.frames_needed(result.level), judgement.interval.frames
        text = (
            f"{needed:,} ({now} now)"
            if needed
            else "counted"
            if judgement.counted
            else "no number of frames decides it"
        )
        yield f"  {judgement.rule.text}: {text}"


def _ends(result: GateResult) -> str:
    both, one = 100 * (1 - 2 * result.level), 100 * (1 - result.level)
    return f"intervals hold with {both:g} % confidence, each end with {one:g} %"


def _scenes(result: GateResult) -> str:
    first = ", ".join(result.scenes[:3])
    return first if len(result.scenes) <= 3 else f"mean of {len(result.scenes)} scenes: {first}, ..."


# --- Files ------------------------------------------------------------------------------------------------------------


def markdown(result: GateResult) -> str:
    """Return a summary for a pull request."""
    against = f" against {_code(result.against)}" if result.against else ""
    rows = [
        f"| {SIGNS[judgement.verdict]} {judgement.verdict} | {_code(judgement.rule.text)} | {judgement.values} | "
        f"{_cell(judgement.reason)} ({judgement.about}) |"
        for judgement in result.judgements
    ]
    text = [
        f"### {SIGNS[result.outcome]} semstab: the gate {OUTCOMES[result.outcome]}",
        "",
        f"{_plain('; '.join(decided_by(result)))}.",
        "",
        f"{_code(result.new)}{against}, {_cell(_scenes(result))}; {_ends(result)}.",
        *(f"\n{_cell(note)}" for note in result.notes),
        "",
        "| | rule | found | why (for which data) |",
        "|---|---|---|---|",
        *rows,
    ]
    return "\n".join(text) + "\n"


def _plain(text: str) -> str:
    """Return text that Markdown prints as it is, as a rule may name any class."""
    return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", text)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _code(text: str) -> str:
    return "`" + _cell(text).replace("`", "'") + "`"


def as_json(result: GateResult) -> str:
    """Return the result as JSON."""
    rows = [
        {
            "rule": judgement.rule.text, "verdict": judgement.verdict, "measure": judgement.rule.measure.quantity.name,
            "class": judgement.rule.class_name, "scene": judgement.rule.scene, "change": judgement.rule.change,
            "limit": judgement.rule.limit, "new": judgement.new, "base": judgement.base,
            "found": judgement.interval, "reason": judgement.reason, "about": judgement.about,
        }
        for judgement in result.judgements
    ]  # fmt: skip
    content = {
        "schema": SCHEMA, "gate": result.outcome, "exit_code": result.exit_code, "new": result.new,
        "against": result.against or None, "scenes": result.scenes, "level": result.level,
        "undecided": result.undecided, "notes": result.notes, "rules": [to_json(row) for row in rows],
    }  # fmt: skip
    return json.dumps(to_json(content), indent=2) + "\n"


def junit(result: GateResult) -> str:
    """Return JUnit XML with a test case per rule; an undecided one is skipped, or a failure where that fails.

    Properties of the suite are the outcome of the gate and the exit code.
    """
    undecided_fails = result.undecided == "fail"
    failures = result.count("fails") + (result.count("undecided") if undecided_fails else 0)
    skipped = 0 if undecided_fails else result.count("undecided")
    suite = ElementTree.Element(
        "testsuite", name="semstab gate", tests=str(len(result.judgements)), failures=str(failures), errors="0",
        skipped=str(skipped),
    )  # fmt: skip
    properties = ElementTree.SubElement(suite, "properties")
    for name, content in (("gate", result.outcome), ("exit_code", str(result.exit_code))):
        ElementTree.SubElement(properties, "property", name=name, value=content)
    for judgement in result.judgements:
        case = ElementTree.SubElement(
            suite, "testcase", classname="semstab.gate", name=_xml(judgement.rule.text), time="0"
        )
        if judgement.verdict == "fails" or (judgement.verdict == "undecided" and undecided_fails):
            ElementTree.SubElement(case, "failure", message=_xml(f"{judgement.values}: {judgement.reason}"))
        elif judgement.verdict == "undecided":
            ElementTree.SubElement(case, "skipped", message=_xml(f"undecided: {judgement.reason}"))
        ElementTree.SubElement(case, "system-out").text = _xml(
            f"{judgement.values}; {judgement.reason} ({judgement.about})"
        )
    ElementTree.indent(suite)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(suite, encoding="unicode") + "\n"


def _xml(text: str) -> str:
    """Return the text without characters that XML 1.0 cannot hold."""
    return re.sub(r"[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)


WRITERS: Mapping[str, Callable[[GateResult], str]] = {".xml": junit, ".md": markdown, ".json": as_json}


def require_formats(files: Sequence[Path]) -> None:
    """Raise ConfigError for a file whose suffix names no format, before anything is computed."""
    for file in files:
        if file.suffix.lower() not in WRITERS:
            raise ConfigError(f"{file}: format '{file.suffix}' is not known; use .xml (JUnit), .md or .json")


def write(result: GateResult, file: Path) -> None:
    """Write the result in the format that the file's suffix names."""
    write_text(file, WRITERS[file.suffix.lower()](result))
