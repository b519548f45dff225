"""The tutorials of the documentation, typed as they stand: each block of commands and of Python, in order."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command_line import bench
from test_readers_odm import write_georeference, write_project

from semstab import load_result
from semstab.data.measures import measures
from semstab.testing import BackendConformance

DOCS = Path(__file__).parents[2] / "docs"
TUTORIALS = DOCS / "tutorials"
BLOCKS = re.compile(r"```(python|console)\n(.*?)```", re.DOTALL)


def make_nothing(folder: Path) -> None:
    """These tutorials make their data themselves."""


def make_project(folder: Path) -> None:
    """A small project of OpenDroneMap without label maps, as that of a flight."""
    write_georeference(write_project(folder / "project"))
    shutil.rmtree(folder / "project/labels")


def save_backend(folder: Path) -> None:
    """The file that the reader saves."""
    code = python_blocks("tutorials/own-backend.md")[0]
    assert len(code.splitlines()) <= 15
    (folder / "fusion.py").write_text(code, encoding="utf-8")


def save_rule(folder: Path) -> None:
    """The file of a rule that the reader saves."""
    (folder / "sharp.py").write_text(python_blocks("fusion-rules.md")[0], encoding="utf-8")


def save_models(folder: Path) -> None:
    """The file of two models that the reader saves."""
    (folder / "by_colour.py").write_text(python_blocks("tutorials/two-visits.md")[0], encoding="utf-8")


def save_features(folder: Path) -> None:
    """The file of a model that gives features, which the reader saves."""
    (folder / "colours.py").write_text(python_blocks("tutorials/prompts.md")[0], encoding="utf-8")


@pytest.mark.parametrize(("name", "prepare", "left"), [
    ("own-backend", save_backend, ["mine/report.html", "side-by-side/report.html"]),
    ("fusion-rules", save_rule, ["rules/report.html", "sharp/report.html"]),
    ("own-sequence", make_nothing, ["runs/first/report.html", "runs/first/tables/classes.csv"]),
    ("lidar-camera", make_nothing, ["run/report.html"]),
    ("scans", make_nothing, [f"scans/{file}" for file in ("report.html", "tables/ranges.csv")]),
    ("two-models", make_nothing, ["both/report.html", "versus/report.html", "versus/comparison.json"]),
    ("two-visits", save_models, ["by-colour/report.html", "balanced/visits.json"]),
    ("prompts", save_features, ["town/report.html", "town/tables/prompts.csv", "fewer/tables/prompts.csv"]),
    ("drone-flight", make_project, ["map/report.html", "map.ply", "map.tif", "map.class.tif", "map.laz"]),
])  # fmt: skip
def test_every_block_of_a_tutorial_works_as_it_stands(name, prepare, left, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    prepare(tmp_path)
    blocks = BLOCKS.findall(next(DOCS.rglob(f"{name}.md")).read_text(encoding="utf-8"))
    assert len(blocks) >= 3
    for kind, text in blocks:
        if kind == "python":
            exec(compile(text, f"{name}.md", "exec"), {})
            continue
        for line in text.splitlines():
            command, *words = shlex.split(line)
            assert command == "semstab-bench"
            assert bench(*words, cwd=tmp_path, report=True, columns=80).stdout
    for file in left:
        assert (tmp_path / file).stat().st_size > 0


def test_each_extension_is_a_file_that_runs(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = (DOCS / "tutorials/extend.md").read_text(encoding="utf-8")
    model, rule, measure, reader = python_blocks("tutorials/extend.md")
    assert all(len([line for line in code.splitlines() if line]) <= 10 for code in (model, rule, measure, reader))
    for name, code in {"net": model, "capped": rule, "walk": reader}.items():
        (tmp_path / f"{name}.py").write_text(code, encoding="utf-8")
    exec(compile(python_blocks("tutorials/own-sequence.md")[0], "own-sequence.md", "exec"), {})
    for line in "".join(text for kind, text in BLOCKS.findall(text) if kind == "console").splitlines():
        command, *words = shlex.split(line)
        assert command == "semstab-bench"
        assert bench(*words, cwd=tmp_path, columns=80).stdout
    exec(compile(measure, "second.py", "exec"), {})
    assert "second" not in {declared.key for declared in measures()}
    assert load_result("model").models == ("bright",)
    assert load_result("reader").models == ("mine",)
    assert "numba+capped" in Path("rule/summary.json").read_text()
    assert '"second"' in Path("measured/summary.json").read_text()


class TestOwnBackend(BackendConformance):
    """The backend of the tutorial passes the suite that the tutorial gives it to."""

    def create(self, voxel_size, num_classes):
        names: dict[str, Any] = {}
        exec(compile(python_blocks("tutorials/own-backend.md")[0], "own-backend.md", "exec"), names)
        return names["Mine"](voxel_size, num_classes)


def python_blocks(page: str) -> list[str]:
    return [text for kind, text in BLOCKS.findall((DOCS / page).read_text(encoding="utf-8")) if kind == "python"]


@pytest.mark.filterwarnings("ignore")  # of the trackers' own imports
def test_the_recipes_for_trackers_log_scalars_report_and_map(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    blocks, names = python_blocks("trackers.md"), {}
    assert all(len(text.strip().splitlines()) <= 10 for text in blocks[1:])
    for text in blocks:
        exec(compile(text, "trackers.md", "exec"), names)
    scalars = names["result"].summary.scalars()

    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logged = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert {f"stability/{name}" for name in scalars} == set(logged.Tags()["scalars"])
    assert logged.Scalars("stability/alpha")[0].value == pytest.approx(scalars["alpha"])
    assert logged.Images("stability/map")[0].encoded_image_string.startswith(b"\x89PNG")

    (offline,) = (tmp_path / "wandb").glob("offline-run-*")
    (record,) = offline.glob("*.wandb")
    content = record.read_bytes()
    assert b"stability/alpha" in content
    assert b"stability-report" in content
    assert list(offline.rglob("*.png"))

    import mlflow

    (run,) = mlflow.search_runs(output_format="list", search_all_experiments=True)
    assert run.data.metrics["stability/alpha"] == pytest.approx(scalars["alpha"])
    artifacts = {file.path for file in mlflow.artifacts.list_artifacts(run_id=run.info.run_id)}
    assert artifacts == {"report.html", "stability.png"}


def test_training_with_the_metric_tells_stability_from_miou(tmp_path, monkeypatch, request):
    """The page's blocks, and its example with fewer epochs: alpha rises by much while mIoU rises little."""
    import torch

    monkeypatch.chdir(tmp_path)
    request.addfinalizer(partial(torch.set_num_threads, torch.get_num_threads()))
    torch.set_num_threads(1)  # so small are the images that further ones wait most of their time
    for text in python_blocks("training-loop.md"):
        exec(compile(text, "training-loop.md", "exec"), {})
    assert (tmp_path / "flicker.html").stat().st_size > 100_000
    example = runpy.run_path(str(DOCS / "examples/training_loop.py"))
    example["train"].__globals__["EPOCHS"] = 12
    before, after = example["train"]()[5::6]
    assert abs(after["miou"] - before["miou"]) < 0.1
    assert before["miou"] > 0.2
    assert after["alpha"] > before["alpha"] + 0.2
    example["draw"]([before, after], tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000
