"""Arrays of numpy as columns of Arrow: the same values and types, and no pandas."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

from semstab.runtime.arrow import column


@pytest.mark.parametrize("dtype", ["int32", "uint16", "int64", "float64", "float32", "bool"])
def test_a_column_is_what_arrow_makes_of_the_array(dtype) -> None:
    """Of every second number, which do not lie side by side, and of none."""
    values = np.arange(20).astype(dtype)[::2]
    for some in (values, values[:0]):
        assert column(some).equals(pa.array(some))


def test_pandas_is_not_imported_for_a_column() -> None:
    code = "import sys, numpy; from semstab.runtime.arrow import column; column(numpy.ones(3))"
    subprocess.run([sys.executable, "-c", f"{code}; assert 'pandas' not in sys.modules"], check=True)
