"""Fill the disk while runs, maps in tiles, studies, predictions and conversions are made: page by page, file by file.

    python tests/faults/disk.py [COUNT [KIND]]           make faults: 12

Each kind gets COUNT file systems in memory from one page (4 kB) to all that it takes, and as many that have room for so
many files, from one to all that it makes, at even steps; every page and every file where COUNT is larger. It has to
end in one line and exit code 2, or to come to its end, and with a larger disk, started again, to keep what was finished
(units, parts of maps in tiles) and to leave what one without a full disk leaves. Mounting takes a name space of one's
own (`unshare`), where the system lets users have it. 12 are some 120 pairs of starts, a quarter of an hour of CPU.
"""

from __future__ import annotations

import collections
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import kills

from semstab.engine.tiles import TileResult
from semstab.engine.work import TILES

PAGE = 4096
MARK = "SEMSTAB_OWN_MOUNTS"
ENOUGH = "size=1073741824,nr_inodes=100000"

Left = Callable[[Path], Any]


@contextmanager
def disk(path: Path, limit: str) -> Iterator[Path]:
    """A file system with so much room: size=BYTES or nr_inodes=FILES."""
    path.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", limit, "none", str(path)], check=True)
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


def enlarge(path: Path) -> None:
    subprocess.run(["mount", "-o", f"remount,{ENOUGH}", str(path)], check=True)


def limits(path: Path, count: int) -> Iterator[str]:
    """So many sizes, and so many numbers of files, up to what a file system holds."""
    found = os.statvfs(path)
    pages = (found.f_blocks - found.f_bfree) * found.f_frsize // PAGE
    for name, most, unit in (("size", pages, PAGE), ("nr_inodes", found.f_files - found.f_ffree, 1)):
        for number in sorted({1 + round(k * most / count) for k in range(count)}):
            yield f"{name}={number * unit}"


def finished(out: Path) -> dict[Path, int]:
    """The finished files of a run or study, by when they were written: of units, and of tiles."""
    results = [TileResult.load(path) for path in out.glob(f"{TILES}/*/*.npz")]
    names = [name for result in results if result is not None for name in result.files]
    files = [out / name for name in names if not name.startswith(f"{TILES}/")]  # the rest goes with the last tile
    return {path: path.stat().st_mtime_ns for path in (*out.glob("units/*.json"), *files)}


def problem(code: int, said: str) -> str | None:
    """What is wrong with an end on a full disk; None where it is one line that names a file."""
    lines = [line for line in said.splitlines() if line.strip()]
    if code not in (0, 2):
        return f"exit code {code}: {said[-1000:]}"
    if code == 2 and (len(lines) != 1 or not re.match(r"(error|warning): ", lines[0]) or len(lines[0]) > 410):
        return f"not one line: {said[-1000:]}"
    if code == 0 and not all(re.match(r"warning: ", line) for line in lines):
        return f"no warning: {said[-1000:]}"
    return None


def fault_of(words: kills.Words, left: Left, expected: Any, out: Path, log: Path) -> tuple[int, str | None]:
    """Start it on a disk that is too small, and again on a larger one: the first exit code, and what went wrong."""
    _, status = os.waitpid(kills.in_a_child(words, log), 0)
    code = os.waitstatus_to_exitcode(status)
    fault = problem(code, log.read_text(errors="replace"))
    times = finished(out)
    enlarge(out.parent)
    kills.finished(words, log)
    if any(not path.exists() or path.stat().st_mtime_ns != when for path, when in times.items()):
        fault = f"of {len(times)} finished files not all were kept"
    return code, "differs, started again" if left(out) != expected else fault


def main(count: int, wanted: str) -> int:
    told, wrong = collections.Counter[str](), []
    with tempfile.TemporaryDirectory() as temporary:
        base = Path(temporary)
        for kind, (words, left) in kills.kinds(base).items():
            if wanted not in kind:
                continue
            with disk(base / "disk", ENOUGH) as whole:
                kills.finished(words(whole / "out"), base / "log")
                expected, tried = left(whole / "out"), list(limits(whole, count))
            for limit in tried:
                with disk(base / "disk", limit) as small:
                    code, fault = fault_of(words(small / "out"), left, expected, small / "out", base / "log")
                told[f"{kind}, {limit.split('=')[0]}, {'full' if code else 'ended'}"] += 1
                if fault:
                    wrong.append(f"{kind}, {limit}: {fault}")
                    print(wrong[-1], flush=True)
    for what, times in sorted(told.items()):
        print(f"{times:4} {what}")
    print(
        f"{told.total() - len(wrong)} of {told.total()} ended in one line, and left what one without a full disk leaves"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    if MARK not in os.environ:
        os.execvpe(
            "unshare", ["unshare", "-rm", sys.executable, *sys.argv], os.environ | {MARK: "1", "RUST_LOG": "off"}
        )  # as `configure_process` has it
    sys.exit(main(int((sys.argv[1:] or ["12"])[0]), (sys.argv[2:] or [""])[0]))
