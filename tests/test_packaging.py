"""What is installed holds every file of the source, and a file is found as soon as it is there."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

SOURCE = Path(__file__).parents[1]
PACKAGES = {
    "benchmark": "semstab",
    **{folder: f"semstab/{folder}" for folder in ("backends", "backbones", "datasets", "configs", "conformance")},
}
BUILD = "import sys; from setuptools import build_meta; print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"


def build(what: str, source: Path, out: Path) -> Path:
    done = subprocess.run(
        [sys.executable, "-c", BUILD, what, str(out)], cwd=source, capture_output=True, text=True, check=True
    )
    return out / done.stdout.splitlines()[-1]


def test_wheel_and_sdist_hold_every_file(tmp_path) -> None:
    """The wheel is built from the sdist, as installers do; a copy of the source keeps that clean."""
    copy = tmp_path / "source"
    for folder in PACKAGES:
        shutil.copytree(SOURCE / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(SOURCE / name, copy)
    files = [path.relative_to(copy) for folder in PACKAGES for path in (copy / folder).rglob("*") if path.is_file()]
    with tarfile.open(build("build_sdist", copy, tmp_path)) as sdist:
        sdist.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    assert [path for path in files if not (unpacked / path).is_file()] == []
    with zipfile.ZipFile(build("build_wheel", unpacked, tmp_path)) as wheel:
        held = set(wheel.namelist())
    assert [path for path in files if str(Path(PACKAGES[path.parts[0]], *path.parts[1:])) not in held] == []
