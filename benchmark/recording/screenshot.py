"""A picture of a recording as the rerun viewer shows it, painted without a window."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.files import write_image
from semstab.errors import ConfigError
from semstab.recording.target import viewer_command

WINDOW, BAR = (1500, 850), 38
"""Pixels of the viewer, and of the bar of menus at its top, which is cut off."""

PATIENCE_S, SETTLED_S = 300.0, 5.0
"""How long a viewer has to start, and to paint, which is slow without a graphics card; and to show what it loaded."""

INSTALL = "apt-get install mesa-vulkan-drivers"
"""The package that brings Vulkan without a graphics card to Debian and Ubuntu."""


def screenshot(recording: Path, picture: Path) -> None:
    """Save what the viewer shows of a recording when it has opened it, as a PNG without the bar of menus.

    Raises:
        ConfigError: If the viewer cannot be started, or paints nothing.
    """
    with headless(recording) as client:
        paint(client, recording, picture)


@contextlib.contextmanager
def headless(recording: Path) -> Iterator[Any]:
    """Yield a client, rerun's ViewerClient, of a viewer without a window that has loaded the recording.

    Raises:
        ConfigError: If the viewer ends, or does not answer.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    size = "x".join(map(str, WINDOW))
    command = [*viewer_command(), str(recording), "--headless", "--port", str(port), "--window-size", size]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        yield _loaded(viewer, f"rerun+http://127.0.0.1:{port}/proxy", recording)
    finally:
        if sys.platform == "win32":
            viewer.terminate()
        else:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGTERM)  # the command starts the viewer as a process of its own
        viewer.wait()


def _loaded(viewer: subprocess.Popen[bytes], url: str, recording: Path) -> Any:
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if viewer.poll() is not None:
            raise ConfigError(
                f"{recording}: the viewer ended before it could paint (exit code {viewer.returncode}); without a window"
                f" it needs Vulkan, which a driver of a graphics card brings, or on Debian and Ubuntu {INSTALL}"
            )
        with contextlib.suppress(OSError):  # it does not answer yet
            client = ViewerClient.connect(url)
            if client.get_state().recordings:
                time.sleep(SETTLED_S)
                return client
        time.sleep(0.5)
    raise ConfigError(f"{recording}: the viewer did not answer within {PATIENCE_S:.0f} s; try again")


def paint(client: Any, recording: Path, picture: Path) -> None:
    """Save what the viewer of a client shows now as a PNG, without the bar of menus.

    Raises:
        ConfigError: If it paints nothing.
    """
    from PIL import Image

    deadline = time.monotonic() + PATIENCE_S
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        while not shot.is_file() and time.monotonic() < deadline:
            try:
                client.save_screenshot(str(shot))
            except TimeoutError:  # painting without a graphics card may take longer than it waits
                continue
            except OSError as error:
                raise ConfigError(f"{recording}: the viewer ended while it painted ({error}); try again") from error
        if not shot.is_file():
            raise ConfigError(
                f"{recording}: the viewer painted nothing within {PATIENCE_S:.0f} s; try again when the machine is less"
                " busy"
            )
        with Image.open(shot) as screen:
            write_image(picture, np.asarray(screen.convert("RGB"))[BAR:, :, ::-1])
