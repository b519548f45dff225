"""What is installed holds every file of the source, and a file is found as soon as it is there."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tarfile
import venv
import zipfile
from email import message_from_bytes
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from fresh import needed

SOURCE = Path(__file__).parents[1]
PACKAGES = {
    "benchmark": "semstab",
    **{folder: f"semstab/{folder}" for folder in ("backends", "models", "datasets", "configs", "conformance")},
}
TAG = sys.implementation.cache_tag
Done = subprocess.CompletedProcess[str]
SMALL = ("--option", "width=96", "--option", "height=54")
FEW = ("--scene", "scene0", "--frames", "::8", *SMALL, "--voxel-size", "0.8")
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
        assert [member.name for member in sdist if member.issym() or member.islnk()] == []
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


def test_what_is_published_holds_no_link(built) -> None:
    """The source links its folders; an archive with links could not be unpacked on every system."""
    _, unpacked, wheel = built
    assert (SOURCE / "src/semstab").is_symlink()
    assert [path for path in unpacked.rglob("*") if path.is_symlink()] == []
    assert [
        member.filename for member in zipfile.ZipFile(wheel).infolist() if stat.S_ISLNK(member.external_attr >> 16)
    ] == []


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


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean environment that holds the wheel and what it declares, as `pip install` leaves it; its folder bin/.

    The packages of the dependencies are links to those of this environment: nothing is downloaded.
    """
    environment = tmp_path_factory.mktemp("clean")
    venv.create(environment, symlinks=True)
    python = environment / "bin" / "python"
    (site,) = environment.glob("lib/python*/site-packages")
    for distribution in map(metadata.distribution, needed(["semstab"]) - {"semstab"}):
        files = [file for file in distribution.files or () if ".." not in file.parts]
        whole = {file.parts[0] for file in files if file.name in ("__init__.py", "METADATA") and len(file.parts) == 2}
        for name in whole | {str(file) for file in files if file.parts[0] not in whole}:
            source, target = Path(str(distribution.locate_file(name))), site / name
            if source.exists() and not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                target.symlink_to(source)
    install = ("install", "--quiet", "--no-compile", "--no-deps", "--no-index", str(built[2]))
    for words in (install, ("check",)):
        subprocess.run([sys.executable, "-m", "pip", "--python", python, *words], check=True, capture_output=True)
    take_compiled(site)
    return python.parent


def take_compiled(site: Path) -> None:
    """Give the installed files the time of the source's, with the code that earlier tests left compiled beside those.

    Python compiles the other modules when they are imported; test_compiled.py compiles loops anew where there is none.
    """
    for folder, package in PACKAGES.items():
        for file in (SOURCE / folder).rglob("*.py"):
            there = site / package / file.relative_to(SOURCE / folder)
            shutil.copystat(file, there)
            cache = file.parent / "__pycache__"
            for code in (*cache.glob(f"{file.stem}.*.nb[ci]"), *cache.glob(f"{file.stem}.{TAG}.pyc")):
                (there.parent / "__pycache__").mkdir(exist_ok=True)
                shutil.copy2(code, there.parent / "__pycache__")


@pytest.fixture(scope="module")
def elsewhere(installed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the installed command has done its main job."""
    folder = tmp_path_factory.mktemp("elsewhere")
    done = command(installed, folder, "--backend", "open3d", "-m", "sim-flicker", *FEW, "--out", "run")
    assert done.returncode == 0, done.stderr
    return folder


def command(installed: Path, folder: Path, *words: str, program: str = "semstab-bench") -> Done:
    hidden = ("PYTHONPATH", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if name not in hidden} | {"COLUMNS": "120"}
    return subprocess.run(
        [installed / program, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_an_installed_wheel_does_its_main_job_in_any_folder(elsewhere, installed) -> None:
    found = {path.name for path in (elsewhere / "run").iterdir()}
    assert {"report.html", "recording.rrd", "tables", "summary.json"} <= found
    assert list((elsewhere / "run" / "tables").glob("*.csv"))
    where = command(installed, elsewhere, "-c", "import semstab; print(semstab.__file__)", program="python").stdout
    assert Path(where.strip()).is_relative_to(installed.parent)


IN_TURN = """
import json, sys
from semstab.cli import app

for words in json.loads(sys.argv[1]):
    try:
        app(words)
    except SystemExit as end:
        print(end.code, file=sys.stderr)
"""
NEED_AN_EXTRA = [
    (("export", "run", "--scene", "scene0", "--model", "sim-flicker", "--to", "map.tif"), "geo"),
    ((*FEW, "--predict", "segformer", "--out", "predicted"), "segformer"),
    ((*FEW, "--predict", "model.pt", "--out", "predicted"), "torch"),
    (("--scheduler", "tcp://127.0.0.1:1", "--out", "far"), "cluster"),
    (("--backend", "torch", "--out", "accelerated"), "torch"),
]


def test_what_needs_an_extra_says_in_one_line_how_to_install_it(elsewhere, installed) -> None:
    """One process for all: each start imports what the next one does."""
    (elsewhere / "model.pt").write_bytes(b"")
    commands = json.dumps([words for words, _ in NEED_AN_EXTRA])
    lines = command(installed, elsewhere, "-c", IN_TURN, commands, program="python").stderr.splitlines()
    assert lines[1::2] == ["2"] * len(NEED_AN_EXTRA), lines
    for line, (words, extra) in zip(lines[::2], NEED_AN_EXTRA, strict=True):
        assert line.startswith("error: ")
        assert f"pip install 'semstab[{extra}]'" in line
        assert not (elsewhere / words[-1]).exists()
