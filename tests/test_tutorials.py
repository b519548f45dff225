"""The tutorials of the documentation, typed as they stand: each block of commands and of Python, in order."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from command_line import bench
from test_readers_odm import write_georeference, write_project

TUTORIALS = Path(__file__).parents[1] / "docs/tutorials"
BLOCKS = re.compile(r"```(python|console)\n(.*?)```", re.DOTALL)


def make_nothing(folder: Path) -> None:
    """These tutorials make their data themselves."""


def make_project(folder: Path) -> None:
    """A small project of OpenDroneMap without label maps, as that of a flight."""
    write_georeference(write_project(folder / "project"))
    shutil.rmtree(folder / "project/labels")


@pytest.mark.parametrize(("name", "prepare", "left"), [
    ("own-sequence", make_nothing, ["runs/first/report.html", "runs/first/tables/classes.csv"]),
    ("two-models", make_nothing, ["both/report.html", "versus/report.html", "versus/comparison.json"]),
    ("drone-flight", make_project, ["map/report.html", "map.ply", "map.tif"]),
])  # fmt: skip
def test_every_block_of_a_tutorial_works_as_it_stands(name, prepare, left, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    prepare(tmp_path)
    blocks = BLOCKS.findall((TUTORIALS / f"{name}.md").read_text(encoding="utf-8"))
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
