"""The README's pictures of the viewer: a run each, shown by a viewer without a window, and what it paints.

    python scripts/viewer_pictures.py SHELF [--folder docs]

SHELF is the folder of the shelf with its labels (docs/datasets.md says how it is laid out). Without a graphics card it
takes Mesa's lavapipe (Debian: mesa-vulkan-drivers), a minute or two, and cores that are free.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image
from rerun.experimental import ViewerClient

from semstab.recording.screenshot import SETTLED_S, headless, paint

WIDTH = 1200
"""Pixels of a picture."""

CITY = ["--scene", "scene0", "--check", "none"]
SHELF = ["--voxel-size", "0.01", "--model", "fcn", "--backend", "numba", "--backend", "open3d-projective",
         "--check", "none"]  # fmt: skip


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
    time.sleep(SETTLED_S)


def small(path: Path) -> None:
    """Bring a picture to the width that the pages show."""
    with Image.open(path) as picture:
        size = WIDTH, round(WIDTH * picture.height / picture.width)
        smaller = picture.resize(size, Image.Resampling.LANCZOS)
    smaller.save(path, optimize=True)


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
            with headless(run / "recording.rrd") as client:
                if tab:
                    show(client, tab)
                paint(client, run / "recording.rrd", arguments.folder / name)
            small(arguments.folder / name)


if __name__ == "__main__":
    main()
