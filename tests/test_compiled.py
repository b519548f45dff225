"""Compiled code is kept where that is possible, and compiled anew where it is not; nothing fails for it."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numba
import pytest

import semstab
from semstab.core.compiled import helper, serial

IMPORT = """
from semstab.backends.numba_hash import NumbaHash
from semstab.core.compiled import serial

@serial
def twice(x):
    return 2 * x

assert twice(4) == 8
"""

ALL = """
import semstab.recording, semstab.statistics.loops.orders  # whatever is compiled is imported without an error
"""

RUN = """
from semstab.cli import main

main()
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A copy of the package beside whose files nothing can be kept: not even root makes a folder of a file."""
    site = tmp_path_factory.mktemp("site")
    shutil.copytree(Path(semstab.__file__).parent, site / "semstab", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [site, *(path for path in site.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").write_text("")
    (site / "program.py").write_text(ALL + IMPORT)
    (site / "program_that_runs.py").write_text(IMPORT + RUN)
    return site


def run(
    program: Path, arguments: Sequence[str | Path], tmp_path: Path, **environment: str
) -> subprocess.CompletedProcess[str]:
    home = tmp_path / "home"
    home.write_text("a file, so that nothing can be written below it")
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "XDG", "PYTHON", "TMP"))}
    settings = {"HOME": str(home), "PYTHONPATH": str(program.parent), "MPLCONFIGDIR": str(tmp_path), **environment}
    return subprocess.run(
        [sys.executable, program, *arguments], env=inherited | settings, capture_output=True, text=True, check=False
    )


def test_a_read_only_install_without_a_home_keeps_its_code_in_the_temporary_folder(installed, tmp_path) -> None:
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    arguments = ["--version"]
    elsewhere = {"TMPDIR": str(temporary), "NUMBA_CACHE_DIR": str(tmp_path / "home" / "cache")}
    done = run(installed / "program_that_runs.py", arguments, tmp_path, **elsewhere)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    (folder,) = temporary.glob("semstab-compiled-*")
    assert folder.stat().st_mode & 0o077 == 0
    assert list(folder.rglob("program_that_runs.twice*.nbi"))


def test_where_nothing_can_be_kept_it_is_compiled_anew(installed, tmp_path) -> None:
    """A folder of that name that others can write to is not trusted: code is loaded from it."""
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    theirs = temporary / f"semstab-compiled-{os.getuid()}"
    theirs.mkdir()
    theirs.chmod(0o777)
    done = run(installed / "program.py", (), tmp_path, TMPDIR=str(temporary))
    assert done.returncode == 0, done.stderr
    assert not list(theirs.iterdir())


COUNT = """
from numba.core import event

class Counter(event.Listener):
    compiled = 0

    def on_start(self, event):
        Counter.compiled += 1

    def on_end(self, event):
        pass

event.register("numba:compile", Counter())

import numpy as np
from semstab.backends.shared.columns import blocks_of

blocks_of(np.zeros((1, 3), np.int64), 4)
print(Counter.compiled)
"""


def test_a_read_only_install_is_compiled_once_into_the_cache_of_the_user(installed, tmp_path) -> None:
    (installed / "program_that_counts.py").write_text(COUNT)
    home = tmp_path / "of the user"
    home.mkdir()
    counts = []
    for _ in range(2):
        done = run(installed / "program_that_counts.py", (), tmp_path, HOME=str(home))
        assert done.returncode == 0, done.stderr
        counts.append(int(done.stdout))
    assert counts[0] > 0
    assert counts[1] == 0
    assert list(home.rglob("columns._number*.nbi"))


HELPERS = """
from semstab.core.compiled import serial

OFFSET = 1

@serial
def helper(x):
    return x + OFFSET
"""
CALLER = """
from helpers import OFFSET, helper
from semstab.core.compiled import serial

@serial
def caller(x):
    return 10 * helper(x) + OFFSET

print(caller(1), sum(caller.stats.cache_hits.values()))
"""


def test_code_is_compiled_again_where_what_it_takes_in_has_changed_or_is_damaged(tmp_path) -> None:
    """The numba cache looks at a function's own file, and would go on with the code of a helper that is no more."""

    def called() -> str:
        path = f"{tmp_path}{os.pathsep}{Path(semstab.__file__).parents[1]}"
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "PYTHON"))}
        done = subprocess.run(
            [sys.executable, tmp_path / "caller.py"], env=environment | {"PYTHONPATH": path}, capture_output=True,
            text=True, check=False,
        )  # fmt: skip
        return done.stdout.strip() or done.stderr

    (tmp_path / "helpers.py").write_text(HELPERS)
    (tmp_path / "caller.py").write_text(CALLER)
    assert called() == "21 0"
    changed = HELPERS.replace("OFFSET = 1", "OFFSET = 2").replace("x + OFFSET", "x + OFFSET + 3")
    (tmp_path / "more.py").write_text(changed)
    (tmp_path / "helpers.py").write_text("from more import OFFSET, helper")  # moved, too, as between versions
    assert called() == "62 0"
    for file in (tmp_path / "__pycache__").glob("caller*.nb*"):
        file.write_bytes(file.read_bytes()[:40])
    assert called() == "62 0"
    assert called() == "62 1"


@helper
def three_times(x):
    return 3 * x


@serial
def six_times(x):
    return 2 * three_times(x)


def test_python_cannot_call_a_helper_of_compiled_functions():
    for _ in range(2):  # before and after it is compiled
        with pytest.raises(TypeError, match="helper of compiled functions"):
            three_times(4)
        assert six_times(4) == 24


def test_the_garbage_collector_runs_again_after_a_function_was_compiled_or_failed():
    @serial
    def cannot_be_compiled(x):
        return x.nothing_of_this_name

    assert gc.isenabled()
    with pytest.raises(numba.TypingError):
        cannot_be_compiled(4)
    assert gc.isenabled()
