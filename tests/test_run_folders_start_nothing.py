"""Commands that read a finished run start no code that its settings name, but what the command line names."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import tiny_scene
import yaml
from command_line import bench, error_of
from posed_config import configure
from test_own_backend import ALIKE

import semstab
from semstab.core import registry
from semstab.core.code import only_named
from semstab.core.prefetch import prefetch
from semstab.errors import ConfigError

MARK = "from pathlib import Path\nPath(__file__).with_name('started').touch()\n"
MODEL = """
import numpy as np
CLASSES = ["wall", "door", "window"]

def evil(image):
    return np.zeros(image.shape[:2], np.uint8)
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with ground truth, its scene, and a file of code that leaves a mark where it is imported."""
    folder = tmp_path_factory.mktemp("finished")
    tiny_scene.write(folder / "scene", models=("a",))
    semstab.run(configure(folder / "scene", check=None, statistics=True), out=folder / "run", report=False)
    return folder


@pytest.fixture
def folder(finished, tmp_path, monkeypatch) -> Path:
    shutil.copytree(finished / "run", tmp_path / "run")
    (tmp_path / "evil.py").write_text(MARK + ALIKE + MODEL, encoding="utf-8")
    monkeypatch.setattr("semstab.recording.viewer_command", lambda: ["true"])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "_code", {})
    return tmp_path


def predicted(model: str):
    return lambda content: {
        **content,
        "models": None,
        "dataset": {"name": "predicted", "options": {"dataset": content["dataset"], "models": [{"model": model}]}},
    }


FIELDS = {
    "backends": lambda content: {**content, "backends": ["evil.py:Mine"]},
    "backends, one": lambda content: {**content, "backends": "evil.py:Mine"},
    "backends, a module": lambda content: {**content, "backends": ["evil:Mine"]},
    "backends, code": lambda content: {**content, "backends": [{"name": "numba", "code": "evil.py:Mine"}]},
    "backends, second": lambda content: {**content, "backends": ["numba", "evil.py:Mine"]},
    "check": lambda content: {**content, "check": "evil.py:Mine"},
    "models": predicted("evil.py:evil"),
    "models, a module": predicted("evil:evil"),
    "models, a program": predicted("evil.pt"),
    "models of models": lambda content: predicted("nothing")(predicted("evil.py:evil")(content)),
    "dataset": lambda content: {**content, "dataset": "evil.py:Mine"},
    "dataset, name": lambda content: {**content, "dataset": {"name": "evil:Mine"}},
}
REFUSING = {
    "relabel": ["relabel", "run", "--out", "fused"],
    "coco": ["export", "run", "--format", "coco", "--to", "tasks.json"],
}
READING = {
    "view": ["view", "run"],
    "show": ["show", "run"],
    "show several": ["show", "run", "run"],
    "compare": ["compare", "run", "run", "--out", "compared"],
    "gate": ["gate", "run", "--rule", "alpha > 0"],
    "baseline": ["gate", "run", "--save-baseline", "base.semstab"],
    "calibrate": ["calibrate", "run", "--out", "thresholds.yaml"],
    "export": ["export", "run", "--to", "map.ply"],
}


def change(folder: Path, field: str) -> None:
    file = folder / "run/config.yaml"
    layout = file.read_text(encoding="utf-8").splitlines()[0]
    content = FIELDS[field](yaml.safe_load(file.read_text(encoding="utf-8")))
    file.write_text(f"{layout}\n{yaml.safe_dump(content)}", encoding="utf-8")


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("name", REFUSING)
def test_a_command_that_opens_the_dataset_refuses_code(folder, name, field):
    change(folder, field)
    (folder / "evil.pt").write_bytes(b"a program")
    before = sorted(folder.iterdir())
    line = error_of(*REFUSING[name], cwd=folder)
    assert "config.yaml" in line
    assert "--code" in line
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("name", READING)
def test_other_commands_start_none(folder, name, field):
    change(folder, field)
    done = bench(*READING[name], cwd=folder, code=None)
    assert done.returncode in (0, 2, 4, 5)
    assert not (folder / "started").exists()
    if name == "view":
        assert done.returncode == 0
        assert "recorded without pictures" in done.stderr
    assert not registry._code


def test_view_keeps_pictures_of_a_run_that_names_no_code(folder):
    assert "without pictures" not in bench("view", "run", cwd=folder).stderr


@pytest.mark.parametrize("name", REFUSING)
def test_what_the_command_line_names_is_started(folder, name):
    shutil.rmtree(folder / "run")
    shutil.copytree(Path(folder), folder / "kept")
    tiny_scene.write(folder / "scene", models=("a",))
    bench(
        "run", "--data", "scene", "--voxel-size", "0.25", "--backend", "evil.py:Mine", "--check", "none",
        "--out", "run", cwd=folder,
    )  # fmt: skip
    words = REFUSING[name]
    line = error_of(*words, cwd=folder)
    assert "run/config.yaml: backends.0.code names code" in line
    assert f"--code {folder / 'evil.py'}:Mine" in line
    done = bench(*words, "--code", "evil.py:Mine", cwd=folder, code=None)
    assert "names code" not in done.stderr
    other = error_of(*words, "--code", "evil.py:Yours", cwd=folder)
    assert "names code" in other


def test_threads_that_read_ahead_are_bound(folder):
    from semstab.core.code import Code

    def load(index: int) -> None:
        Code.load(str(folder / "evil.py:Mine"), "backend")

    with only_named("config.yaml", ()), pytest.raises(ConfigError, match="names code"):
        next(prefetch(load, [0, 1]))
    assert not (folder / "started").exists()


@pytest.mark.parametrize("model", ["no-such-model", "", 5, None, "a:b:c"])
@pytest.mark.parametrize("name", [*REFUSING, "view"])
def test_a_bad_model_in_the_settings_is_one_line(folder, name, model):
    file = folder / "run/config.yaml"
    layout, content = file.read_text().splitlines()[0], yaml.safe_load(file.read_text())
    file.write_text(f"{layout}\n{yaml.safe_dump(predicted(model)(content))}")
    if name == "view":
        lines = bench("view", "run", cwd=folder).stderr.strip().splitlines()
        assert len([line for line in lines if "without pictures" in line]) == 1
    else:
        assert "model" in error_of(*REFUSING[name], cwd=folder)
