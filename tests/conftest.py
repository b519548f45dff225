import atexit
import gc
import os
import shutil
import signal
import tempfile
import time

import hypothesis
import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read by numpy; the workers share the processors

from semstab.core.process import configure_process
from semstab.report.figures import style

pytest.register_assert_rewrite("semstab.testing")
hypothesis.settings.register_profile("without deadlines", deadline=None)  # a busy machine is no failure
hypothesis.settings.load_profile("without deadlines")
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets what it starts in the background ignore Ctrl-C
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and nohup the end of the terminal
os.environ["SEMSTAB_CACHE"] = tempfile.mkdtemp(prefix="semstab-cache-")
atexit.register(shutil.rmtree, os.environ["SEMSTAB_CACHE"], ignore_errors=True)
style.DPI = 60  # of the 300 that an installed command writes (test_cli): half of a report's time
configure_process()  # threads that spin would take the time of the other workers' tests


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over modules and tests, and come less often: it takes a twelfth of the time."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)


def pytest_runtest_setup() -> None:
    """Start no test after the moment that `make quick` sets."""
    if time.time() > float(os.environ.get("SEMSTAB_TESTS_UNTIL", "inf")):
        pytest.skip("the time of make quick is over; make test runs it")
