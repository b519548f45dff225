"""The digests of a finished run's files: a file that changed since the run wrote it is reported, never read."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from semstab.core.files import file_digest, read_sealed, write_sealed
from semstab.errors import DataError

DIGESTS = "digests.json"
"""The file in the folder of a run, next to summary.json: the digest of each table, and of config.yaml, by path."""

SCHEMA = 1

DEEPEST = 2
"""Most folders between a run's and a file: voxels/SCENE__MODEL__BACKEND/tile=X_Y.parquet."""


def write_digests(folder: Path, digests: Mapping[str, str]) -> None:
    """Write the digests of a run's files."""
    write_sealed(folder / DIGESTS, {"schema": SCHEMA, "files": dict(sorted(digests.items()))})


def require_unchanged(path: str | Path) -> None:
    """Require that a file is as its run wrote it; a file without a digest, of no run for example, passes.

    A process digests a file once, as long as neither its size nor its time changes.

    Raises:
        DataError: If its digest is another one.
    """
    path = Path(path)
    for folder in path.absolute().parents[: 1 + DEEPEST]:
        if (digests := folder / DIGESTS).is_file():
            expected = _digests_in(digests, *_state(digests)).get(path.absolute().relative_to(folder).as_posix())
            if expected is not None and path.exists() and _digest_of(path, *_state(path)) != expected:
                raise DataError(f"{path}: has changed since the run wrote it; run the same command again")
            return


def _state(path: Path) -> tuple[int, int, int]:
    """Return what differs once a file was written again."""
    state = path.stat()
    return state.st_ino, state.st_size, state.st_mtime_ns


@lru_cache(maxsize=64)
def _digests_in(path: Path, *_: int) -> Mapping[str, str]:
    content = read_sealed(path)
    files = content.get("files") if content.get("schema") == SCHEMA else None
    if not isinstance(files, dict):
        raise DataError(f"{path}: holds no digests of this version; run the same command again")
    return files


@lru_cache(maxsize=1 << 16)
def _digest_of(path: Path, *_: int) -> str:
    return file_digest(path).hex()
