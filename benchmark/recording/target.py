"""Open the targets of a recording: a file, and a viewer while the run goes on."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr

from semstab.core.files import open_file
from semstab.errors import ConfigError

APPLICATION = "semstab"
DEFAULT_URL = "rerun+http://127.0.0.1:9876/proxy"
CHOICES = "FILE.rrd, spawn, connect, rerun+http://HOST:PORT/proxy, serve, or off"

FOOTER, FOOTER_BYTES = b"RRF2FOOT", 64
"""The mark that ends a recording, among its last bytes."""

ANSWER_SECONDS, SPAWN_SECONDS = 5.0, 30.0
"""The most seconds that a viewer may take to answer, and that a started viewer may take to listen."""

STALLED_SECONDS = 10.0
"""The seconds without a byte written after which a recording counts as one that cannot be written."""

HTTP2_SETTINGS = b"\x04"
HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + HTTP2_SETTINGS + bytes(5)
"""A client's first bytes, an empty frame of settings included; a server answers with such a frame (RFC 9113)."""


def flush(stream: rr.RecordingStream, file: Path) -> None:
    """Wait until a recording is in its file, as long as the file grows: on a full disk rerun would wait for ever.

    Raises:
        RuntimeError: If it cannot be written.
    """
    size = _size(file)
    while True:
        try:
            stream.flush(timeout_sec=STALLED_SECONDS)
        except RuntimeError:
            if (now := _size(file)) <= size:
                rr.unregister_shutdown()  # at its end Python would wait for it, too, and where the stream is destroyed
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(stream))
                raise
            size = now
        else:
            return


def _size(file: Path) -> int:
    return file.stat().st_size if file.exists() else 0


@dataclass(frozen=True)
class Target:
    """A file, and 'spawn', 'serve' or the URL of a viewer to which the recording is streamed as well."""

    file: Path
    viewer: str | None = None

    @classmethod
    def parse(cls, text: str | None, default: Path) -> Target:
        """Read `--rerun`; `default` is the file if the option names no file.

        Raises:
            ConfigError: For any other text.
        """
        if text is None:
            return cls(default)
        if text in ("spawn", "serve"):
            return cls(default, text)
        word, _, url = text.strip().partition(" ")
        if word == "connect" or re.match(r"rerun(\+https?)?://", text):
            url = (url.strip() or DEFAULT_URL) if word == "connect" else text
            if not re.fullmatch(r"rerun(\+https?)?://[^/]+/proxy", url):
                raise ConfigError(f"--rerun {text}: write the address as rerun+http://HOST:PORT/proxy")
            return cls(default, url)
        if not text.endswith(".rrd"):
            raise ConfigError(f"--rerun {text}: use {CHOICES}")
        return cls(Path(text))

    @property
    def live(self) -> bool:
        """Return whether a viewer can show the run while it goes on."""
        return self.viewer is not None

    def open(self) -> rr.RecordingStream:
        """Open a stream into it.

        Raises:
            ConfigError: If the file cannot be written, or the viewer is not there.
        """
        stream = rr.RecordingStream(APPLICATION)
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            # The file is written in place, so that a viewer can follow the run, and a killed run leaves a recording.
            if self.viewer is None:
                stream.save(self.file)
            else:
                self.file.touch()
                stream.set_sinks(self._viewer(), rr.FileSink(self.file))
        except (OSError, RuntimeError) as error:
            raise ConfigError(f"{self.file}: the recording cannot be written ({error})") from error
        stream.set_log_tick_enabled(False)
        stream.set_log_time_enabled(False)
        return stream

    def _viewer(self) -> rr.GrpcSink | rr.GrpcServerSink:
        if self.viewer == "serve":
            address = _address(DEFAULT_URL)
            if not _is_free(address):
                raise ConfigError(
                    f"--rerun serve: port {address[1]} is in use; end the program that listens there, or use connect"
                )
            return rr.GrpcServerSink(*address)
        url = DEFAULT_URL if self.viewer == "spawn" else str(self.viewer)
        if self.viewer == "spawn" and _is_free(_address(url)):
            _spawn(url)
        if (reason := _why_no_viewer(url)) is not None:
            raise ConfigError(f"{url}: no rerun viewer listens there ({reason}); start one with: rerun")
        return rr.GrpcSink(url)


def is_whole(file: Path) -> bool:
    """Return whether a recording was closed: after a kill, or on a full disk, it has no footer."""
    try:
        with open_file(file) as recording:
            recording.seek(-min(FOOTER_BYTES, recording.seek(0, os.SEEK_END)), os.SEEK_END)
            return FOOTER in recording.read()
    except OSError:
        return False


def viewer_command() -> list[str]:
    """Return the command of the viewer that came with the SDK, for this machine only.

    Raises:
        ConfigError: If it is missing.
    """
    installed = Path(sys.executable).with_name("rerun")
    program = str(installed) if installed.exists() else shutil.which("rerun")
    if program is None:
        raise ConfigError("the rerun viewer is not installed; pip install semstab, or record into a file")
    return [program, "--bind", "127.0.0.1"]


def _spawn(url: str) -> None:
    """Start a viewer that outlives this process, and wait until it answers.

    Raises:
        ConfigError: If it ends before it answers.
    """
    command = [*viewer_command(), "--port", str(_address(url)[1])]
    environment = os.environ | {"RERUN_APP_ONLY": "true"}
    viewer = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    deadline = time.monotonic() + SPAWN_SECONDS
    while _is_free(_address(url)) and time.monotonic() < deadline:
        if viewer.poll() is not None:
            raise ConfigError(
                f"--rerun spawn: the viewer ended at once (exit code {viewer.returncode}); without a display use serve,"
                " or record into a file"
            )
        time.sleep(0.05)
    viewer.returncode = 0  # it outlives this process, so that Python need not warn of it


def _address(url: str) -> tuple[str, int]:
    parts = urlsplit(url)
    return parts.hostname or "", parts.port or 9876


def _is_free(address: tuple[str, int]) -> bool:
    with contextlib.closing(socket.socket()) as probe:
        return probe.connect_ex(address) != 0


def _why_no_viewer(url: str) -> str | None:
    """Return None if a gRPC server answers; without one the SDK would wait at the end of the run."""
    try:
        with socket.create_connection(_address(url), timeout=ANSWER_SECONDS) as connection:
            if not url.startswith("rerun+http:"):
                return None  # an encrypted connection is not tested
            connection.sendall(HTTP2_PREFACE)
            answer = connection.recv(9)
    except (OSError, ValueError) as error:
        return str(error)
    return None if answer[3:4] == HTTP2_SETTINGS else "another program does"
