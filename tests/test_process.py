"""A prepared process keeps what the user has chosen."""

from __future__ import annotations

import os
import subprocess
import sys


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
