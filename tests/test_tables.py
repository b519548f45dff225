"""The study's tables: what stands in them, and how each format says it."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import re
import shutil
import statistics
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from records import record, study, voxels
from wall_study import MODELS, STEPS, wall_study

from semstab import Result
from semstab.config import BACKENDS, SHARED
from semstab.core.files import write_text
from semstab.data.image_measures import ImageSpace
from semstab.data.measures import SBD, VSS
from semstab.data.records import RegionFlicker
from semstab.errors import ConfigError
from semstab.metrics import entropy, op, sbd, vss
from semstab.report.means import ENOUGH, RepeatSpread, complete_scenes, describe, levels, pooled, swept
from semstab.report.tables import (
    Column,
    Group,
    Table,
    tables,
    to_csv,
    to_json,
    to_latex,
    to_markdown,
    write_run_tables,
    write_table_file,
)
from semstab.report.tables.table import to_terminal
from semstab.statistics import Estimate
from semstab.testing import checks

GOLDEN = Path(__file__).parent / "golden"
SURE, SPLIT = [1, 0, 0], [3, 1, 0]
WRITERS = {"csv": to_csv, "md": to_markdown, "tex": to_latex}


@pytest.fixture(scope="module")
def walls(tmp_path_factory) -> Result:
    return wall_study(tmp_path_factory.getbasetemp())[0]


@pytest.fixture(scope="module")
def tables_of_walls(walls) -> list[Table]:
    return tables(walls)


def table_of(result: Result, name: str) -> Table:
    (found,) = (table for table in tables(result) if table.name == name)
    return found


def rows_of(result: Result, name: str) -> list[dict]:
    return to_json(table_of(result, name))["rows"]


@pytest.mark.parametrize("suffix", WRITERS)
def test_the_walls_tables_are_as_in_the_golden_file(tables_of_walls, suffix):
    written = "\n".join(WRITERS[suffix](table) for table in tables_of_walls)
    assert written == (GOLDEN / f"tables.{suffix}").read_text(encoding="utf-8")


def test_a_study_of_everything_has_every_table(tables_of_walls):
    assert [table.name for table in tables_of_walls] == [
        "overview", "verdicts", "flicker", "scenes", "persistence", "classes", "temporal_agreement", "correlogram",
        "class_agreement", "merges", "drift", "frames", "uncertainty", "ceiling", "correctness", "quadrants",
        "cross_model", "sensitivity_voxel_size", "sensitivity_depth_noise", "sensitivity_frame_count",
        "fusion", "fusion_correctness", "agreement",
    ]  # fmt: skip


def test_nothing_has_no_table_and_one_scene_no_total():
    assert tables(study()) == []
    found = study(record(voxels((1, 1, SURE))))
    assert [row["scene"] for row in rows_of(found, "scenes")] == ["s"]
    assert [row["scene"] for row in rows_of(found, "flicker")] == ["s"]


def test_drift_that_few_places_tell_of_is_not_shown(walls):
    """Of soft scores without a log only places where every frame says one class tell what a random order gives."""
    few = [
        dataclasses.replace(found, drift=dataclasses.replace(found.drift, voxels=found.repeated.voxels // 5))
        for found in (row.statistics for row in walls.select())
    ]
    rows = [dataclasses.replace(row, statistics=found) for row, found in zip(walls.select(), few, strict=True)]
    assert "drift" in {table.name for table in tables(walls)}
    assert "drift" not in {table.name for table in tables(dataclasses.replace(walls, records=tuple(rows)))}
    assert math.isnan(pooled(rows).drift.value)


def voxels_of(walls, model):
    """All voxels of a model, straight from the maps: OP, VSS, SBD, entropy."""
    maps = [row.table() for row in walls.select(model=model)]
    return [np.concatenate([measure(table) for table in maps]) for measure in (op, vss, sbd, entropy)]


@pytest.mark.parametrize("model", MODELS)
def test_the_strata_pool_the_voxels_of_all_scenes(walls, model):
    times, *measures = voxels_of(walls, model)
    inside = {
        "OP=1": times == 1, "OP=2": times == 2, "3<=OP<=5": (times >= 3) & (times <= 5), "OP>5": times > 5,
        "OP>=3": times >= 3,
    }  # fmt: skip
    rows = [row for row in rows_of(walls, "persistence") if row["model"] == model]
    assert [row["persistence"] for row in rows] == list(inside)
    for row in rows:
        where = inside[row["persistence"]]
        assert row["voxels"] == where.sum()
        assert row["share_percent"] == pytest.approx(100 * where.mean())
        means = [value[where][~np.isnan(value[where])] for value in measures]
        expected = [mean.mean() if mean.size else math.nan for mean in means]
        assert [row["vss"], row["sbd"], row["entropy"]] == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("model", MODELS)
def test_the_scenes_have_their_own_means_and_a_macro_mean(walls, model):
    rows = [row for row in rows_of(walls, "scenes") if row["model"] == model]
    assert [row["scene"] for row in rows] == [*STEPS, "Total / Mean"]
    for row, unit in zip(rows, walls.select(model=model), strict=False):
        table = unit.table()
        assert row["vss_all"] == pytest.approx(vss(table).mean())
        assert row["sbd_all"] == pytest.approx(np.nanmean(sbd(table)))
        assert row["mean_op"] == pytest.approx(table.op.mean())
        assert row["points"] == table.pixels.sum()
    *scenes, total = rows
    for key in ("voxels", "points"):
        assert total[key] == sum(row[key] for row in scenes)
    for key in ("mean_op", "vss_all", "sbd_all", "entropy_all"):
        assert total[key] == pytest.approx(statistics.mean(row[key] for row in scenes))


@pytest.mark.parametrize("model", MODELS)
def test_the_comparison_has_macro_and_pooled_means(walls, model):
    macro, every, recurrent = (row for row in rows_of(walls, "cross_model") if row["model"] == model)
    times, stability, drift, _ = voxels_of(walls, model)
    assert every["vss"] == pytest.approx(stability.mean())
    assert every["sbd"] == pytest.approx(np.nanmean(drift))
    assert recurrent["vss"] == pytest.approx(stability[times >= 3].mean())
    assert recurrent["share_percent"] == pytest.approx(100 * (times >= 3).mean())
    assert macro["vss"] == pytest.approx(statistics.mean(vss(r.table()).mean() for r in walls.select(model=model)))
    assert macro["vss"] != pytest.approx(every["vss"])


def test_a_comparison_needs_one_taxonomy_and_two_models():
    a, b = (record(voxels((5, 2, SURE)), model=name) for name in "ab")
    assert "cross_model" in [table.name for table in tables(study(a, b))]
    assert "cross_model" not in [table.name for table in tables(study(a))]
    other = dataclasses.replace(b, taxonomy="other")
    assert "cross_model" not in [table.name for table in tables(study(a, other))]
    shared = [record(voxels((7, 2, SURE)), SHARED, model=name) for name in "ab"]
    rows = rows_of(study(a, other, *shared), "cross_model")
    assert {row["voxels"] for row in rows[::3]} == {7}


def test_flicker_has_the_macro_mean_of_the_scenes_and_regions_are_in_its_table_only():
    images = (ImageSpace(20.0, 8.0, 0.5, 0.9), ImageSpace(30.0, math.nan, 0.7, 0.8))
    found = study(*(record(voxels((1, 1, SURE)), scene=f"s{k}", image_space=image) for k, image in enumerate(images)))
    *scenes, row = rows_of(found, "flicker")
    assert [(of["scene"], of["flicker_percent"]) for of in scenes] == [("s0", 20), ("s1", 30)]
    assert row["scene"] == "Mean"
    assert row["flicker_percent"] == 25
    assert row["compensated_flicker_percent"] == 8
    assert row["compensated_share_percent"] == pytest.approx(60)
    assert row["vc8"] == pytest.approx(0.85)
    assert math.isnan(row["vc16"])
    found = study(
        record(voxels((1, 1, SURE)), image_space=ImageSpace(20.0, 8.0, 0.5)),
        regions=(RegionFlicker("s", "raw SAM", 21.64, 10.0, 0.5), RegionFlicker("t", "raw SAM", 23.0, math.nan, 0.7)),
    )
    rows = rows_of(found, "flicker")
    assert [row["scene"] for row in rows] == ["s", "s", "t", "Mean"]
    row = rows[-1]
    assert (row["model"], row["flicker_percent"], row["compensated_flicker_percent"]) == ("raw SAM", 22.32, 10.0)
    assert math.isnan(row["vc8"])
    assert "raw SAM" in table_of(found, "flicker").caption
    assert "raw SAM" not in {row["model"] for row in rows_of(found, "scenes")}


def noisy(once, repeat, value=0.01, scene="s"):
    return record(voxels((once, 1, SURE), (ENOUGH, 3, SPLIT)), "depth_noise", value, repeat, scene)


def test_a_sweep_has_mean_and_spread_over_its_repeats():
    counts = (ENOUGH, 2 * ENOUGH, 4 * ENOUGH)
    base = record(voxels((1, 1, SURE)))
    calm, disturbed = rows_of(study(base, noisy(0, 0, 0.0), *map(noisy, counts, range(3))), "sensitivity_depth_noise")
    shares = [100 * ENOUGH / (ENOUGH + once) for once in counts]
    assert disturbed["recurrent_percent"] == {
        "mean": pytest.approx(statistics.mean(shares)), "sd": pytest.approx(statistics.stdev(shares)), "repeats": 3,
    }  # fmt: skip
    assert (calm["value"], calm["recurrent_percent"], calm["vss_all"]) == ("0", 100, 0.75)
    assert disturbed["vss_op3"]["sd"] == 0


def test_levels_and_sweeps_pool_scenes_in_a_fixed_order():
    base = [record(voxels((1, 1, SURE)), scene=scene) for scene in "xy"]
    whole = [noisy(5, 0, value, "x") for value in (0.0, 0.01)]
    found = study(*base, *whole, noisy(7, 0, 0.0, "y"))
    assert complete_scenes(found, "depth_noise", "m") == ("x",)
    assert [level.repeats[0].voxels for level in levels(found, "depth_noise", "m")] == [ENOUGH + 5] * 2
    assert "together (x);" in table_of(found, "sensitivity_depth_noise").caption
    base = record(voxels((1, 1, SURE)))
    variations = [record(voxels((1, 1, SURE)), name, 1.0) for name in ("new_thing", "frame_count", "voxel_size")]
    assert [sweep.name for sweep in swept(study(base, *variations))] == ["voxel_size", "frame_count", "new_thing"]
    assert describe("new_thing").header == "New thing"
    small, large = record(voxels((1, 2, SPLIT, 0.2)), scene="x"), record(voxels((9, 1, SURE)), scene="y")
    together = pooled([small, large])
    assert (together.voxels, together.observations, together.mean_op) == (10, 11, 1.1)
    assert (together.every[VSS], together.every[SBD], together.once) == pytest.approx((0.975, 0.2, 0.9))


def test_rare_classes_and_few_recurrent_voxels_are_noted():
    classes = study(record(voxels((ENOUGH, 2, [2, 0, 0]), (ENOUGH - 1, 2, [0, 2, 0]))))
    assert [row["note"] for row in rows_of(classes, "classes")] == ["", "rare", "absent"]
    counts = [record(voxels((n, 3, SURE)), "frame_count", value) for n, value in ((ENOUGH, 40), (ENOUGH - 1, 20))]
    rows = rows_of(study(record(voxels((1, 1, SURE))), *counts), "sensitivity_frame_count")
    assert [(row["value"], row["note"]) for row in rows] == [("20", "few"), ("40", "")]


def test_other_backends_are_compared_with_the_base_one_on_the_scenes_that_all_fused():
    base = [record(voxels((n, 2, SURE)), scene=scene) for scene, n in (("x", 10), ("y", 30))]
    other = record(voxels((8, 2, SURE), (4, 3, SPLIT, 0.1)), BACKENDS, scene="x", backend="other")
    first, second = rows_of(study(*base, other), "fusion")
    assert (first["backend"], first["voxels"], first["delta_voxels"]) == ("numpy", 10, 0)
    assert (second["backend"], second["voxels"], second["delta_voxels"]) == ("other", 12, 2)
    assert second["delta_vss_all"] == pytest.approx((8 + 4 * 0.75) / 12 - 1)
    assert second["delta_sbd_all"] == pytest.approx(0.4 / 12)
    assert second["delta_mean_op"] == pytest.approx(28 / 12 - 2)
    assert "fusion" not in [table.name for table in tables(study(base[1], other))]  # no scene in common


def test_the_agreement_says_who_agrees(walls):
    rows = rows_of(walls, "agreement")
    assert {row["verdict"] for row in rows} == {"agree"}
    assert [(row["scene"], row["model"]) for row in rows] == [("often", model) for model in MODELS]
    assert all(0 <= row["max_sbd"] < 1e-9 for row in rows)
    odd = dataclasses.replace(walls, agreement=(dataclasses.replace(walls.agreement[0], agrees=False),))
    assert [row["verdict"] for row in rows_of(odd, "agreement")] == ["disagree"]


@pytest.mark.parametrize(("column", "cell", "text"), [
    (Column("", "", 0), 705902, "705,902"), (Column("", "", 3), 0.95749, "0.957"),
    (Column("", "", 4), math.nan, "--"), (Column("", "", 3), -0.0001, "0.000"),
    (Column("", "", 3, signed=True), 0.0021, "+0.002"), (Column("", "", 3, signed=True), -0.0021, "-0.002"),
    (Column("", "", 3, signed=True), 0.0001, "0.000"), (Column("", "", 0, scientific=True), 2.2e-16, "2e-16"),
    (Column("", "", 0, scientific=True), 0.0, "0"), (Column("", "", 2), RepeatSpread(9.81, 0.123, 3), "9.81 ± 0.12"),
    (Column("", "", 2), RepeatSpread(9.81, math.nan, 1), "9.81"), (Column("", ""), "road", "road"),
    (Column("", "", 2), Estimate(0.481, 0.326, 0.61), "0.48 (0.33, 0.61)"),
    (Column("", "", 2, signed=True), Estimate(0.02, -0.01, 0.05), "+0.02 (-0.01, +0.05)"),
    (Column("", "", 2), Estimate(0.481, math.nan, math.nan), "0.48"),
    (Column("", "", 2), Estimate(math.nan, math.nan, math.nan), "--"),
])  # fmt: skip
def test_a_cell_in_print(column, cell, text):
    assert column.text(cell) == text


def test_csv_holds_the_numbers_of_the_json_rounded(tables_of_walls):
    for table in tables_of_walls:
        rows = list(csv.DictReader(io.StringIO(to_csv(table))))
        exact = to_json(table)["rows"]
        assert len(rows) == len(exact)
        for row, full in zip(rows, exact, strict=True):
            for column in table.columns:
                value = full[column.key]
                value = value.get("mean", value.get("value")) if isinstance(value, dict) else value
                if isinstance(value, str):
                    assert row[column.key] == value
                elif math.isnan(value):
                    assert row[column.key] == ""
                elif not column.scientific:
                    assert abs(float(row[column.key]) - value) <= 0.5 * 10.0**-column.digits + 1e-12


NASTY = r"a|b_c & 50% #1 {x} $y$ ~^ \z <b>*i* [l](u) `c` é ≥ ±"


def nasty_table() -> Table:
    columns = (Column("name", NASTY), Column("value", "VSS", 3, "higher", over="OP>=3"))
    return Table("nasty", NASTY, NASTY, columns, (Group(NASTY, ((NASTY, 0.5),)), Group("b", (("c", math.nan),))))


def test_markdown_has_as_many_cells_in_every_row_and_an_interval_fields_of_its_own():
    lines = [line for line in to_markdown(nasty_table()).splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {3}
    assert not re.search(r"<b>|(?<!\\)\*i|(?<!\\)\[l", "\n".join(lines[2:]))
    columns = (Column("x", "X", 2), Column("y", "Y", 1))
    table = Table("t", "t", "t", columns, (Group("", ((Estimate(-0.5, -0.75, 0.25), 1.0), (0.5, 2.0))),), by="")
    assert to_csv(table).splitlines() == ["x,x_low,x_high,y", "-0.50,-0.75,0.25,1.0", "0.50,,,2.0"]
    assert to_json(table)["rows"][0]["x"] == {"value": -0.5, "low": -0.75, "high": 0.25, "level": 0.95}
    assert r"$-$0.50 ($-$0.75, 0.25)" in to_latex(table)


@checks
@given(st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs"))))
def test_latex_keeps_its_structure_whatever_the_names(name):
    plain = Table(
        "t", "x", "x", (Column("a", "x"), Column("b", "B", 0)), (Group("x", (("x", 1),)), Group("y", (("y", 2),)))
    )
    renamed = Table(
        "t", name, name, (Column("a", name), Column("b", "B", 0)), (Group(name, ((name, 1),)), Group("y", (("y", 2),)))
    )
    counts = [[len(re.findall(rf"(?<!\\){c}", to_latex(t))) for c in ("&", "%", "#")] for t in (plain, renamed)]
    assert counts[0] == counts[1]
    unescaped = re.sub(r"\\[{}$]", "", to_latex(renamed))
    assert unescaped.count("{") == unescaped.count("}")
    assert unescaped.count("$") % 2 == 0


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="there is no pdflatex")
def test_latex_compiles_without_overfull_lines(tables_of_walls, tmp_path):
    floats = "\n".join(to_latex(table) for table in [*tables_of_walls, nasty_table()])
    page = r"\documentclass[10pt,twocolumn]{article}\usepackage[a4paper,margin=0.7in]{geometry}\usepackage[T1]{fontenc}"
    packages = r"\usepackage{lmodern,booktabs,graphicx}"
    (tmp_path / "t.tex").write_text(f"{page}{packages}\n\\begin{{document}}\n{floats}\n\\end{{document}}\n")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    wide = re.findall(r"Overfull \\hbox \((\d+)", done.stdout)
    assert not [points for points in wide if int(points) > 5]


def test_a_run_writes_a_dozen_tables_as_csv_and_all_of_them_as_json(walls, tmp_path):
    write_text(tmp_path / "tables/of_a_dropped_sweep.csv", "")
    paths = write_run_tables(walls, tmp_path)
    assert sorted(paths) == sorted((tmp_path / "tables").iterdir())
    *texts, content = paths
    assert len(texts) == 12 < len(tables(walls))
    assert [path.suffix for path in texts] == [".csv"] * 12
    found = json.loads(content.read_text())
    assert [*found] == [path.stem for path in texts]
    assert {"overview", "verdicts", "classes", "frames"} <= found.keys()
    assert found["persistence"]["rows"][0]["persistence"] == "OP=1"
    assert found["persistence"]["rows"][0]["sbd"] is None


def test_tables_are_written_on_demand_in_the_format_of_the_suffix(walls, tmp_path):
    made = [table_of(walls, name) for name in ("overview", "drift")]
    for suffix, write in WRITERS.items():
        path = tmp_path / f"one.{suffix}"
        assert write_table_file(made[:1], path) == path
        assert path.read_text(encoding="utf-8") == write(made[0])
    assert write_table_file(made, tmp_path / "both.tex").read_text().count(r"\begin{table") == 2
    assert [*json.loads(write_table_file(made, tmp_path / "both.json").read_text())] == ["overview", "drift"]
    for name, said in {"both.csv": "choose one of overview, drift", "x.xlsx": ".csv, .md, .tex, .json"}.items():
        with pytest.raises(ConfigError, match=re.escape(said)):
            write_table_file(made, tmp_path / name)
        assert not (tmp_path / name).exists()


def test_print_leaves_out_columns_without_a_value_and_files_keep_them():
    columns = (Column("name", "Name"), Column("change", "Change"), Column("x", "X", 2), Column("y", "Y", 2))
    table = Table("t", "T", "", columns, (Group("", (("a", "", math.nan, 1.0), ("", "", math.nan, math.nan))),), by="")
    assert to_markdown(table).splitlines()[2] == "| Name | Y |"
    assert to_csv(table).splitlines()[0] == "name,change,x,y"
    for text in (to_terminal(table), to_latex(table)):
        assert "Change" not in text
        assert "Y" in text
