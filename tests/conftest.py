import atexit
import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest

import semstab
from semstab.core.process import configure_process
from semstab.report.figures import style

pytest.register_assert_rewrite("semstab.testing")
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets what it starts in the background ignore Ctrl-C
os.environ["SEMSTAB_CACHE"] = tempfile.mkdtemp(prefix="semstab-cache-")
atexit.register(shutil.rmtree, os.environ["SEMSTAB_CACHE"], ignore_errors=True)
style.DPI = 60  # of the 300 that an installed command writes (test_cli): half of a report's time
configure_process()  # threads that spin would take the time of the other workers' tests


def pytest_configure() -> None:
    """Folders are linked into the environment as such, but benchmark/ child by child: a new child is not found yet."""
    source, found = Path(__file__).parents[1] / "benchmark", Path(semstab.__file__).parent
    known = {path.name for path in found.iterdir()}
    new = [path.name for path in source.iterdir() if path.name not in {*known, "__pycache__"}]
    if (found / "__init__.py").is_symlink() and new:
        raise pytest.UsageError(f"benchmark/{new[0]} is new, and not linked into the environment: run make setup")
