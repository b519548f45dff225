"""What is installed holds every file of the source, and a file is found as soon as it is there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path
from typing import Any

import pytest

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


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path, Path]:
    """The source's files, the unpacked sdist, and a wheel built from it, as installers do; of a copy of the source."""
    base = tmp_path_factory.mktemp("packaging")
    copy = base / "source"
    for folder in (*PACKAGES, "docs", "src"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(SOURCE / folder, copy / folder, symlinks=True, ignore=ignored)
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(SOURCE / name, copy)
    files = [path.relative_to(copy) for folder in PACKAGES for path in (copy / folder).rglob("*") if path.is_file()]
    with tarfile.open(build("build_sdist", copy, base)) as sdist:
        trusted: dict[str, Any] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # from 3.11.4 on
        sdist.extractall(base / "unpacked", **trusted)
    (unpacked,) = (base / "unpacked").iterdir()
    return files, unpacked, build("build_wheel", unpacked, base)


def test_wheel_and_sdist_hold_every_file(built) -> None:
    files, unpacked, wheel = built
    installed = [Path(PACKAGES[path.parts[0]], *path.parts[1:]) for path in files]
    wanted = [*(Path("src", path) for path in installed), "README.md", "docs/definitions.md"]
    assert [path for path in wanted if not (unpacked / path).is_file()] == []
    held = set(zipfile.ZipFile(wheel).namelist())
    assert [path for path in installed if str(path) not in held] == []
    assert {name.split("/")[0] for name in held} == {"semstab", f"{wheel.name.split('-py3')[0]}.dist-info"}


def test_the_metadata_say_who_what_and_where(built) -> None:
    with zipfile.ZipFile(built[2]) as wheel:
        (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
        found = message_from_bytes(wheel.read(name))
    assert [
        key for key in ("Name", "Version", "Summary", "Author", "Keywords", "License-Expression") if not found[key]
    ] == []
    assert all(" https://" in url for url in found.get_all("Project-URL"))
    text = found.get_payload()
    assert "semstab-bench check" in text
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert links
    assert [link for link in links if not link.startswith("https://")] == []  # an index has none of our files


def test_an_installed_wheel_starts_in_an_empty_folder(built, tmp_path) -> None:
    """Only what it depends on is there already."""
    install = ("pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile", "--target", str(tmp_path))
    subprocess.run([sys.executable, "-m", *install, str(built[2])], check=True, capture_output=True)
    where = {**os.environ, "PYTHONPATH": str(tmp_path), "COLUMNS": "120"}
    started = (("-c", "import semstab; print(semstab.__file__)"), ("-m", "semstab", "--help"))
    module, text = (
        subprocess.run(
            [sys.executable, *args], cwd=tmp_path, env=where, check=True, capture_output=True, text=True
        ).stdout
        for args in started
    )
    assert Path(module.strip()).is_relative_to(tmp_path)
    assert "--voxel-size" in text
