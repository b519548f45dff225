"""Files that are either there and whole, or not there: they are written under another name, then renamed."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import shutil
import stat
import tempfile
import weakref
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from semstab.core.json_form import to_json
from semstab.core.types import UInt8
from semstab.errors import ConfigError, DataError, summarize_error

TEMPORARY = ".semstab-"
"""The beginning of the names of files that are not whole yet."""

SCRATCH = "semstab-scratch-"
"""The beginning of the names of temporary folders that a process holds a lock on."""

BRIEFLY = 0.2
"""Seconds for which another process may hold a lock file to see that nobody needs it."""

MAX_YAML_BYTES = 2**24


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`; rename it to `path` if the block succeeds, else remove it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = _locked_temporary(path)
    try:
        yield temporary
        os.umask(mask := os.umask(0))
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    except OSError as error:  # one from writing, a full disk for example, does not know its file
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)
        os.close(handle)


def _locked_temporary(path: Path) -> tuple[int, Path]:
    """Create a temporary file next to a path, locked so that `remove_abandoned` leaves it alone."""
    while True:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=TEMPORARY, suffix=path.suffix)
        with suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_SH)
        if Path(name).exists():  # else it was removed before it was locked
            return handle, Path(name)
        os.close(handle)


def not_written() -> OSError:
    """Return the error of a file that a library wrote without an error and not whole; `atomic_path` names it."""
    return OSError(errno.ENOSPC, "could not be written whole; the disk may be full")


class FolderLock:
    """A folder that one process owns until `release`, or until it dies.

    Raises:
        ConfigError: If another one has it, unless `wait`: then it is waited for.
    """

    def __init__(self, path: Path, *, wait: bool = False) -> None:
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        self._handle: int | None = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            self.release()
            raise ConfigError(f"{path}: another process works on it; wait for it, or choose another folder") from error
        remove_leftovers(path)

    def release(self) -> None:
        """Let another process have it."""
        if self._handle is not None:
            os.close(self._handle)
        self._handle = None


@contextmanager
def only_writer(path: str | Path) -> Iterator[None]:
    """Let no other process write a file while the block lasts.

    Raises:
        ConfigError: If another one writes it.
    """
    from filelock import FileLock, Timeout

    real = Path(path).resolve()
    real.parent.mkdir(parents=True, exist_ok=True)
    name = hashlib.blake2b(os.fsencode(real.name), digest_size=8).hexdigest()
    lock = FileLock(real.parent / f"{TEMPORARY}{name}.lock", timeout=BRIEFLY)
    try:
        lock.acquire()
    except Timeout as error:
        raise ConfigError(f"{path}: another process writes it; wait for it, or name another file") from error
    except OSError:  # a file system without locks; what else there is, writing the file says
        pass
    try:
        yield
    finally:
        Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()


class ScratchFolder:
    """A temporary folder that is removed with the last reference to it, with its process, or after a kill by the next.

    In a `with` statement it is its path, and is removed at the end of the block.

    Attributes:
        path: The folder, empty.
    """

    def __init__(self) -> None:
        _remove_abandoned_scratch(Path(tempfile.gettempdir()))
        while True:
            folder = Path(tempfile.mkdtemp(prefix=SCRATCH))
            try:
                handle = os.open(folder, os.O_RDONLY)
            except FileNotFoundError:  # another process took it for one that is abandoned
                continue
            with suppress(OSError):  # a file system without locks
                fcntl.flock(handle, fcntl.LOCK_SH)
            if folder.exists():  # else it was removed before it was locked
                break
            os.close(handle)
        self.path = folder / "files"  # a run locks it
        self.path.mkdir()
        self.remove = weakref.finalize(self, _remove_scratch, folder, handle)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.remove()


def _remove_scratch(folder: Path, handle: int) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    os.close(handle)


def _remove_abandoned_scratch(folder: Path) -> None:
    """Remove the scratch folders of this user that no process holds."""
    for path in folder.glob(f"{SCRATCH}*"):
        with suppress(OSError):
            handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(handle).st_uid == os.getuid():
                    shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(handle)


def remove_leftovers(folder: Path) -> None:
    """Remove what `atomic_path` left where its process was killed; nobody else may be writing there."""
    for path in folder.glob(f"{TEMPORARY}*"):
        path.unlink()


def remove_abandoned(folder: Path) -> None:
    """Remove what `atomic_path` left in a folder that others may be writing to: the files that no process holds."""
    for path in folder.glob(f"{TEMPORARY}*"):
        with suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` atomically, in UTF-8."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: Any) -> None:
    """Write `value`, a dataclass for example, atomically as JSON; undefined numbers (NaN, infinity) become null."""
    write_text(path, json.dumps(to_json(value), indent=2, allow_nan=False) + "\n")


SEAL = "digest"
"""The field of a sealed JSON file that has the digest of all others."""


def write_sealed(path: str | Path, value: Any) -> None:
    """Write a dataclass or mapping as `write_json` does, with the digest of its fields as a last one."""
    content = to_json(value)
    write_json(path, content | {SEAL: content_key(content)})


def require_seal(path: str | Path, content: Any) -> dict[str, Any]:
    """Return the content of a sealed JSON file without its digest.

    Raises:
        DataError: If the digest is another one, so that the file has changed since it was written.
    """
    fields = {key: value for key, value in content.items() if key != SEAL} if isinstance(content, dict) else {}
    with suppress(RecursionError, UnicodeError):
        if fields and content.get(SEAL) == content_key(fields):
            return fields
    raise DataError(f"{path}: has changed since the run wrote it; run the same command again")


def read_sealed(path: str | Path) -> dict[str, Any]:
    """Read what `write_sealed` wrote; raise DataError with the file's name if it cannot be read or has changed."""
    return require_seal(path, read_json(path))


def csv_text(text: str) -> str:
    """Return a name for a cell of a CSV file, in which a spreadsheet sees no formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def write_image(path: str | Path, image: npt.NDArray[Any], *settings: int) -> None:
    """Write a grey or BGR image atomically, in the format of the path's suffix, with settings of OpenCV."""
    import cv2

    with atomic_path(path) as temporary:  # imwrite does not say that the disk is full
        temporary.write_bytes(cv2.imencode(Path(path).suffix, image, settings)[1].tobytes())


def write_stack(
    path: Path, key: str, layers: Iterable[npt.NDArray[Any]], count: int, dtype: np.dtype[Any] | None, compressed: bool
) -> None:
    """Write an .npz file of one array, of `count` layers of one shape that come one after the other.

    Numbers are stored as `dtype`, or with None, in the type of the first layer.
    """
    method = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    zipped = zipfile.ZipFile(path, "w", method, compresslevel=1)
    with zipped as archive, archive.open(f"{key}.npy", "w", force_zip64=True) as file:
        for number, layer in enumerate(layers):
            if number == 0:
                dtype = dtype or layer.dtype
                shape = (count, *layer.shape)
                header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, header)
            file.write(np.ascontiguousarray(layer, dtype=dtype).data)


def cache_folder() -> Path:
    """Return the folder of caches: SEMSTAB_CACHE, or semstab below the system's folder, ~/.cache or XDG_CACHE_HOME."""
    import platformdirs

    if path := os.environ.get("SEMSTAB_CACHE"):
        return Path(path)
    return platformdirs.user_cache_path("semstab", appauthor=False)


def content_key(settings: Mapping[str, Any]) -> str:
    """Return a hash of settings that JSON holds, in any order."""
    return hashlib.blake2b(json.dumps(settings, sort_keys=True).encode(), digest_size=16).hexdigest()


def keep_only(written: Collection[Path], folder: Path) -> None:
    """Remove other files of the same kinds from a folder of results: outdated ones of an earlier start."""
    kinds = {path.suffix for path in written}
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.suffix in kinds and path not in written:
            path.unlink()


def parse_json(text: str | bytes) -> Any:
    """Return the content of JSON.

    Raises:
        ValueError: If it is none, or nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_json(path: str | Path) -> Any:
    """Read a JSON file; raise DataError with the file's name if it cannot be read."""
    try:
        with open_file(path) as file:
            return parse_json(file.read().decode("utf-8"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise DataError(f"{path}: not valid JSON ({summarize_error(error)})") from error


def read_limited(path: str | Path, limit: int) -> bytes:
    """Return the content of a file. Raises OSError also for a pipe, a device, and a file larger than the limit."""
    with open_file(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > limit:
            raise OSError(errno.EFBIG, f"{size} bytes are too many for such a file, at most {limit}")
        return file.read()


def open_file(path: str | Path) -> BufferedReader:
    """Return a file, to read bytes from. Raises OSError also for a pipe, a device, and all but regular files."""
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "no file can have such a name")
    # a pipe to which nobody writes opens at once
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "it is no regular file")
    return file


FILE_DIGEST = "sha256"
"""Processors have instructions for it: there it takes half of blake2b's time."""


def file_digest(path: Path) -> bytes:
    """Return a hash of a file's content.

    Raises:
        DataError: If it cannot be read.
    """
    try:
        with open_file(path) as file:
            return hashlib.file_digest(file, FILE_DIGEST).digest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


YAML_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The one of libyaml, which takes an eighth of the time, where PyYAML was built with it."""


def parse_yaml(text: str, where: str) -> Any:
    """Return the content of a YAML text, without tags that make objects.

    Raises ConfigError in one line that starts with `where` if the text is not valid.
    """
    try:
        return YAML_LOADER(text).get_single_data()
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError, RecursionError) as error:
        # PyYAML lets other errors than its own escape, for example for the date 2020-13-45
        raise ConfigError(f"{where}: not valid YAML ({summarize_error(error)})") from error


# Arrays for a later start, which are read as they were written, or not at all.

Arrays = Mapping[str, npt.NDArray[Any]]

DIGEST = "digest"


def write_arrays(path: Path, arrays: Mapping[str, Any], *, packed: bool = True) -> None:
    """Write numbers and arrays of numbers by name, atomically, with a digest of all of them; packed: compressed."""
    made: dict[str, Any] = {name: np.asarray(array) for name, array in arrays.items()}
    made[DIGEST] = _digest(made)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        (np.savez_compressed if packed else np.savez)(file, **made)


def read_arrays(path: Path) -> Arrays | None:
    """Return the arrays that `write_arrays` wrote; None if the file is missing or has changed."""
    try:
        with path.open("rb") as file, np.load(file) as content:
            arrays = {name: content[name] for name in content.files}
    except Exception:  # noqa: BLE001  numpy raises a dozen kinds of them on a damaged .npz file
        return None
    digest = arrays.pop(DIGEST, None)
    valid = all(isinstance(array, np.ndarray) for array in arrays.values())  # a file that is not an array gives bytes
    return arrays if valid and digest is not None and np.array_equal(digest, _digest(arrays)) else None


def _digest(arrays: Arrays) -> UInt8:
    """Return the hash of names, types, shapes and numbers."""
    digest = hashlib.blake2b(digest_size=16)
    for name, array in sorted(arrays.items()):
        digest.update(repr((name, array.dtype.str, array.shape)).encode() + np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
