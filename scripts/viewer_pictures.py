"""The README's pictures of the viewer and of the report: a run each, shown without a window.

    python scripts/viewer_pictures.py SHELF FLIGHT [--folder docs] [--only viewer.png viewer-compare.png report.png]

SHELF is the folder of the shelf with its labels, FLIGHT a drone flight with depth (docs/datasets.md says how both are
laid out). Without a graphics card the viewer takes Mesa's lavapipe (Debian: mesa-vulkan-drivers), a minute or two, and
cores that are free; the report takes Chromium and playwright.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image
from rerun.experimental import ViewerClient

from semstab.recording.screenshot import SETTLED_S, headless, paint

WIDTH, REPORT = 1200, (1000, 1480)
"""Pixels of a picture of the viewer, and of the report."""

CITY = ["--scene", "scene0", "--check", "none"]
SHELF = ["--voxel-size", "0.01", "--model", "fcn", "--backend", "numba", "--backend", "open3d-projective",
         "--check", "none"]  # fmt: skip
FLIGHT = ["--predict", "colour-clusters", "--model", "colour-clusters", "--rerun", "off"]


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


def report(run: Path, picture: Path) -> None:
    """Take a picture of the beginning of a run's report."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": REPORT[0], "height": REPORT[1]})
        page.goto((run / "report.html").absolute().as_uri())
        page.wait_for_timeout(1000.0 * SETTLED_S)
        page.screenshot(path=picture)
        browser.close()


def main() -> None:
    """Make the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shelf")
    parser.add_argument("flight")
    parser.add_argument("--only", nargs="+", default=["viewer.png", "viewer-compare.png", "report.png"])
    parser.add_argument("--folder", type=Path, default=Path(__file__).parents[1] / "docs")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    pictures = {
        "viewer.png": (CITY, ""),
        "viewer-compare.png": (["--data", arguments.shelf, *SHELF], "fcn: numba and open3d-projective"),
        "report.png": (["--data", arguments.flight, *FLIGHT], ""),
    }
    for name in arguments.only:
        words, tab = pictures[name]
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            subprocess.run([sys.executable, "-m", "semstab", *words, "--quiet", "--out", str(run)], check=True)
            if name == "report.png":
                report(run, arguments.folder / name)
                continue
            with headless(run / "recording.rrd") as client:
                if tab:
                    show(client, tab)
                paint(client, run / "recording.rrd", arguments.folder / name)
            small(arguments.folder / name)


if __name__ == "__main__":
    main()
