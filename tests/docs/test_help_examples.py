"""The examples at the end of each command's help, typed as they stand."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import yaml
from command_line import bench
from dataset_writers import save as write_image

from semstab.cli import EXAMPLES, app

NET = """
import numpy as np


class Net:
    classes = ["wall", "door", "window"]

    def predict(self, image):
        return (image[..., 0] // 86).astype(np.uint8)
"""
STUDY = {"dataset": {"name": "posed_folder", "options": {"root": "flight"}}, "sweeps": {"voxel_size": [0.2, 0.4]}}
FAILS = {"gate new --rule 'alpha > 0.6' --out gate.md": 5}
"""Gates that so few frames leave undecided."""

SLOW = (
    "conform './fuse'", "list --check", "benchmark city@1 --predict net.py:Net",
    "study mine.yaml --only voxel_size --jobs 2",
)  # fmt: skip
"""All cases, all models loaded, five flights, two processes: other tests run these, or their like."""

RESULTS = Path(__file__).parents[2] / "results"
BENCHMARK = {
    "description": "a wall", "get": "write it", "license": "none", "citation": "nobody", "voxel_size": 0.2,
    "dataset": {"name": "posed_folder"}, "scenes": ["flight"],
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene, runs of it, a study, a model, and a fusion program."""
    folder = tmp_path_factory.mktemp("examples")
    tiny_scene.write(folder / "flight", models=("net",), frames=6, noise=0.2)
    for k in range(6):
        image = np.random.default_rng(k).integers(0, 256, (tiny_scene.HEIGHT, tiny_scene.WIDTH, 3), np.uint8)
        write_image(folder / f"flight/color/{k:04d}.png", image)
    (folder / "net.py").write_text(NET)
    (folder / "mine.yaml").write_text(yaml.safe_dump(STUDY))
    (folder / "mine@1.yaml").write_text(yaml.safe_dump(BENCHMARK))
    (folder / "results").mkdir()
    for name in ("sim-steady", "sim-flicker"):
        (folder / f"results/city@1__{name}.semstab").symlink_to(RESULTS / f"city@1__{name}.semstab")
    (folder / "fuse").write_text(f'#!/bin/sh\nexec {sys.executable} -m semstab.conformance.fuse numba "$@"\n')
    (folder / "fuse").chmod(0o755)
    for name in ("old", "new"):
        bench("--data", "flight", "--out", name, cwd=folder)
    bench("--data", "flight", "--out", "judged", "--statistics", cwd=folder)
    bench("export", "new", "--to", "map.ply", "--to", "other.parquet", cwd=folder)
    return folder


def test_every_command_has_two_examples_of_its_own() -> None:
    assert set(EXAMPLES) == {command.name for command in app.registered_commands}
    for name, lines in EXAMPLES.items():
        assert [shlex.split(line)[0] for line in lines] == [name, name]


@pytest.mark.parametrize("line", [line for lines in EXAMPLES.values() for line in lines if line not in SLOW])
def test_an_example_works_and_ends_the_help(folder, line) -> None:
    name, *words = shlex.split(line)
    help_ = bench(name, "--help", cwd=folder, columns=200).stdout
    assert f"semstab-bench {line}" in help_.partition("Examples:")[2]
    code = 2 if name == "view" else FAILS.get(line, 0)
    off = ("--report", "off") if name == "filters" else ()  # its report takes most of the time
    done = bench(name, *words, *off, cwd=folder, code=code, process=name == "conform")
    if name == "view":
        assert "recording" in done.stderr or "display" in done.stderr
