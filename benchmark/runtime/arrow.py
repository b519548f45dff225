"""Arrays of numpy as columns of Arrow, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pyarrow as pa


def column(values: npt.NDArray[Any]) -> pa.Array:
    """The values (n,) as Arrow has them, numbers without a copy.

    `pyarrow.array` imports pandas, where that is installed, to see whether it was given a part of it: most of a second.
    """
    import pyarrow as pa

    if values.dtype.kind not in "iuf":
        return pa.array(values)
    values = np.ascontiguousarray(values)
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(values)])


def values_of(column: pa.ChunkedArray) -> npt.NDArray[Any]:
    """A column as numpy has it (n,), numbers in one piece without a copy; `to_numpy` imports pandas as well."""
    import pyarrow as pa

    if column.null_count or not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        return cast(npt.NDArray[Any], column.to_numpy())
    parts = [np.from_dlpack(part) for part in column.chunks]
    return parts[0] if len(parts) == 1 else np.concatenate([np.zeros(0, column.type.to_pandas_dtype()), *parts])
