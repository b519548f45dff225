import os
import signal
from pathlib import Path

import pytest

from semstab.process import settle

pytest.register_assert_rewrite("semstab.testing")
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets what it starts in the background ignore Ctrl-C
settle()  # threads that spin would take the time of the other workers' tests
if not Path("/dev/nvidiactl").exists():
    os.environ["TRITON_INTERPRET"] = "1"  # before any test imports Triton: its kernels then run without a GPU
