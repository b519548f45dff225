"""A prepared process keeps the memory of one image for the next, and its threads do not spin."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

FAULTS = """
import resource
import numpy as np
from semstab.core.process import configure_process
{call}
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def image():
    np.empty(40_000_000, dtype=np.uint8)[::4096] = 1
image()
before = faults()
for _ in range(5):
    image()
print(faults() - before)
"""


def faults(call: str) -> int:
    script = FAULTS.format(call=call)
    return int(subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout)


@pytest.mark.skipif(
    not hasattr(os, "confstr") or "glibc" not in (os.confstr("CS_GNU_LIBC_VERSION") or ""), reason="glibc"
)
def test_memory_of_an_image_is_used_again() -> None:
    assert faults("configure_process()") < 10
    assert faults("") > 50


def test_a_choice_of_the_user_is_kept() -> None:
    name = "OPENBLAS_NUM_THREADS"
    script = "import os; from semstab.core import process; process.configure_process()"
    script += f"; print(os.environ['{name}'])"
    for chosen, expected in ({}, "1"), ({name: "2"}, "2"):
        environment = {k: v for k, v in os.environ.items() if k != name} | chosen
        result = subprocess.run(
            [sys.executable, "-c", script], check=True, capture_output=True, text=True, env=environment
        )
        assert result.stdout.strip() == expected
