"""How compiled loops over voxels are spread over threads, with the same numbers for any number of them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba as nb

CHUNKS = 64
"""Voxels go by so many chunks, whatever the number of threads."""


def in_chunks(loop: Any, *arguments: Any) -> None:
    """Run a compiled loop once for each chunk, in as many threads as numba may use.

    Such loops hold no lock. numba's own parallel form of them would take three times as long to compile.
    """
    if (threads := nb.get_num_threads()) == 1:
        for chunk in range(CHUNKS):
            loop(chunk, *arguments)
        return
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(loop, chunk, *arguments) for chunk in range(CHUNKS)]:
            done.result()
