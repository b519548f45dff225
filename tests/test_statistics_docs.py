"""The code in docs/metrics.md runs and prints what stands below it; the package is light to import."""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path

DOCUMENT = Path(__file__).parent.parent / "docs" / "metrics.md"


def test_the_code_in_the_document_prints_what_stands_below_it():
    blocks = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert len(blocks) == 1
    names = {}
    for code, expected in blocks:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, str(DOCUMENT), "exec"), names)  # a block may go on from those before
        assert printed.getvalue() == expected


def test_importing_the_statistics_imports_nothing_heavy():
    code = "import semstab.statistics, sys; print({'numba', 'scipy', 'open3d', 'pyarrow', 'cv2'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "set()"
