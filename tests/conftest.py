import atexit
import collections
import functools
import gc
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Generator
from pathlib import Path

import hypothesis
import pytest
import typer.testing

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read by numpy; the workers share the processors

from semstab.core.process import configure_process
from semstab.report.figures import style

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # each process that a test starts would compile all modules anew
sys.dont_write_bytecode = False
pytest.register_assert_rewrite("semstab.testing")
hypothesis.settings.register_profile("without deadlines", deadline=None)  # a busy machine is no failure
hypothesis.settings.load_profile("without deadlines")
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets what it starts in the background ignore Ctrl-C
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and nohup the end of the terminal


def _temporary_folder_in_memory(folder: Path = Path("/dev/shm"), least: int = 4 << 30) -> None:
    """Let temporary files lie in memory if there is room for a suite's half gigabyte: a file costs a tenth there."""
    if "TMPDIR" in os.environ or not os.access(folder, os.W_OK):
        return
    found = os.statvfs(folder)
    if found.f_bavail * found.f_frsize >= least and not found.f_flag & os.ST_NOEXEC:
        tempfile.tempdir = os.environ["TMPDIR"] = str(folder)  # the latter of workers and of what tests start


_temporary_folder_in_memory()
os.environ["SEMSTAB_CACHE"] = tempfile.mkdtemp(prefix="semstab-cache-")
atexit.register(shutil.rmtree, os.environ["SEMSTAB_CACHE"], ignore_errors=True)
style.DPI = 60  # of the 300 that an installed command writes (test_cli): half of a report's time
typer.testing._get_command = functools.cache(typer.testing._get_command)  # else made from hints at each call
configure_process()  # threads that spin would take the time of the other workers' tests


EARLY = (
    "backends", "torch_backend", "check", "city", "images", "predict", "packaging",
    "performance", "study_executors", "declared", "online_metric",
)  # fmt: skip
"""Files that run first: the one that compiles the loops, beside it some that need none, and those that take long."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files in order: let the workers not compile the same loops at the same time, and none end late.

    `make quick` and `make mutants` have an order of their own.
    """
    if "SEMSTAB_TESTS_UNTIL" in os.environ:
        return
    tests = collections.Counter(item.path for item in items)
    early = {f"test_{name}.py": rank for rank, name in enumerate(EARLY)}
    items.sort(key=lambda item: (early.get(item.path.name, len(early)), -tests[item.path], item.path))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Let the garbage collector rest until all is imported, then pass over modules and tests, and come less often.

    It takes a third of the time of a collection; at its usual pace, a twelfth of the time of the tests.
    """
    gc.disable()
    found = yield
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()
    return found


def pytest_runtest_setup() -> None:
    """Start no test after the moment that `make quick` sets."""
    if time.time() > float(os.environ.get("SEMSTAB_TESTS_UNTIL", "inf")):
        pytest.skip("the time of make quick is over; make test runs it")
