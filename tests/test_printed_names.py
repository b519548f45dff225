"""What is printed cannot steer the terminal, whoever gave the name."""

from __future__ import annotations

import io
import json
import logging
import zipfile

import pytest
import tiny_scene
from command_line import bench, error_of
from posed_config import configure

import semstab
from semstab.cli import _Once
from semstab.comparison.opening import open_run
from semstab.comparison.small_summary import save_summary
from semstab.core.console import Console
from semstab.core.sealed_zip import packed
from semstab.errors import ConfigError
from semstab.leaderboard.submission import ModelCard

OUT = "out\x1b[31m\u202e"
EVIL = "a\x1b[31m\x1b]0;owned\x07\u202eb"


def test_a_folder_s_name_is_printed_as_text(tmp_path):
    tiny_scene.write(tmp_path / "flights" / f"{EVIL}\n", models=("a\u202eb",))
    done = bench("--data", "flights", "--voxel-size", "0.25", "--statistics", "--out", OUT, cwd=tmp_path)
    for words in (["show", OUT], ["show", OUT, OUT], ["compare", OUT, OUT], ["check", "--data", "flights"]):
        said = bench(*words, cwd=tmp_path, code=None)
        for text in (said.stdout, said.stderr, done.stdout, done.stderr):
            assert not {c for c in text if not c.isprintable()} - {"\n"}
    assert r"\u202e" in done.stdout


def test_the_console_keeps_its_own_colours():
    text = io.StringIO()
    Console(file=text, force_terminal=True, color_system="standard").print(f"x{EVIL}", style="red", markup=False)
    assert text.getvalue().startswith("\x1b[31mx")
    assert "\x1b]0" not in text.getvalue()
    assert "\u202e" not in text.getvalue()


def test_a_warning_is_printed_as_text():
    record = logging.LogRecord("semstab", logging.WARNING, "", 0, "%s: left out", (EVIL,), None)
    assert _Once().filter(record)
    assert "\x1b" not in record.getMessage()


@pytest.mark.parametrize("name", [EVIL, "a\nb", "a" * 5000, "\u200fa", ""])
def test_names_in_a_small_summary_are_names(tmp_path, name):
    tiny_scene.write(tmp_path / "scene", models=("a",))
    semstab.run(configure(tmp_path / "scene", check=None, statistics=True), out=tmp_path / "run", report=False)
    save_summary(open_run(tmp_path / "run"), tmp_path / "whole.semstab")
    for change in (lambda content: content, lambda content: content["scenes"][0]):
        with zipfile.ZipFile(tmp_path / "whole.semstab") as whole:
            content, sums = json.loads(whole.read("summary.json")), whole.read("0.parquet")
        part = change(content)
        part["model" if part is content else "name"] = name
        members = {"summary.json": json.dumps(content).encode(), "0.parquet": sums}
        (tmp_path / "small.semstab").write_bytes(packed(members))
        line = error_of("gate", "small.semstab", "--rule", "alpha > 0", cwd=tmp_path)
        assert "is no name of a scene or model" in line
        assert line.isprintable()


@pytest.mark.parametrize("text", [EVIL, "a\nb", "a" * 5000, "\u202ea"])
@pytest.mark.parametrize("field", ["name", "by", "license", "trained_on", "notes"])
def test_a_card_has_lines(tmp_path, field, text):
    (tmp_path / "card.yaml").write_text(json.dumps({field: text}))
    with pytest.raises(ConfigError, match=f"card.yaml: {field}: ") as caught:
        ModelCard.load(tmp_path / "card.yaml")
    assert str(caught.value).isprintable()
