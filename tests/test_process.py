"""A prepared process lets its threads sleep while they wait, and keeps what the user has chosen."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("name", "default", "other"), [("OMP_WAIT_POLICY", "PASSIVE", "ACTIVE"), ("OPENBLAS_NUM_THREADS", "1", "2")]
)
def test_a_choice_of_the_user_is_kept(name: str, default: str, other: str) -> None:
    script = "import os; from semstab.core import process; process.configure_process()"
    script += f"; print(os.environ['{name}'])"
    for chosen, expected in ({}, default), ({name: other}, other):
        environment = {k: v for k, v in os.environ.items() if k != name} | chosen
        result = subprocess.run(
            [sys.executable, "-c", script], check=True, capture_output=True, text=True, env=environment
        )
        assert result.stdout.strip() == expected
