"""Arrays of numpy as columns of Arrow: the same values and types, and no pandas."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from semstab.core.arrays import column, values_of


@pytest.mark.parametrize("dtype", ["int32", "uint16", "int64", "float64", "float32", "bool"])
def test_a_column_is_what_arrow_makes_of_the_array(dtype) -> None:
    """Of every second number, which do not lie side by side, and of none."""
    values = np.arange(20).astype(dtype)[::2]
    for some in (values, values[:0]):
        assert column(some).equals(pa.array(some))


@pytest.mark.parametrize("dtype", ["int32", "uint16", "int64", "float64", "float32", "bool"])
def test_a_column_comes_back_as_it_was(dtype) -> None:
    """In one piece, in two, and in none."""
    values = np.arange(20).astype(dtype)
    whole = pa.array(values)
    for parts in ([whole], [whole[:7], whole[7:]], [whole[3:3], whole[11:14]], []):
        found = values_of(pa.chunked_array(parts, pa.from_numpy_dtype(dtype)))
        assert found.dtype == dtype
        assert found.tolist() == [one for part in parts for one in part.to_pylist()]


def test_a_column_with_gaps_has_none_filled_with_what_lay_there() -> None:
    assert np.isnan(values_of(pa.chunked_array([pa.array([1.5, None])]))).tolist() == [False, True]


def test_pandas_is_not_imported_for_a_column(tmp_path: Path) -> None:
    """Neither for one that is made, nor for one that is read, of numbers or of truth values."""
    pq.write_table(pa.table({"op": [1, 2], "firm": [True, False]}), tmp_path / "map.parquet")
    code = "import sys, numpy; from semstab.core.arrays import column; column(numpy.ones(3)); column(numpy.ones(3) > 0)"
    code += "; from semstab.data.voxels import parquet"
    code += f"; parquet.columns({str(tmp_path / 'map.parquet')!r}, ['op', 'firm'])"
    subprocess.run([sys.executable, "-c", f"{code}; assert 'pandas' not in sys.modules"], check=True)
