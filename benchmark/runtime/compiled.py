"""How loops are compiled, and where numba keeps what it compiled: beside the code, or where that can be written."""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba as nb

settings: Any = nb.config
"""numba's, whose names come with it."""

if sys.platform == "linux":  # the TBB that Open3D loads is too old for numba, which would say so each time
    settings.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]


def compiled(**options: Any) -> Callable[[Any], Any]:
    """A decorator that compiles a function at its first call, and keeps the code for later processes.

    numba keeps it in __pycache__ beside the source, or else below HOME. Where neither can be written it goes below the
    temporary folder, and if that cannot be either each process compiles anew; numba alone would refuse the import.
    """

    def decorate(function: Any) -> Any:
        dispatcher = nb.njit(error_model="numpy", nogil=True, **options)(function)
        try:
            dispatcher.enable_caching()
        except RuntimeError:  # there is no place for its cache
            if folder := _own_temporary_folder():
                settings.CACHE_DIR = folder
                with contextlib.suppress(RuntimeError):
                    dispatcher.enable_caching()
        return dispatcher

    return decorate


serial = compiled()
parallel = compiled(parallel=True)


def is_kept(function: Any) -> bool:
    """Whether an earlier process left the code of a compiled function."""
    source = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}-*.nbi"
    folder = function.stats.cache_path
    return folder is not None and any(Path(folder).glob(source))


def _own_temporary_folder() -> str | None:
    """A folder that nobody else can write to, as code is loaded from it; None where there can be none."""
    folder = Path(tempfile.gettempdir()) / f"semstab-compiled-{os.getuid() if hasattr(os, 'getuid') else ''}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    own = not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o022)
    return str(folder) if stat.S_ISDIR(found.st_mode) and own else None
