"""Where a recording goes: into a file, and to a viewer while the run goes on."""

from __future__ import annotations

import contextlib
import re
import shutil
import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr

from semstab.errors import ConfigError

DEFAULT_URL = "rerun+http://127.0.0.1:9876/proxy"
CHOICES = "FILE.rrd, spawn, connect, rerun+http://HOST:PORT/proxy, serve, or off"


@dataclass(frozen=True)
class Target:
    """A file, and 'spawn', 'serve' or the URL of a viewer to which the recording is streamed as well."""

    file: Path
    viewer: str | None = None

    @classmethod
    def parse(cls, text: str | None, default: Path) -> Target:
        """What `--rerun` says; `default` is the file where it names none. Raises ConfigError for anything else."""
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
        """Whether somebody may watch while the run goes on."""
        return self.viewer is not None

    def open(self) -> rr.RecordingStream:
        """A stream into it. Raises ConfigError where the file cannot be written, or the viewer is not there."""
        stream = rr.RecordingStream("semstab")
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            # In place, not renamed when it is whole: a viewer can follow the run, and a killed run leaves a recording.
            if self.viewer is None:
                stream.save(self.file)
            else:
                self.file.touch()
                stream.set_sinks(self._viewer(stream), rr.FileSink(self.file))
        except (OSError, RuntimeError) as error:
            raise ConfigError(f"{self.file}: the recording cannot be written ({error})") from error
        stream.set_log_tick_enabled(False)
        stream.set_log_time_enabled(False)
        return stream

    def _viewer(self, stream: rr.RecordingStream) -> rr.GrpcSink | rr.GrpcServerSink:
        if self.viewer == "serve":
            return rr.GrpcServerSink("127.0.0.1")
        if self.viewer == "spawn":
            # Without a stream it would look for a global one, find none, and start nothing.
            rr.spawn(connect=False, executable_path=viewer_program(), recording=stream)
            return rr.GrpcSink(DEFAULT_URL)
        assert self.viewer is not None
        _require_listener(self.viewer)
        return rr.GrpcSink(self.viewer)


def viewer_program() -> str:
    """The viewer that came with the SDK. Raises ConfigError where it is missing."""
    beside = Path(sys.executable).with_name("rerun")
    found = str(beside) if beside.exists() else shutil.which("rerun")
    if found is None:
        raise ConfigError("the rerun viewer is not installed; pip install rerun-sdk, or record into a file")
    return found


def _require_listener(url: str) -> None:
    """Raise ConfigError where nothing listens: the SDK would wait for it at the end of the run."""
    parts = urlsplit(url)
    try:
        with contextlib.closing(socket.create_connection((parts.hostname or "", parts.port or 9876), timeout=5)):
            pass
    except (OSError, ValueError) as error:
        raise ConfigError(f"{url}: no rerun viewer listens there ({error}); start one with: rerun") from error
