"""The README's pictures of the viewer: a run each, shown by a viewer without a window, and what it paints.

    python scripts/viewer_pictures.py SHELF [--folder docs]

SHELF is the folder of the shelf with its labels (docs/datasets.md says how it is laid out). Without a graphics card it
takes Mesa's lavapipe (Debian: mesa-vulkan-drivers), a minute or two, and cores that are free.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image
from rerun.experimental import ViewerClient

WINDOW, BAR, WIDTH = (1500, 850), 38, 1200
"""Pixels of the viewer, of the bar of menus at its top, which is cut off, and of a picture."""

PORT, ATTEMPTS, PATIENCE_S = 9911, 12, 12

CITY = ["--scene", "scene0", "--check", "none"]
SHELF = ["--voxel-size", "0.01", "--model", "fcn", "--backend", "numba", "--backend", "open3d-projective",
         "--check", "none"]  # fmt: skip


@contextlib.contextmanager
def viewer(recording: Path) -> Iterator[ViewerClient]:
    """One that has loaded the recording and is painting it."""
    size = "x".join(map(str, WINDOW))
    command = [
        str(Path(sys.executable).with_name("rerun")),
        str(recording),
        "--headless",
        "--bind",
        "127.0.0.1",
        "--port",
        str(PORT),
    ]
    started = subprocess.Popen([*command, "--window-size", size], start_new_session=True)
    try:
        time.sleep(PATIENCE_S)
        yield ViewerClient.connect(f"rerun+http://127.0.0.1:{PORT}/proxy")
    finally:
        os.killpg(started.pid, signal.SIGTERM)  # the command starts the viewer as a process of its own
        started.wait()


def show(client: ViewerClient, tab: str) -> None:
    """Bring a tab to the front, by its name."""
    layout = client.get_blueprint("recording").blueprint
    container: dict[str, Any] = {
        path: of["ContainerBlueprint"] for path, of in layout.items() if "ContainerBlueprint" in of
    }
    wanted = next(path for path, of in container.items() if of.get("display_name") == tab)
    for of in container.values():
        if of["container_kind"] == "Tabs" and wanted in of["contents"]:
            of["active_tab"] = wanted
    client.set_blueprint(layout, "recording")
    time.sleep(PATIENCE_S)


def paint(client: ViewerClient, path: Path) -> None:
    """What the viewer shows now, as a PNG. Painting without a graphics card is slow: a viewer may ask for more time."""
    for _ in range(ATTEMPTS):
        with contextlib.suppress(TimeoutError):
            client.save_screenshot(str(path))
            break
    with Image.open(path) as screen:
        picture = screen.convert("RGB").crop((0, BAR, *WINDOW))
    picture = picture.resize((WIDTH, round(WIDTH * picture.height / picture.width)), Image.Resampling.LANCZOS)
    picture.save(path, optimize=True)


def main() -> None:
    """Make both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shelf")
    parser.add_argument("--folder", type=Path, default=Path(__file__).parents[1] / "docs")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    pictures = {
        "viewer.png": (CITY, ""),
        "viewer-compare.png": (["--data", arguments.shelf, *SHELF], "fcn: numba and open3d-projective"),
    }
    for name, (words, tab) in pictures.items():
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            subprocess.run(
                [sys.executable, "-m", "semstab", *words, "--report", "off", "--quiet", "--out", str(run)], check=True
            )
            with viewer(run / "recording.rrd") as client:
                if tab:
                    show(client, tab)
                paint(client, (arguments.folder / name).resolve())


if __name__ == "__main__":
    main()
