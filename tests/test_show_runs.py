"""Many runs at a glance: one table and one figure, whose numbers are those of each run."""

from __future__ import annotations

import csv
import json

import pytest
import tiny_scene
from command_line import bench, error_of
from PIL import Image

import semstab


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two runs of one scene with different voxels, and one below a folder of the same name."""
    folder = tmp_path_factory.mktemp("runs")
    tiny_scene.write(folder / "wall", models=("a", "b"))
    for name, size in (("fine", 0.2), ("coarse", 0.4), ("other/fine", 0.3)):
        bench("--data", "wall", "--voxel-size", size, "--out", name, cwd=folder)
    return folder


def rows_of(folder, name="all"):
    with (folder / name / "tables/runs.csv").open() as file:
        return list(csv.DictReader(file))


def test_each_model_of_each_run_has_a_row_with_the_numbers_of_its_run(folder) -> None:
    said = bench("show", "fine", "coarse", "--out", "all", cwd=folder).stdout
    rows = rows_of(folder)
    assert [(row["run"], row["model"], row["voxel_size"]) for row in rows] == [
        ("fine", "a", "0.200"), ("fine", "b", "0.200"), ("coarse", "a", "0.400"), ("coarse", "b", "0.400"),
    ]  # fmt: skip
    for row in rows:
        record = semstab.load(folder / row["run"]).result.record(model=row["model"])
        alpha = record.statistics.headline.alpha
        assert float(row["alpha"]) == pytest.approx(alpha.value, abs=5e-4)
        assert float(row["alpha_low"]) == pytest.approx(alpha.low, abs=5e-4)
        assert float(row["flicker_percent"]) == pytest.approx(record.image_space.compensated_flicker_percent, abs=0.05)
        assert row["verdict"] == record.statistics.verdict.level
        assert row["vss_op3"] == ""  # of so few voxels no mean is printed
        assert int(row["frames"]) == record.frames
    assert "coarse" in said
    assert "runs.png" in said
    with Image.open(folder / "all/runs.png") as image:
        assert image.size[0] > 2 * image.size[1] > 100
    content = json.loads((folder / "all/tables/tables.json").read_text())
    assert len(content["runs"]["rows"]) == 4
    bench("show", "fine", "coarse", "--out", "runs.tex", cwd=folder)
    assert (folder / "runs.tex").read_text().count(r"\toprule") == 1


def test_a_folder_above_runs_stands_for_them_and_names_stay_apart(folder) -> None:
    bench("show", ".", "other", "--out", "everything", cwd=folder)
    rows = rows_of(folder, "everything")
    names = dict.fromkeys(row["run"] for row in rows)
    assert len(names) == 3
    assert [name.rpartition("/")[2] for name in names] == ["coarse", "fine", "fine"]
    assert {row["run"]: row["voxel_size"] for row in rows if row["run"].endswith("other/fine")} == {
        "other/fine": "0.300"
    }


def test_tables_of_a_run_are_written_on_demand(folder) -> None:
    bench("--data", "wall", "--voxel-size", 0.2, "--out", "whole", cwd=folder, report=True)
    before = {path.name for path in (folder / "whole/tables").iterdir()}
    assert len([path for path in (folder / "whole").rglob("*") if path.is_file()]) <= 40
    assert "tables.json" in before
    assert {name.partition(".")[2] for name in before} == {"csv", "json"}
    assert "uncertainty.csv" not in before
    assert bench("show", "whole", "uncertainty", "--out", "u.csv", cwd=folder).stdout == "u.csv\n"
    assert (folder / "u.csv").read_text().startswith("model,scene,")
    assert bench("show", "whole", "comparison", "--out", "c.csv", cwd=folder).stdout == "c.csv\n"
    bench("show", "whole", "classes", "comparison", "--out", "some.md", cwd=folder)
    assert (folder / "some.md").read_text().count("### ") > 2
    bench("show", "whole", "--out", "all.tex", cwd=folder)
    assert (folder / "all.tex").read_text().count(r"\label{tab:") > len(before)
    bench("show", "whole", "--figures", "png", "--out", "drawn", cwd=folder)
    assert (folder / "drawn/persistence.png").is_file()
    assert not (folder / "whole/figures").exists()


def test_one_run_and_its_tables_are_as_before(folder) -> None:
    assert "tables  semstab-bench show fine TABLE, of overview" in bench("show", "fine", cwd=folder).stdout
    assert bench("show", "fine", "overview", cwd=folder).stdout.startswith("Overview")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("fine", "coarse", "overview"), "'overview' is neither a table of several runs nor a folder"),
        (("fine", "wall"), "wall: there is no finished run here; give folders of --out, or the folder above them"),
        (("fine", "./fine"), "fine: is named twice"),
        (("fine", "--out", "x"), "x: tables are written as .csv, .md, .tex, .json"),
        (("fine", "--out", "x.csv"), "x.csv: a CSV file has one table; choose one of overview"),
        (("wall",), "wall: there is no finished run here"),
    ],
)  # fmt: skip
def test_what_is_no_run_is_named(folder, words, said) -> None:
    assert said in error_of("show", *words, cwd=folder)
    assert not (folder / "x").exists()
