"""What a kill left behind, of every kind: taken over, cleaned away, finished or made again."""

from __future__ import annotations

import os
import subprocess
import sys

import kills
import pytest
import tiny_scene
from posed_config import configure
from typer.testing import CliRunner

import semstab
from semstab.cli import app
from semstab.convert import convert
from semstab.core.files import FolderLock
from semstab.errors import ConfigError
from semstab.recording import Recording
from semstab.recording.target import is_whole


@pytest.fixture
def root(tmp_path):
    return tiny_scene.write(tmp_path / "wall")


@pytest.mark.parametrize("damage", ["cut", "gone"])
def test_a_recording_cut_by_a_kill_is_made_again_where_all_else_is_kept(root, tmp_path, damage) -> None:
    config, out = configure(root, models=["a"], check=None), tmp_path / "out"
    file = out / "recording.rrd"
    semstab.run(config, out=out, observers=[Recording(file)], report=False)
    size, before = file.stat().st_size, file.stat().st_mtime_ns
    again = semstab.run(config, out=out, observers=[Recording(file)], report=False)
    assert (file.stat().st_mtime_ns, again.manifest["units"]["kept"]) == (before, 1)  # whole: left alone
    if damage == "cut":
        os.truncate(file, size * 2 // 3)
    else:
        file.unlink()
    assert not is_whole(file)
    again = semstab.run(config, out=out, observers=[Recording(file)], report=False)
    assert again.manifest["units"]["kept"] == 1
    assert file.stat().st_mtime_ns > before
    assert is_whole(file)


class Killed(BaseException):
    """Ends a start where it is, as a kill does; what it was writing stays half-written."""


class FirstFrame:
    """A progress that ends the start at the first frame."""

    def __call__(self, what: str, done: int, of: int) -> None:
        raise Killed


def test_a_conversion_killed_at_its_birth_goes_on(root, tmp_path, monkeypatch) -> None:
    config, out = configure(root, models=["a"]), tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr("semstab.convert.write_json", stop)
        with pytest.raises(Killed):
            list(convert(config, out))
    (out / "wall" / ".semstab-ab12cd34.yaml").write_text("half")
    with monkeypatch.context() as patch:
        patch.setattr("semstab.convert.write_text", stop)
        with pytest.raises(Killed):
            list(convert(config, out))
    with pytest.raises(Killed):
        list(convert(config, out, progress=FirstFrame()))
    (out / "wall" / "pose" / ".semstab-ab12cd34.txt").write_text("half")
    (converted,) = convert(config, out)
    assert (converted.frames, converted.written) == (3, 2)
    assert not list(out.rglob(".*"))


def stop(*_: object) -> None:
    raise Killed


def test_a_folder_of_a_conversion_or_of_predictions_belongs_to_one_process(root, tmp_path) -> None:
    config, out = configure(root, models=["a"]), tmp_path / "out"
    list(convert(config, out))
    held = FolderLock(out / "wall")
    with pytest.raises(ConfigError, match="wall: another process works on it"):
        list(convert(config, out))
    held.release()
    list(convert(config, out))


@pytest.mark.parametrize(
    ("kind", "owned"),
    [("run", ""), ("tiles", ""), ("study", ""), ("predict", "labels/colour-clusters"), ("convert", "wall")],
)
def test_a_second_start_is_refused_in_one_line(started, tmp_path, kind, owned) -> None:
    words, _ = started[kind]
    held = FolderLock(tmp_path / "out" / owned)
    done = CliRunner().invoke(app, words(tmp_path / "out"))
    held.release()
    assert done.exit_code == 2
    (line,) = done.stderr.splitlines()
    assert "another process works on it; wait for it, or choose another folder" in line


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    """The commands that `make faults` kills."""
    return kills.kinds(tmp_path_factory.mktemp("started"))


def test_one_that_was_killed_and_started_again_leaves_the_same_bits(tmp_path) -> None:
    """One kind, as `make faults` does with all of them."""
    words = [sys.executable, kills.__file__, "1", "0", "convert"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 of 1 left what one without a kill leaves" in done.stdout
