"""A number has one name and one value: what terminal, page, tables, JSON, Python, compare and gate say is read back."""

from __future__ import annotations

import csv
import io
import json
import math
import re

import pytest
from rich.console import Console
from typer.testing import CliRunner

import semstab
from semstab.cli import app
from semstab.comparison.quantities import quantities
from semstab.report import write_report
from semstab.report.tables import save_tables, tables
from semstab.report.terminal import print_answer

CITY = {"name": "city", "options": {"frames": 14, "width": 192, "height": 108, "seed": 1}}
KINDS = {
    "labels": {"models": ["sim-steady"], "truth": False},
    "scores": {"models": ["sim-soft"], "truth": False},
    "truth": {"models": ["sim-flicker"]},
    "two models": {"models": ["sim-steady", "sim-flicker"]},
    "two scenes": {"models": ["sim-flicker"], "scenes": ["scene0", "scene1"]},
}


@pytest.fixture(scope="module", params=KINDS)
def run(request, tmp_path_factory):
    """A finished run and its folder."""
    folder = tmp_path_factory.mktemp("numbers") / "run"
    settings = {"dataset": CITY, "scenes": ["scene0"], "voxel_size": 0.5, "check": None, "check_geometry": False}
    return semstab.run(settings | KINDS[request.param], out=folder), folder


def numbers_of(record):
    """The numbers of a unit by their names, from its record in memory."""
    own, recurrent = record.statistics, record.summary.table.recurrent
    found = {
        "alpha": own.headline.alpha.value,
        "VSS (OP>=3)": recurrent.means.value["vss"],
        "SBD (OP>=3)": recurrent.means.value["sbd"],
        "PSA (OP>=2)": own.headline.psa_op2.value,
        "flicker, %": record.image_space.compensated_flicker_percent,
    }
    if own.correctness is not None:
        found |= {
            "accuracy (OP>=2)": own.correctness.accuracy_op2.value,
            "mIoU (OP>=2)": own.correctness.miou_op2.value,
            "consistent but wrong (OP>=3)": own.headline.wrong_of_consistent_op3.value,
        }
    return found


def agree(printed, value):
    """Whether a printed number is the value, rounded to its digits."""
    text = printed.strip().removesuffix("%").strip()
    digits = len(text.partition(".")[2])
    return math.isclose(float(text), value, abs_tol=0.5 * 10**-digits + 1e-9)


def rows_of_csv(file):
    return list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))


def screen(result):
    text = io.StringIO()
    print_answer(result, Console(file=text, width=120))
    return text.getvalue()


def test_the_screen_has_the_numbers_of_the_record(run):
    result, _ = run
    if len(result.scenes) > 1:
        return  # the next test reads its rows
    lines = screen(result).splitlines()
    for record in result.select():
        numbers = numbers_of(record)
        if len(result.models) == 1:
            (paper,) = (line for line in lines if "paper (OP>=3)" in line)
            found = re.search(r"VSS (\S+)\s+SBD (\S+)", paper)
            shown = dict(zip(("VSS (OP>=3)", "SBD (OP>=3)"), found.groups(), strict=True))
            shown["alpha"] = re.search(r"alpha (-?\.\d+|-?\d\.\d+)", "\n".join(lines))[1]
            shown["flicker, %"] = re.search(r"flicker\s+(\S+) %", "\n".join(lines))[1]
        else:
            (heads,) = (k for k, line in enumerate(lines) if line.split()[:2] == ["model", "verdict"])
            assert lines[heads + 1].split() == ["%", "%", "OP>=3", "OP>=3", "OP>=2"]
            row = next(line for line in lines[heads:] if line.split()[:1] == [record.unit.model])
            flicker, vss, sbd, miou = row.split()[-4:]
            shown = {"flicker, %": flicker, "VSS (OP>=3)": vss, "SBD (OP>=3)": sbd, "mIoU (OP>=2)": miou}
        for name, printed in shown.items():
            assert printed == "-" or agree(printed, numbers[name]), name


def test_tables_have_the_numbers_of_the_record_in_csv_and_json(run, tmp_path):
    result, _ = run
    save_tables(tables(result), tmp_path)
    columns = {
        "overview": {"vss_op3": "VSS (OP>=3)", "sbd_op3": "SBD (OP>=3)"},
        "verdicts": {"alpha": "alpha"},
        "temporal_agreement": {"alpha": "alpha", "psa": "PSA (OP>=2)"},
    }
    for table, named in columns.items():
        rows = rows_of_csv(tmp_path / "tables" / f"{table}.csv")
        content = json.loads((tmp_path / "tables" / f"{table}.json").read_text(encoding="utf-8"))["rows"]
        for record in result.select() if len(result.scenes) == 1 else ():
            numbers = numbers_of(record)
            mine = [row for row in (*rows, *content) if row["model"] == record.unit.model]
            assert len(mine) >= 2
            for row in mine:
                for key, name in named.items():
                    shown = row[key]["value"] if isinstance(row[key], dict) else row[key]
                    if isinstance(shown, str):
                        assert shown in ("", "-") or agree(shown, numbers[name]), (table, key)
                    elif shown is not None:
                        assert shown == pytest.approx(numbers[name]), (table, key)
    if "mIoU (OP>=2)" in numbers_of(result.records[0]) and len(result.scenes) == 1:
        rows = rows_of_csv(tmp_path / "tables/correctness.csv")
        for record in result.select():
            (row,) = (r for r in rows if (r["model"], r["persistence"]) == (record.unit.model, "OP>=2"))
            assert agree(row["miou"], numbers_of(record)["mIoU (OP>=2)"])


def test_python_and_summary_json_have_them_under_names_with_the_population(run):
    result, folder = run
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    for record, row, content in zip(
        result.select(), semstab.load(folder).summary.to_dict("records"), summary["runs"], strict=True
    ):
        numbers = numbers_of(record)
        for key, name in {"alpha": "alpha", "vss_op3": "VSS (OP>=3)", "sbd_op3": "SBD (OP>=3)"}.items():
            assert row[key] == pytest.approx(numbers[name], nan_ok=True)
        assert not {"vss", "sbd", "entropy", "miou", "accuracy"} & row.keys()
        assert content["statistics"]["headline"]["alpha"]["value"] == pytest.approx(numbers["alpha"])
        assert content["recurrent"]["vss"] == pytest.approx(numbers["VSS (OP>=3)"])


def test_compare_and_gate_judge_the_numbers_of_the_screen(run):
    """A run compared with itself has its own numbers, each under the name that has its population."""
    result, folder = run
    titles = {quantity.key: quantity.named for quantity in quantities()}
    for record in result.select():
        own = f"{folder}:{record.unit.model}"
        (scene,) = (s for s in semstab.compare(own, own).scenes if s.scene == record.unit.scene)
        shown = {titles[row.measure].lower(): row.base for row in scene.against[0].contrasts}
        numbers = {name.lower().removesuffix(", %"): value for name, value in numbers_of(record).items()}
        known = {name: value for name, value in numbers.items() if not math.isnan(value)}
        assert known.keys() <= shown.keys()
        for name, value in known.items():
            assert shown[name] == pytest.approx(value, abs=2e-6, nan_ok=True), name
        rules = {"alpha": "alpha", "vss": "vss (op>=3)", "sbd": "sbd (op>=3)", "psa": "psa (op>=2)"}
        rules |= {"accuracy": "accuracy (op>=2)", "miou": "miou (op>=2)"} if "miou (op>=2)" in numbers else {}
        config = semstab.GateConfig(rules=tuple(f"scene {record.unit.scene}: {rule} > -1" for rule in rules))
        for rule, judged in zip(rules.values(), semstab.gate(own, None, config).judgements, strict=True):
            assert judged.new == pytest.approx(numbers[rule], abs=2e-6), rule
            population = rule.partition("(")[2].rstrip(")").upper()
            assert judged.values.startswith(f"{population}: " if population else judged.values[:1])


def test_the_page_and_the_command_line_print_them(run, tmp_path):
    result, folder = run
    page = write_report(result, folder).read_text(encoding="utf-8")
    if len(result.records) == 1:
        for name, value in numbers_of(result.records[0]).items():
            if name in ("VSS (OP>=3)", "SBD (OP>=3)", "mIoU (OP>=2)"):
                card = re.search(
                    rf"{re.escape(name).replace('>=', '(?:>=|&gt;=|≥| ≥ )')}.{{0,200}}?>(-|\d?\.\d+)<", page, re.S
                )
                assert card is not None, name
                assert card[1] == "-" or agree(card[1], value), name
    done = CliRunner().invoke(app, ["gate", f"{folder}:{result.models[0]}", "--rule", "vss > 0.01"])
    assert done.exit_code in (0, 5), done.output
    assert "OP>=3: " in done.output
