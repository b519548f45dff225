"""Arrays of numpy as columns of Arrow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

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
