"""The command line: exit codes, one-line errors, what it prints and leaves behind."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_scene
from command_line import bench, error_of, started

from semstab.report.figures import style


@pytest.fixture
def wall(tmp_path):
    return tiny_scene.write(tmp_path / "wall")


def test_help_shows_the_options_and_the_commands_and_flags_take_no_value(tmp_path) -> None:
    text = bench("--help", cwd=tmp_path).stdout
    assert {"--backend", "--voxel-size", "--rerun", "list", "view"} <= set(text.split())
    assert "<bool>" not in text + bench("relabel", "--help", cwd=tmp_path).stdout


def test_help_imports_nothing_heavy(tmp_path) -> None:
    code = (
        "import sys; sys.argv = ['semstab-bench', '--help']\n"
        "from semstab.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'open3d', 'rerun', 'pyarrow', 'pydantic', 'cv2', 'trimesh', 'yaml'} & set(sys.modules)\n"
        "sys.exit(f'imported: {heavy}' if heavy else 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_list_takes_a_kind(tmp_path) -> None:
    text = bench("list", "taxonomies", cwd=tmp_path, columns=200).stdout
    assert "uavid7" in text
    assert "open3d" not in text
    assert text == bench("list", "taxonomy", cwd=tmp_path, columns=200).stdout
    assert "did you mean 'datasets'" in bench("list", "datasett", cwd=tmp_path, code=2).stderr


def test_an_option_of_the_dataset_is_told_from_a_setting(tmp_path) -> None:
    wall = tiny_scene.write(tmp_path / "wall", models=("a",))
    refused = bench("--data", wall, "--set", "depth_scale=500", cwd=tmp_path, code=2).stderr
    assert "depth_scale is an option of the dataset; write --option depth_scale=500" in refused


def test_a_template_of_paths_needs_no_quotes(tmp_path) -> None:
    wall = tiny_scene.write(tmp_path / "wall", models=("a",))
    (wall / "labels/a").rename(tmp_path / "a")
    words = ("--option", f"labels_root={tmp_path}", "--option", "labels={model}/{name}.png", "--out", "run")
    bench("--data", wall, *words, cwd=tmp_path)
    assert (tmp_path / "run/summary.json").exists()


def test_stored_labels_that_predictions_stand_for_are_named(tmp_path) -> None:
    wall = tiny_scene.write(tmp_path / "wall", models=("a",))
    words = "--data", wall, "--predict", "colour-clusters", "--model", "a"
    assert "--predict stored,source=a" in bench(*words, cwd=tmp_path, code=2).stderr


def test_list_names_what_there_is(tmp_path) -> None:
    text = bench("list", cwd=tmp_path, columns=200).stdout
    assert {"open3d", "numpy", "city", "posed_folder", "uavid7"} <= set(text.split())
    names = [line.split()[0] for line in bench("list", "studies", cwd=tmp_path).stdout.splitlines()[1:]]
    assert names == ["filters", "ladder", "paper", "rules", "uavid3d"]


def test_list_fits_80_columns_and_cuts_no_dataset_and_no_benchmark(tmp_path) -> None:
    lines = bench("list", cwd=tmp_path, columns=80).stdout.splitlines()
    assert max(map(len, lines)) <= 80
    for kind in ("datasets", "benchmarks"):
        listed = bench("list", kind, cwd=tmp_path, columns=80).stdout
        assert "..." not in listed.replace(".depth.png, ...", "")
        assert listed.splitlines()[0].endswith({"datasets": "is found", "benchmarks": "benchmark NAME"}[kind])


def test_a_run_on_a_folder(wall, tmp_path) -> None:
    arguments = ("--backend", "open3d", "--data", wall, "--model", "a", "--voxel-size", "0.25", "--out", "run")
    text = bench(*arguments, cwd=tmp_path, report=True, recording=True).stdout
    for words in (
        "wall", "no verdict", "fusion by open3d equals numpy in", "semstab-bench view run", "semstab-bench show run",
        "report  run/report.html",
    ):  # fmt: skip
        assert words in text
    for name in (
        "config.yaml", "manifest.json", "recording.rrd", "voxels/wall__a__open3d.parquet", "tables/scenes.csv",
        "tables/tables.json",
    ):  # fmt: skip
        assert (tmp_path / "run" / name).exists()
    assert "figures/persistence.svg" in bench("show", "run", "--figures", "svg", cwd=tmp_path).stdout
    assert cv2.imread(str(tmp_path / "run/figures/persistence.png")).shape[1] in (3.4 * style.DPI, 7 * style.DPI)
    assert 'id="table-scenes"' in (tmp_path / "run/report.html").read_text()
    runs = json.loads((tmp_path / "run" / "summary.json").read_text())["runs"]
    assert {(run["model"], run["backend"]) for run in runs} == {("a", "open3d")}


def test_options_reach_the_run(wall, tmp_path) -> None:
    arguments = ("--backend", "numpy", "--check", "none", "--model", "gt", "--frames", ":2", "--pixel-stride", "2")
    more = ("--set", "strata=[1, 4]", "--set", "voxel_size=0.25", "--rerun", "off", "--quiet", "--events")
    result = bench("run", *arguments, *more, "--data", wall, "--out", "run", cwd=tmp_path)
    assert (result.stdout, result.stderr) == ("", "")
    (run,) = json.loads((tmp_path / "run" / "summary.json").read_text())["runs"]
    assert (run["frames"], run["points"], run["model"]) == (2, 24, "gt")
    assert [row["name"] for row in run["strata"]] == ["OP=1", "2<=OP<=4", "OP>4"]
    assert not (tmp_path / "run" / "recording.rrd").exists()
    assert (tmp_path / "run" / "events" / "wall__gt__numpy.parquet").exists()


def test_a_lost_pose_is_left_out_and_said_and_the_default_folder_is_new(wall, tmp_path) -> None:
    np.savetxt(wall / "pose/0001.txt", np.full((4, 4), np.nan))
    result = bench("--data", wall, "--backend", "numpy", "--rerun", "off", cwd=tmp_path)
    assert result.stderr.count("wall: 1 of 3 selected frames have no pose (tracking was lost) and are left out: 1") == 1
    (folder,) = (tmp_path / "runs").iterdir()
    assert (folder / "summary.json").exists()


@pytest.mark.parametrize(("arguments", "message"), [
    ("--data nowhere", "nowhere: there is no such folder"),
    ("show nowhere", "nowhere: there is no such folder; give the folder of a finished run"), ("--data empty", "empty"),
    ("--config nowhere.yaml", "nowhere.yaml: cannot be read"),
    ("--config bad.yaml", "unknown setting 'voxel_sise'; did you mean 'voxel_size'?"),
    ("--data wall --voxel-size 0", "voxel_size: input should be greater than"),
    ("--data wall --backend opn3d", "did you mean 'open3d'?"),
    ("--data wall --model c", "no model 'c'; known: a, b, gt"), ("--data wall --frames 3", "--frames 3"),
    ("--data wall --set x", "write KEY=VALUE"), ("--data wall --device CUDA:7", "CUDA"),
    ("--data wall --backend numpy --device CPU:0", "none of numpy runs on a device"),
    ("--data wall --seed 1", "unknown setting 'seed'"), ("--data wall --out wall", "is not empty and holds no run"),
    ("--data wall --report maybe", "--report maybe: write on or off"),
    ("--data wall --jobs 2 --rerun spawn", "a viewer follows a run in one process; leave out --jobs and"),
    ("--data wall --jobs 2 --scheduler tcp://x:1", "--jobs and --scheduler: the scheduler's workers do the work"),
    ("view wall", "there is no finished run here"),
    ("study papr", "'papr' is neither a study that ships nor a .yaml file; did you mean 'paper'?"),
    ("study nowhere.yaml", "nowhere.yaml: cannot be read"),
    ("study tiny.yaml --only voxelsize", "study tiny: no part 'voxelsize'; did you mean 'voxel_size'?"),
    ("study tiny.yaml --set sweeps.voxels=[1]", "unknown setting 'sweeps.voxels'; did you mean 'voxel_size'?"),
    ("study tiny.yaml --jobs 2 --scheduler tcp://x:1", "--jobs and --scheduler: the scheduler's workers do"),
    ("study tiny.yaml --out wall", "is not empty and holds no run or study; choose another folder"),
])  # fmt: skip
def test_bad_input_is_one_line_and_exit_2(wall, tmp_path, arguments, message) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.yaml").write_text("voxel_sise: 1\n")
    dataset = "dataset: {name: posed_folder, options: {root: wall}}"
    (tmp_path / "tiny.yaml").write_text(f"name: tiny\n{dataset}\nsweeps: {{voxel_size: [0.5]}}\n")
    assert message in error_of(*arguments.split(), cwd=tmp_path)


def test_a_scene_without_labels_points_to_what_predicts_them(wall, tmp_path) -> None:
    shutil.rmtree(wall / "labels")
    said = error_of("--data", wall, cwd=tmp_path)
    assert said.endswith("add them, or predict them: --predict colour-clusters, or --predict FILE.py:NAME")


def image(path: str, *shape_and_value: int, dtype: type = np.uint16):
    """Return what writes an image of one value over a file, or over all of a folder."""
    *shape, value = shape_and_value

    def write(wall: Path) -> None:
        for file in sorted((wall / path).iterdir()) if (wall / path).is_dir() else [wall / path]:
            cv2.imwrite(str(file), np.full(shape, value, dtype))

    return write


@pytest.mark.parametrize(("damage", "message"), [
    (image("depth/0001.png", 3, 4, 2000), "depth is 4x3 where that of the others is 8x6"),
    (lambda wall: np.savetxt(wall / "pose/0001.txt", np.diag([2.0, 2, 2, 1])),
     "pose/0001.txt: the rotation is not orthonormal"),
    (lambda wall: os.truncate(wall / "depth/0001.png", 40), "depth/0001.png"),
    (image("labels/a/0001.png", 6, 8, 77, dtype=np.uint8), "labels/a/0001.png: label id 77"),
    (lambda wall: (wall / "labels/a/0001.png").unlink(), "labels/a/0001"),
    (image("depth", 6, 8, 0), "wall, a: no pixel of 3 frames is valid"),
    (image("labels/a", 6, 8, 255, dtype=np.uint8), "depth in 100% of the pixels, a label in 0%"),
    (lambda wall: (wall / "intrinsics.txt").unlink(), "intrinsics.txt"),
])  # fmt: skip
def test_damaged_data_is_one_line_that_names_the_file(wall, tmp_path, damage, message) -> None:
    damage(wall)
    result = bench("--data", wall, "--backend", "numpy", "--rerun", "off", "--out", "run", cwd=tmp_path, code=2)
    lines = [line for line in result.stderr.splitlines() if line.strip()]
    assert all(line.startswith("error: ") for line in lines)  # one for each model that it concerns
    assert message in lines[0]
    assert not list((tmp_path / "run").rglob("wall__a*"))


def test_disagreement_is_exit_3_after_everything_is_written(wall, tmp_path) -> None:
    """A plug-in's backend whose belief drifts twice as far is found out by the reference."""
    plugin = tmp_path / "plugin"
    (plugin / "twice-1.0.dist-info").mkdir(parents=True)
    (plugin / "twice.py").write_text(
        "import dataclasses\n"
        "from semstab.backends.numpy_reference import NumpyReference\n"
        "class Twice(NumpyReference):\n"
        "    def table(self):\n"
        "        table = super().table()\n"
        "        return dataclasses.replace(table, drift_sum=table.drift_sum * 2)\n"
    )
    (plugin / "twice-1.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: twice\nVersion: 1.0\n")
    (plugin / "twice-1.0.dist-info/entry_points.txt").write_text("[semstab.backends]\ntwice = twice:Twice\n")
    paths = os.pathsep.join([str(plugin), *filter(None, [os.environ.get("PYTHONPATH")])])
    words = ("--data", "wall", "--backend", "twice", "--rerun", "off", "--out", "run")
    result = bench(*words, cwd=tmp_path, code=3, process=True, PYTHONPATH=paths)
    assert "DISAGREE" in result.stdout
    assert re.search(
        r"error: the backends disagree \(wall, \w+: drift_sum of the voxel \(.*\) is [\d.]+, expected", result.stderr
    )
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["agreement"][0]["agrees"] is False


def test_ctrl_c_is_exit_130_and_the_same_command_goes_on(tmp_path) -> None:
    wall = tiny_scene.write(tmp_path / "wall", models=tuple("abcdef"), frames=100)
    arguments = ("--data", wall, "--backend", "numpy", "--voxel-size", "0.05", "--rerun", "off", "--out", "run")
    process = started(*arguments, cwd=tmp_path)
    units = tmp_path / "run" / "units"
    deadline = time.monotonic() + 60
    while not list(units.glob("[!.]*.json")) and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    assert "interrupted" in stderr
    assert "with --out run resumes" in stderr
    assert "Traceback" not in stderr
    again = bench(*arguments, cwd=tmp_path)
    assert re.search(r"finished earlier: [1-5] of 6 units", again.stderr)


def test_a_warning_of_check_and_run_is_said_once(monkeypatch, capsys):
    from semstab import cli

    warned = logging.getLogger("semstab")
    filters = list(warned.filters)

    def warn_twice():
        for name in ("one", "one", "another"):
            warned.warning("%s frame has no pose", name)

    monkeypatch.setattr(cli, "app", warn_twice)
    printed = logging.StreamHandler(sys.stdout)
    warned.addHandler(printed)
    try:
        cli.main()
    finally:
        warned.removeHandler(printed)
        warned.filters[:] = filters
    assert capsys.readouterr().out.splitlines() == ["one frame has no pose", "another frame has no pose"]
