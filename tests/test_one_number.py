"""A number has one name and one value: what every screen and file says of it is read back.

These are terminal, page, tables, JSON, Python, compare, gate, leaderboard and recording; of labels, scores, truth,
scans and videos.
"""

from __future__ import annotations

import csv
import html
import io
import json
import math
import re

import pytest
import video_scene
from command_line import bench
from corners import corners
from rich.console import Console
from street import Street, write_street
from test_leaderboard import define, write_scene
from test_recording import read, series
from typer.testing import CliRunner

import semstab
from semstab.cli import app
from semstab.comparison.quantities import quantities
from semstab.data.measures import measures
from semstab.data.statistics import short
from semstab.leaderboard.board import boards, headline, lines
from semstab.leaderboard.definition import load_benchmark
from semstab.recording import Recording
from semstab.recording.timeline import path
from semstab.report import write_report
from semstab.report.tables import tables, write_tables
from semstab.report.terminal import print_answer

CITY = {"name": "city", "options": {"frames": 14, "width": 96, "height": 54, "seed": 1}}
LARGE = {"name": "city", "options": {**CITY["options"], "width": 192, "height": 108}}
"""Large enough to say what moved, and so alpha of what stayed."""

KINDS = {
    "labels": {"models": ["sim-steady"], "truth": False},
    "scores": {"models": ["sim-soft"], "truth": False},
    "truth": {"models": ["sim-flicker"], "dataset": LARGE, "voxel_size": 0.5},
    "two models": {"models": ["sim-steady", "sim-flicker"]},
    "two scenes": {"models": ["sim-flicker"], "scenes": ["scene0", "scene1"]},
    "scans": {"models": ["flips"]},
}


@pytest.fixture(scope="module", params=corners(KINDS, always=("scores", "truth", "two scenes", "scans")))
def run(request, tmp_path_factory):
    """A finished run and its folder."""
    folder = tmp_path_factory.mktemp("numbers") / "run"
    settings = {"dataset": CITY, "scenes": ["scene0"], "voxel_size": 0.8, "check": None, "check_geometry": False}
    if request.param == "scans":
        scans = folder.with_name("scans") / "00"
        write_street(scans, Street.made(seed=0))
        settings |= {"dataset": {"name": "semantickitti", "options": {"root": str(scans)}}, "scenes": ["00"]}
    recording = Recording(folder.with_name("recording.rrd"))
    return semstab.run(settings | KINDS[request.param], out=folder, observers=[recording]), folder


WITHOUT = {"vss", "sbd", "entropy", "margin", "psa", "miou", "accuracy", "voxel_alpha", "wrong_of_consistent"}
"""Names of numbers without their population."""


def numbers_of(record):
    """The numbers of a unit by their names, from its record in memory."""
    statistics, recurrent = record.statistics, record.map_summary.recurrent
    found = {
        "alpha": statistics.headline.alpha.value,
        "VSS (OP>=3)": recurrent.means.value["vss"],
        "SBD (OP>=3)": recurrent.means.value["sbd"],
        "PSA (OP>=2)": statistics.headline.psa_op2.value,
        "flicker, %": record.image_space.compensated_flicker_percent,
    }
    if statistics.correctness is not None:
        found |= {
            "accuracy (OP>=2)": statistics.correctness.accuracy_op2.value,
            "mIoU (OP>=2)": statistics.correctness.miou_op2.value,
            "consistent but wrong (OP>=3)": statistics.headline.wrong_of_consistent_op3.value,
        }
    return found


def agree(printed, value):
    """Whether a printed number is the value, rounded to its digits."""
    if math.isnan(value):
        return printed.strip() in ("", "-", "--")
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
    result, folder = run
    lines = screen(result).splitlines()
    if len(result.scenes) > 1:
        write_tables(tables(result), folder.with_name("of all"))
        rows = {row["model"]: row for row in rows_of_csv(folder.with_name("of all") / "tables/overview.csv")}
        heads = next(k for k, line in enumerate(lines) if line.split()[:2] == ["all", "scenes"])
        assert lines[heads + 1].split() == ["%", "%", "OP>=3", "OP>=3", "OP>=2"]
        for model in result.models:
            *_, flicker, vss, sbd, miou = next(line.split() for line in lines[heads:] if line.split()[:1] == [model])
            alpha = re.search(rf"^ +{model} .*? (-?\d?\.\d+)", "\n".join(lines[heads:]), re.M)[1]
            of_all = {"alpha": alpha, "compensated_flicker_percent": flicker, "vss_op3": vss, "sbd_op3": sbd}
            for key, printed in of_all.items():
                half = 0.5 * 10.0 ** -len(printed.partition(".")[2])  # of the last digit; the table has its own
                assert math.isclose(float(printed), float(rows[model][key]), abs_tol=1.11 * half), key
            right = [numbers_of(record)["mIoU (OP>=2)"] for record in result.select(model=model)]
            assert agree(miou, sum(right) / len(right))
        return
    for record in result.select():
        numbers = numbers_of(record)
        if len(result.models) == 1:
            (paper,) = (line for line in lines if "in 3 frames or more: " in line)
            found = re.search(r"VSS (\S+), SBD (\S+)", paper)
            printed = dict(zip(("VSS (OP>=3)", "SBD (OP>=3)"), found.groups(), strict=True))
            text = " ".join(" ".join(lines).split())
            if (static := record.statistics.static) is None:
                printed["alpha"] = re.search(r"alpha (-?\.\d+|-?\d\.\d+)", text)[1]
            else:
                printed["alpha"] = re.search(r"what stayed \S+, of all (-?\.\d+|-?\d\.\d+);", text)[1]
                assert agree(re.search(r"alpha \(static\) (-?\.\d+|-?\d\.\d+)", text)[1], static.alpha.value)
            flicker = re.search(r"flicker\s+(\S+) %", "\n".join(lines))
            printed["flicker, %"] = "-" if flicker is None else flicker[1]
        else:
            (heads,) = (k for k, line in enumerate(lines) if line.split()[:2] == ["model", "verdict"])
            assert lines[heads + 1].split()[2:] == ["%", "%", "OP>=3", "OP>=3", "OP>=2"]
            row = next(line for line in lines[heads:] if line.split()[:1] == [record.unit.model])
            flicker, vss, sbd, miou = row.split()[-4:]
            printed = {"flicker, %": flicker, "VSS (OP>=3)": vss, "SBD (OP>=3)": sbd, "mIoU (OP>=2)": miou}
        for name, cell in printed.items():
            assert cell == "-" or agree(cell, numbers[name]), name


def test_tables_have_the_numbers_of_the_record_in_csv_and_json(run, tmp_path):
    result, _ = run
    write_tables(tables(result), tmp_path)
    columns = {
        "overview": {"vss_op3": "VSS (OP>=3)", "sbd_op3": "SBD (OP>=3)"},
        "verdicts": {"alpha": "alpha"},
        "temporal_agreement": {"alpha": "alpha", "psa_op2": "PSA (OP>=2)"},
    }
    for table, titles in columns.items():
        rows = rows_of_csv(tmp_path / "tables" / f"{table}.csv")
        content = json.loads((tmp_path / "tables/tables.json").read_text(encoding="utf-8"))[table]["rows"]
        for record in result.select() if len(result.scenes) == 1 else ():
            numbers = numbers_of(record)
            mine = [row for row in (*rows, *content) if row["model"] == record.unit.model]
            assert len(mine) >= 2
            for row in mine:
                for key, name in titles.items():
                    cell = row[key]["value"] if isinstance(row[key], dict) else row[key]
                    if isinstance(cell, str):
                        assert cell in ("", "-") or agree(cell, numbers[name]), (table, key)
                    elif cell is not None:
                        assert cell == pytest.approx(numbers[name]), (table, key)
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
        assert not WITHOUT & row.keys()
        assert content["statistics"]["headline"]["alpha"]["value"] == pytest.approx(numbers["alpha"])
        assert content["recurrent"]["vss_op3"] == pytest.approx(numbers["VSS (OP>=3)"])
        assert content["statistics"]["headline"]["psa_op2"]["value"] == pytest.approx(numbers["PSA (OP>=2)"])
        assert content["vss_all"] == row["vss_all"] == record.map_summary.means.value["vss"]
        assert not WITHOUT & (content.keys() | content["recurrent"].keys() | content["statistics"]["headline"].keys())


def test_compare_and_gate_judge_the_numbers_of_the_screen(run):
    """A run compared with itself has its own numbers, each under the name that has its population."""
    result, folder = run
    titles = {quantity.name: quantity.full_title for quantity in quantities()}
    names = {model: f"{folder}:{model}" for model in result.models}
    compared = {model: semstab.compare(source, source) for model, source in names.items()}
    for record in result.select():
        source = names[record.unit.model]
        (scene,) = (s for s in compared[record.unit.model].scenes if s.scene == record.unit.scene)
        told = {titles[row.measure].lower(): row.base for row in scene.against[0].contrasts}
        numbers = {name.lower().removesuffix(", %"): value for name, value in numbers_of(record).items()}
        finite = {name: value for name, value in numbers.items() if not math.isnan(value)}
        assert finite.keys() <= told.keys()
        for name, value in finite.items():
            assert told[name] == pytest.approx(value, abs=2e-6, nan_ok=True), name
        rules = {"alpha": "alpha", "vss": "vss (op>=3)", "sbd": "sbd (op>=3)", "psa": "psa (op>=2)"}
        rules |= {"accuracy": "accuracy (op>=2)", "miou": "miou (op>=2)"} if "miou (op>=2)" in numbers else {}
        config = semstab.GateConfig(rules=tuple(f"scene {record.unit.scene}: {rule} > -1" for rule in rules))
        for rule, judged in zip(rules.values(), semstab.gate(source, None, config).judgements, strict=True):
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


def test_the_recording_has_them_in_its_text_and_at_the_end_of_its_series(run):
    result, folder = run
    rows = read(folder.with_name("recording.rrd"))
    for record in result.select():
        unit, table = record.unit, record.map_summary
        logged = [row["TextLog:text"][0] for row in rows[path(unit.scene, "log")] if row.get("TextLog:text")]
        (text,) = (text for text in logged if text.startswith(f"{unit.model}, {unit.backend}: "))
        for measure in measures():
            printed = re.search(rf"{re.escape(measure.full_title)} (\S+?)[ ,]", text)[1]
            value = table.recurrent.means.value[measure.key]
            assert (printed == "nan" and math.isnan(value)) or agree(printed, value), measure.full_title
        (*_, verdict) = (row["TextDocument:text"][0] for row in rows[path(unit.scene, "verdict")])
        assert f"alpha {short(record.statistics.headline.alpha.value)}" in verdict or (
            f" {short(record.statistics.headline.alpha.value)} (" in verdict
        )
        for key in ("vss", "entropy"):
            values = series(rows, path(unit.scene, "series", f"map_{key}_all", unit.model, unit.backend))
            assert values[max(values)] == pytest.approx(table.means.value[key], rel=1e-6), key
        flicker = series(rows, path(unit.scene, "series", "compensated_flicker_percent", unit.model))
        finite = [value for value in flicker.values() if not math.isnan(value)]
        if finite:
            assert sum(finite) / len(finite) == pytest.approx(numbers_of(record)["flicker, %"], rel=1e-6)


def test_the_leaderboard_has_the_numbers_of_the_runs(tmp_path):
    """Alpha is near that of the run, not the same: an answer that a model leaves out counts, see its caption."""
    for seed, scene in enumerate(("one", "two"), start=2):
        write_scene(tmp_path / "data" / scene, seed)
    define(tmp_path / "walls@1.yaml", tmp_path / "data")
    words = ("benchmark", "walls@1.yaml", "--data", "data", "--out", "run", "--submit", "results", "-q")
    bench(*words, cwd=tmp_path)
    words = ("leaderboard", "results", "--benchmark", "walls@1.yaml", "--out", "site")
    said = bench(*words, cwd=tmp_path).stdout
    page = (tmp_path / "site/index.html").read_text(encoding="utf-8")
    benchmark = load_benchmark(tmp_path / "walls@1.yaml")
    (board,) = boards(tmp_path / "results", {benchmark.id: benchmark})
    columns = {column.key: k for k, column in enumerate(headline(board).columns)}
    assert not WITHOUT & columns.keys()
    result = semstab.load_result(tmp_path / "run")
    rows = [re.findall(r"<t[hd][^>]*>\s*(.*?)\s*</t[hd]>", row, re.S) for row in re.findall(r"<tr.*?</tr>", page, re.S)]
    (found,) = (row for row in rows if "model" in row and "rank" in row)
    heads = [html.unescape(head).replace("\N{GREATER-THAN OR EQUAL TO}", ">=").lower() for head in found]
    wrong = {
        model: [record.statistics.headline.wrong_of_consistent_op3 for record in result.select(model=model)]
        for model in result.models
    }
    for row in headline(board).groups[0].rows:
        model = row[columns["model"]]
        of_model = [numbers_of(record) for record in result.select(model=model)]
        names = {"accuracy_op2": "accuracy (OP>=2)", "miou_op2": "mIoU (OP>=2)"}
        names |= {"wrong_of_consistent_op3": "consistent but wrong (OP>=3)", "alpha": "alpha"}
        cells = next(row for row in rows if model in row[:2] and len(row) == len(heads))
        for key, name in names.items():
            value, mean = row[columns[key]].value, sum(entry[name] for entry in of_model) / len(of_model)
            if math.isnan(value):  # no location counts as consistent: the run states no interval either
                assert {math.isnan(entry.low) for entry in wrong[model]} == {True}
            else:
                assert value == pytest.approx(mean, abs=1e-6), name
            (at,) = (k for k, head in enumerate(heads) if head.startswith(name.lower()))
            assert agree(cells[at].split()[0].replace("\N{EN DASH}", "-"), value), name
        (line,) = (line for line in lines([board]) if f" {model} " in line)
        assert line.split() in [entry.split() for entry in said.splitlines()]
        assert agree(re.search(r"alpha (\S+)", line)[1], row[columns["alpha"]].value)


def test_a_video_has_its_flicker_on_every_screen(tmp_path):
    options = {"root": str(video_scene.write(tmp_path / "clip", wrong=(5, 12))), "classes": video_scene.CLASSES}
    folder = tmp_path / "run"
    result = semstab.run({"dataset": {"name": "video", "options": options}}, out=folder)
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["runs"]
    page, said = (folder / "report.html").read_text(encoding="utf-8"), screen(result).splitlines()
    (table,) = (folder / "tables").glob("flicker*.csv")
    for record, content in zip(result.records, summary, strict=True):
        image_space = record.image_space
        assert content["image_space"]["compensated_flicker_percent"] == image_space.compensated_flicker_percent
        (line,) = (line.split() for line in said if line.split()[:1] == [record.unit.model])
        assert agree(line[1], image_space.compensated_flicker_percent)
        assert agree(line[2], image_space.flicker_percent)
        (row,) = (row for row in rows_of_csv(table) if record.unit.model in row.values())
        assert agree(row["compensated_flicker_percent"], image_space.compensated_flicker_percent)
        assert agree(row["flicker_percent"], image_space.flicker_percent)
        assert f"{image_space.compensated_flicker_percent:.2f}" in page
        with record.series.open(encoding="utf-8") as file:
            frames = [row["compensated_flicker_percent"] for row in csv.DictReader(file)]
        values = [float(value) for value in frames if value]
        assert sum(values) / len(values) == pytest.approx(image_space.compensated_flicker_percent)
