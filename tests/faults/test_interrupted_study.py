"""Ctrl-C while a study's processes start: one line, and no process that goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import time

import psutil
from command_line import command, environment

STUDY = """
dataset: {name: city, options: {width: 320, height: 180, frames: 60}}
scenes: [scene0]
sweeps: {voxel_size: [0.3, 0.4, 0.5, 0.6, 0.7]}
"""


def workers(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The processes that it has started, but for Python's own that watches over semaphores."""
    found = []
    for child in psutil.Process(process.pid).children(recursive=True):
        try:
            found += [child] if "spawn_main" in " ".join(child.cmdline()) else []
        except psutil.Error:
            continue
    return found


def test_processes_that_start_end_at_once_and_say_nothing(tmp_path):
    (tmp_path / "s.yaml").write_text(STUDY)
    process = subprocess.Popen(
        command(["study", "s.yaml", "--jobs", "2", "--out", "out"]), cwd=tmp_path, env=environment(80),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    until = time.monotonic() + 60
    while not (started := workers(process)) and time.monotonic() < until:
        time.sleep(0.01)
    time.sleep(0.2)  # they import
    started = workers(process)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert len(said.splitlines()) == 1, said
    assert said.startswith("interrupted; ")
    gone = [process for process in started if not process.is_running() or process.status() == psutil.STATUS_ZOMBIE]
    assert started
    assert gone == started
