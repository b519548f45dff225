"""Compiled loops, and the folder of numba's cache: next to the code, or another that can be written."""

from __future__ import annotations

import contextlib
import gc
import os
import stat
import sys
import tempfile
import time
import types
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

settings: Any = nb.config
"""numba's, whose names come with it."""

if sys.platform == "linux":  # the TBB that Open3D loads is too old for numba, which would say so each time
    settings.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]


def compiled(*, helper: bool = False, **options: Any) -> Callable[[Any], Any]:
    """Return a decorator that compiles a function at its first call, and stores the code for later processes.

    The code is stored in __pycache__ next to the source, below HOME, or below the temporary folder. Without such a
    folder, each process compiles again.

    Args:
        helper: Only compiled functions call the function, Python does not. What a call from Python needs is then not
            compiled; for all helpers together that would take a tenth of the time of a first run.
        options: Options of `numba.njit`.
    """
    if helper:
        options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

    def decorate(function: Any) -> Any:
        dispatcher = nb.njit(error_model="numpy", nogil=True, **options)(function)
        if helper:
            dispatcher._insert = _tell_python_nothing
            dispatcher._compile_for_args = _refuse
        try:
            dispatcher._cache = _Cache(function)
        except RuntimeError:  # there is no folder for its cache
            if folder := _own_temporary_folder():
                settings.CACHE_DIR = folder
                with contextlib.suppress(RuntimeError):
                    dispatcher._cache = _Cache(function)
        return dispatcher

    return decorate


def _tell_python_nothing(*_: Any, **__: Any) -> None:
    """Let no call from Python find compiled code, which has no way in."""


def _refuse(*_: Any, **__: Any) -> None:
    """Raise TypeError for a call from Python."""
    raise TypeError("this is a helper of compiled functions; decorate it with `serial` to call it from Python")


class _Cache(FunctionCache):
    """Compiled code of a function, taken only if all that it was compiled from is unchanged.

    numba alone checks the function's own file, not those of the functions and constants that it takes in.
    """

    def __init__(self, function: Any) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        stamp = _stamp(function, frozenset())
        self._cache_file = IndexDataCacheFile(self.cache_path, self._impl.filename_base, stamp)  # type: ignore[no-untyped-call]

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return compiled code, or None if it is missing or damaged: unpickling may raise any exception."""
        try:
            return super().load_overload(signature, context)  # type: ignore[no-untyped-call]
        except Exception:  # noqa: BLE001
            return None

    def save_overload(self, signature: Any, data: Any) -> None:
        """Store compiled code; replace a damaged index, and store nothing on a full disk."""
        try:
            super().save_overload(signature, data)  # type: ignore[no-untyped-call]
        except Exception:  # noqa: BLE001
            with contextlib.suppress(Exception):
                self._cache_file.flush()  # type: ignore[no-untyped-call]
                super().save_overload(signature, data)  # type: ignore[no-untyped-call]


def _stamp(function: Any, visited: frozenset[Any]) -> tuple[Any, ...]:
    """Return time and size of the file of a function, and of what it names: compiled functions, numbers, arrays."""
    file = Path(function.__code__.co_filename)
    stamp: list[Any] = [(file.name, file.stat().st_mtime, file.stat().st_size) if file.exists() else file.name]
    names, codes = set[str](), [function.__code__]
    for code in codes:  # with those of functions inside it, which are added as they come
        names.update(code.co_names)
        codes += [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    for name in sorted(names):
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher) and value.py_func not in visited:
            stamp.append(_stamp(value.py_func, visited | {function}))
        elif isinstance(value, bool | int | float | str | tuple | np.ndarray | np.generic):
            stamp.append((name, value.tobytes() if isinstance(value, np.ndarray) else repr(value)))
    return tuple(stamp)


class _RestingCollector(event.Listener):
    """Lets the garbage collector rest while numba compiles: it would take a twelfth of that time."""

    def __init__(self) -> None:
        self._depth, self._was_enabled = 0, False

    def on_start(self, event: Any) -> None:
        """Stop the collector when the outermost function begins to compile."""
        if self._depth == 0:
            self._was_enabled = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """Let the collector run again when the outermost function is compiled, or has failed to compile."""
        self._depth -= 1
        if self._depth == 0 and self._was_enabled:
            gc.enable()


event.register("numba:compile", _RestingCollector())  # type: ignore[no-untyped-call]

serial = compiled()
helper = compiled(helper=True)
parallel = compiled(parallel=True)


CHUNKS = 64
"""Number of chunks of a loop over voxels, for any number of threads."""

SHORT = 0.002
"""Seconds of a loop, about, up to which it starts no threads: to start and to end them takes as long."""


def in_chunks(loop: Any, *arguments: Any) -> None:
    """Run a compiled loop once for each chunk, in as many threads as numba may use, with the same numbers for any.

    Such loops hold no lock. numba's own parallel form of them would take three times as long to compile.
    """
    threads, left = nb.get_num_threads(), iter(range(CHUNKS))

    def take_chunks() -> None:
        for chunk in left:
            loop(chunk, *arguments)

    started = time.perf_counter()
    loop(next(left), *arguments)
    if threads == 1 or CHUNKS * (time.perf_counter() - started) < SHORT:
        take_chunks()
        return
    with ThreadPoolExecutor(threads - 1) as pool:
        others = [pool.submit(take_chunks) for _ in range(threads - 1)]
        take_chunks()
        for other in others:
            other.result()


def is_cached(function: Any) -> bool:
    """Return whether an earlier process left the code of a compiled function."""
    source = f"{function.__module__.rpartition('.')[2]}.{function.__qualname__}-*.nbi"
    folder = function.stats.cache_path
    return folder is not None and any(Path(folder).glob(source))


def _own_temporary_folder() -> str | None:
    """Return a folder that nobody else can write to, as code is loaded from it, or None without such a folder."""
    folder = Path(tempfile.gettempdir()) / f"semstab-compiled-{os.getuid()}"
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o022:
            return str(folder)
    return None
