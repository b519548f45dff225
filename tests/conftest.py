import atexit
import gc
import os
import shutil
import signal
import sys
import tempfile
import time

import hypothesis
import pytest
from xdist.scheduler import LoadFileScheduling

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
os.environ["SEMSTAB_CACHE"] = tempfile.mkdtemp(prefix="semstab-cache-")
atexit.register(shutil.rmtree, os.environ["SEMSTAB_CACHE"], ignore_errors=True)
style.DPI = 60  # of the 300 that an installed command writes (test_cli): half of a report's time
configure_process()  # threads that spin would take the time of the other workers' tests


EARLY = (
    "backends", "torch_backend", "check", "city", "images", "tutorials", "predict", "packaging",
    "benchmarks", "study_executors", "notebook", "declared", "online_metric",
)  # fmt: skip
"""Run first: the file that compiles the loops, and beside it some that need none of them; then those that take long."""


class EarlyFirst(LoadFileScheduling):
    """These files first, then those with most tests, as xdist has it."""

    def _assign_work_unit(self, node) -> None:
        for file in (f"tests/test_{name}.py" for name in EARLY):
            if file in self.workqueue:
                self.workqueue.move_to_end(file, last=False)
                break
        super()._assign_work_unit(node)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log) -> LoadFileScheduling | None:
    """Let the workers not compile the same loops at the same time."""
    return EarlyFirst(config, log) if config.getoption("dist") == "loadfile" else None


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over modules and tests, and come less often: it takes a twelfth of the time."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


def pytest_runtest_setup() -> None:
    """Start no test after the moment that `make quick` sets."""
    if time.time() > float(os.environ.get("SEMSTAB_TESTS_UNTIL", "inf")):
        pytest.skip("the time of make quick is over; make test runs it")
