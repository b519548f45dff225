"""What nobody types, and some file says: one line that says what to do, exit code 2, no more than 400 characters."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import tiny_scene
from command_line import environment
from posed_writer import write_posed
from typer.testing import CliRunner

from semstab.cli import app
from semstab.datasets import open_dataset
from semstab.engine import load_result
from semstab.errors import LONGEST_LINE, ConfigError, DataError, sanitize
from semstab.report.figures import Figure
from semstab.report.figures.style import canvas
from semstab.report.tables import tables, to_csv

LONG = "9" * 300_000

SETTINGS = (
    r'taxonomy="a\0.yaml"', r'dataset.options.labels_root="a\0b"',
    "memory_gb=1e300", "memory_gb=.inf", "memory_gb=.nan",
    "dataset=1", "dataset=[1]", "dataset=null", "dataset.options=3", "threads=abc", f"threads={LONG}",
    f"voxel_size={LONG}", "voxel_size=1e-320", "voxel_size=1e300", f"seed={LONG}", f"frames.stop={LONG}",
    "frames.list=[99999999999999999999]", f"strata=[{LONG}]", "tolerance=.nan", "backends=[[1]]", r'backends=["\n"]',
    r'scenes=["\0"]', r'models=["a\n b"]', r'exclude.classes=["\n[/x]"]', "perturbation.depth_noise=1e300",
    "dataset.options.depth_scale=1e300", f"dataset.options.depth_scale={LONG}", f"dataset.options.{'a' * 5000}=1",
    "a.b.c=1", "=1", "..a=1", "x=[[[[", "x=!!python/object:os.system", 'taxonomy="[/x]"', 'taxonomy="[/x].yaml"',
    f'taxonomy="{"a" * 5000}.yaml"', "scene_frames.wall=1", "x=2020-13-45", 'dataset.options.classes=["a","a","b"]',
)  # fmt: skip

OPTIONS = (
    ("--frames", "²:"), ("--frames", "٣:"), ("--frames", "²"), ("--frames", "9" * 5000), ("--frames", f"{'9' * 5000}:"),
    ("--scene", "a\nb"), ("--scene", "[/x]"), ("--model", "[/x]"), ("--taxonomy", "[/x]"), ("--check", "\udcff"),
    ("--config", "/dev/zero"), ("--config", "."), ("--predict", "x,,="), ("--scheduler", "tcp://[::"),
    ("--predict", f"colour-clusters,clusters={LONG}"), ("--out", "a" * 300), ("--out", "/proc/x"),
)  # fmt: skip

COMMANDS = (
    ("study", "a\0.yaml"), ("study", "[/x]"), ("check", "--data", "wall", "--set", "dataset=1"), ("view", "/dev/zero"),
    ("convert", "--data", "wall", "-o", "/proc/x"), ("predict", "-m", "[/x]", "--images", "*", "-o", "p"),
    ("predict", "-m", "colour-clusters", "--image-size", "²", "--images", "*", "-o", "p"),
    ("predict", "-m", "colour-clusters", "--set", "dataset=1", "--data", "wall"),
    ("predict", "-m", "colour-clusters", "--set", f"clusters={LONG}", "--data", "wall"),
)  # fmt: skip


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    return tiny_scene.write(tmp_path_factory.mktemp("horrors") / "wall", models=("a",))


WORDS = [*(("--set", setting) for setting in SETTINGS), *OPTIONS, *COMMANDS]


@pytest.mark.parametrize("words", WORDS, ids=range(len(WORDS)))
def test_a_horror_is_one_line(wall, tmp_path, monkeypatch, words) -> None:
    monkeypatch.chdir(wall.parent)
    run = ("--data", "wall", "--report", "off", "--rerun", "off", "--backend", "numpy", "--out", str(tmp_path / "out"))
    done = CliRunner().invoke(app, words if words in COMMANDS else [*run, *words])
    assert done.exit_code == 2, (done.exit_code, done.exception, done.stderr)
    (line,) = filter(str.strip, done.stderr.splitlines())
    assert line.startswith("error: ")
    assert len(line) <= LONGEST_LINE
    assert line.isprintable()


def test_a_message_keeps_its_ends_and_a_dollar_begins_no_formula_in_a_figure(tmp_path) -> None:
    assert sanitize("ä 'b'") == "ä 'b'"
    assert sanitize("a\nb\udcff\x00") == r"a\nb\udcff\x00"
    for text in ("x: " + LONG + "; mend it", "x: " + "\n" * 500 + "; mend it", "x: " + "9" * 450 + "; mend it"):
        line = str(ConfigError(text))
        assert line.startswith("x: ")
        assert line.endswith("; mend it")
        assert len(line) == LONGEST_LINE

    def draw():
        drawn = canvas(2, 2)
        axes = drawn.add_subplot(title="$x^{ $", xscale="log")
        axes.bar(["$a_{", "b$"], [1, 2], label="$y$")
        axes.legend()
        return drawn

    for path in Figure("figure", "title", "caption", "alt", draw).save(tmp_path):
        assert path.stat().st_size > 1000


@pytest.mark.parametrize("name", [b"\xff", b"a\nb"])
def test_a_label_source_whose_name_is_no_text_is_refused(tmp_path, name) -> None:
    root = tiny_scene.write(tmp_path / "wall", models=("a",))
    (root / "labels" / "a").rename(root / "labels" / os.fsdecode(name))
    with pytest.raises(DataError, match="cannot be the path of a file"):
        open_dataset("posed_folder", {"root": str(root)}).scene("wall")


def test_names_that_no_terminal_and_no_format_likes_are_reported_whole(tmp_path) -> None:
    """In a terminal of ASCII, and in tables."""
    truth = [np.tile(((np.arange(8) + i) // 4 % 3).astype(np.uint8), (6, 1)) for i in range(3)]
    frames = [tiny_scene.frame(i, labels) for i, labels in enumerate(truth)]
    sources = dict.fromkeys(("net $x^{", "=cmd", "[b]"), frames)
    root = write_posed(tmp_path / "[x] ä", ["a", "b", "c"], sources, classes=["$x^{ $", "=wall", "[/x]"], up_axis="-y")
    words = ["--data", root, "--backend", "numpy", "--check", "none", "--rerun", "off", "--report", "off"]
    done = subprocess.run(
        [sys.executable, "-m", "semstab", *words, "--out", "run"],
        cwd=tmp_path, env=environment(160, PYTHONIOENCODING="ascii"), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "[b]" in done.stdout
    assert "net $x^{" in done.stdout
    assert r"[x] \xe4" in done.stdout
    cells = [to_csv(table) for table in tables(load_result(tmp_path / "run"))]
    assert any(",'=wall," in text for text in cells)
    assert not [line for text in cells for line in text.splitlines() if line.startswith("=")]
