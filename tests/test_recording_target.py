"""Where a recording goes: to viewers that are there, are started, or only seem to be there."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import rerun as rr
import tiny_scene
from test_recording import config_of, read, series, verify
from typer.testing import CliRunner

import semstab
from semstab import cli
from semstab.errors import ConfigError
from semstab.recording import Recording, Target, target


def test_what_rerun_may_say() -> None:
    default = Path("run/recording.rrd")
    assert Target.parse(None, default) == Target(default)
    assert Target.parse("here.rrd", default) == Target(Path("here.rrd"))
    assert Target.parse("spawn", default) == Target(default, "spawn")
    assert Target.parse("serve", default) == Target(default, "serve")
    url = "rerun+http://10.0.0.7:9876/proxy"
    assert Target.parse(url, default) == Target.parse(f"connect {url}", default) == Target(default, url)
    assert Target.parse("connect", default).viewer == "rerun+http://127.0.0.1:9876/proxy"
    for wrong in ("spwan", "folder", "connect http://10.0.0.7", "rerun+http://10.0.0.7:9876"):
        with pytest.raises(ConfigError, match="--rerun"):
            Target.parse(wrong, default)


def test_a_viewer_that_is_not_there_is_said_at_once(tmp_path) -> None:
    missing = Target(tmp_path / "x.rrd", f"rerun+http://127.0.0.1:{unused_port()}/proxy")
    with pytest.raises(ConfigError, match="no rerun viewer listens there"):
        missing.open()


def unused_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def test_a_listener_that_says_nothing_is_no_viewer(tmp_path, monkeypatch) -> None:
    """Nor is one that says something else; the SDK would wait for either, at the end of the run, for ever."""
    monkeypatch.setattr(target, "ANSWER_SECONDS", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        url = f"rerun+http://127.0.0.1:{mute.getsockname()[1]}/proxy"
        with pytest.raises(ConfigError, match=r"no rerun viewer listens there \(timed out\)"):
            Target(tmp_path / "x.rrd", url).open()
        mute.accept()[0].close()

        def answer() -> None:
            connection, _ = mute.accept()
            with connection:
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        other = threading.Thread(target=answer)
        other.start()
        with pytest.raises(ConfigError, match="another program does"):
            Target(tmp_path / "x.rrd", url).open()
        other.join()


def test_serve_says_that_its_port_is_taken(tmp_path, monkeypatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(target, "DEFAULT_URL", f"rerun+http://127.0.0.1:{port}/proxy")
        with pytest.raises(ConfigError, match=f"port {port} is in use"):
            Target(tmp_path / "x.rrd", "serve").open()


def test_spawn_starts_a_viewer_that_listens_on_this_machine_only(tmp_path, monkeypatch) -> None:
    port = unused_port()
    program, pid = tmp_path / "bin" / "rerun", tmp_path / "pid"
    program.parent.mkdir()
    without_a_window = f"exec {Path(sys.executable).with_name('rerun')} --serve-grpc"
    program.write_text(f'#!/bin/sh\necho $$ > {pid}\n{without_a_window} "$@"\n')
    program.chmod(0o755)
    monkeypatch.setattr(target.sys, "executable", str(program.with_name("python")))
    monkeypatch.setattr(target, "DEFAULT_URL", f"rerun+http://127.0.0.1:{port}/proxy")
    stream = Target(tmp_path / "own.rrd", "spawn").open()
    try:
        viewer = psutil.Process(int(pid.read_text()))
        programs = [viewer, *viewer.children(recursive=True)]
        open_to = {at.laddr for one in programs for at in one.net_connections("tcp") if at.status == "LISTEN"}
        assert open_to == {("127.0.0.1", port)}
        stream.log("/x", rr.Scalars(1.0))
        stream.flush()
        stream.disconnect()
    finally:
        os.killpg(int(pid.read_text()), signal.SIGKILL)
        os.waitpid(int(pid.read_text()), 0)
    assert set(read(tmp_path / "own.rrd")) >= {"/x"}


def test_spawn_says_that_the_viewer_ended(tmp_path, monkeypatch) -> None:
    """As it does where there is no display."""
    program = tmp_path / "rerun"
    program.write_text("#!/bin/sh\nexit 7\n")
    program.chmod(0o755)
    monkeypatch.setattr(target.sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(target, "DEFAULT_URL", f"rerun+http://127.0.0.1:{unused_port()}/proxy")
    with pytest.raises(ConfigError, match=r"ended at once \(exit code 7\)"):
        Target(tmp_path / "own.rrd", "spawn").open()


def test_the_viewer_of_a_recording_listens_on_this_machine_only(tmp_path, monkeypatch) -> None:
    (tmp_path / "x.rrd").write_bytes(b"")
    started: list[list[str]] = []
    monkeypatch.setattr(
        subprocess, "run", lambda command, **_: started.append(command) or subprocess.CompletedProcess(command, 0)
    )
    CliRunner().invoke(cli.app, ["view", str(tmp_path / "x.rrd")])
    assert started[0][1:3] == ["--bind", "127.0.0.1"]


def test_a_viewer_without_a_display_is_told_in_one_line(tmp_path, monkeypatch) -> None:
    (tmp_path / "x.rrd").write_bytes(b"")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(subprocess, "run", lambda command, **_: subprocess.CompletedProcess(command, 101))
    done = CliRunner().invoke(cli.app, ["view", str(tmp_path / "x.rrd")])
    assert done.exit_code == 2
    assert "x.rrd: there is no display for the viewer; copy the file to a machine with one" in done.stderr


def test_a_display_that_does_not_answer_is_one_line_and_other_words_are_passed_on(tmp_path, monkeypatch) -> None:
    (tmp_path / "x.rrd").write_bytes(b"")
    monkeypatch.setenv("DISPLAY", ":99")
    words = "Error: winit EventLoopError: os error at linux/mod.rs: Failed to open connection to X server"
    for said, code, expected in ((words, 2, "there is no display for the viewer"), ("other\n", 1, "other\n")):

        def ends(command, *, check, stderr, said=said):
            stderr.write(said.encode())
            return subprocess.CompletedProcess(command, 1)

        monkeypatch.setattr(subprocess, "run", ends)
        done = CliRunner().invoke(cli.app, ["view", str(tmp_path / "x.rrd")])
        assert done.exit_code == code
        assert expected in done.stderr
        assert "winit" not in done.stderr


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@contextlib.contextmanager
def viewer_at(port: int, saved: Path) -> Iterator[None]:
    """One without a window, which saves what it gets."""
    command = [Path(sys.executable).with_name("rerun"), "--port", str(port), "--save", saved]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 20
        while not listens(port) and time.monotonic() < deadline:
            time.sleep(0.1)
        yield
    finally:
        viewer.send_signal(signal.SIGINT)
        viewer.wait(20)


def test_a_run_is_streamed_to_a_viewer_and_into_its_file(tmp_path) -> None:
    port, saved = unused_port(), tmp_path / "received.rrd"
    with viewer_at(port, saved):
        watched = Target(tmp_path / "own.rrd", f"rerun+http://127.0.0.1:{port}/proxy")
        root = tiny_scene.write(tmp_path / "data" / "wall", models=("a",))
        semstab.run(config_of(root, "numba"), observers=[Recording(watched)])
        time.sleep(1)
    verify(tmp_path / "own.rrd")
    expected = series(read(tmp_path / "own.rrd"), "/wall/series/map_vss_all/a/numba")
    assert len(expected) == 3
    assert saved.stat().st_size > 10_000
