"""A disk that is full, and Ctrl-C while modules are still loaded: one line, and what is finished is kept."""

from __future__ import annotations

import json
import random
import resource
import signal
import subprocess
import sys
import time

import pytest
import tiny_scene
from command_line import environment
from posed_config import configure

import semstab
from semstab.core.files import write_text
from semstab.errors import ConfigError
from semstab.recording import Recording


def test_a_recording_that_finds_no_room_costs_no_result(tmp_path, monkeypatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")  # what rerun says of a full disk

    monkeypatch.setattr("rerun.RecordingStream.flush", full)
    config, out = configure(tiny_scene.write(tmp_path / "wall", models=("a",)), check=None), tmp_path / "out"
    recording = Recording(out / "recording.rrd")
    with pytest.raises(ConfigError, match=r"recording\.rrd: the recording is not complete .*is the disk full"):
        semstab.run(config, out=out, observers=[recording], report=False)
    assert len(json.loads((out / "summary.json").read_text())["runs"]) == 1


def test_a_recording_without_room_beside_units_without_room_says_which_are_missing(tmp_path, monkeypatch) -> None:
    """Not that all other files are complete."""

    def full(*_: object, **__: object) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    def no_room(*_: object) -> None:
        raise OSError(28, "No space left on device", "overview.npz")

    monkeypatch.setattr("rerun.RecordingStream.flush", full)
    monkeypatch.setattr("semstab.engine.measurement.save_overview", no_room)
    config, out = configure(tiny_scene.write(tmp_path / "wall"), check=None), tmp_path / "out"
    said = r"1 of 1 units failed, the first with .*No space left on device.*; the same command computes them again"
    with pytest.raises(ConfigError, match=said) as caught:
        semstab.run({**config.model_dump(), "models": ["a"]}, out=out, observers=[Recording(out / "r.rrd")])
    assert "all other files" not in str(caught.value)
    assert not list((out / "units").iterdir())


FULL = """
import resource, sys
import semstab.recording.target as target
from semstab.__main__ import main

target.STALLED_SECONDS = 0.5
resource.setrlimit(resource.RLIMIT_FSIZE, (250_000, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
main()
"""


def test_a_full_disk_beneath_a_recording_ends_the_command(tmp_path) -> None:
    """The thread of rerun that writes has ended: what waits for it would wait for ever, also at the program's end."""
    words = ["--scene", "scene0", "--frames", "::20", "--voxel-size", "2", "--report", "off", "-q", "--out", "out"]
    done = subprocess.run(
        [sys.executable, "-c", FULL, *words], cwd=tmp_path, env=environment(80), capture_output=True, text=True,
        timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error"))
    assert line.startswith("error: out/recording.rrd: the recording is not complete")
    assert len(json.loads((tmp_path / "out/summary.json").read_text())["runs"]) == 2


def test_a_file_that_finds_no_room_is_named(tmp_path) -> None:
    """No file may grow beyond 64 kB, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65_536, before[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            write_text(tmp_path / "large.txt", "x" * 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(tmp_path / "large.txt")
    assert not list(tmp_path.iterdir())


def test_ctrl_c_while_modules_are_loaded_is_one_line(tmp_path) -> None:
    """From where our code begins; before that, Python itself is interrupted."""
    marker = tmp_path / "begun"
    program = (
        f"import pathlib, sys; sys.argv = ['semstab-bench', 'list']; from semstab.__main__ import main\n"
        f"import signal, threading; begun = pathlib.Path({str(marker)!r})\n"
        "threading.Timer(0, begun.touch).start(); main()"
    )
    moments = random.Random(0)
    for _ in range(3):
        process = subprocess.Popen(
            [sys.executable, "-c", program], env=environment(80), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL,
            text=True,
        )  # fmt: skip
        while not marker.exists():
            time.sleep(0.001)
        time.sleep(0.01 + moments.random() * 0.3)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
        marker.unlink()
        assert "Traceback" not in said
        assert process.returncode in (130, 0)
        if process.returncode:
            assert said.startswith("interrupted")
