"""Fill the disk at each write of runs, studies, predictions and conversions: at every page that they take.

    python tests/faults/disk.py [STEP [KIND]]            make faults: every page, of 4 kB

Each gets a file system in memory of one page more than the one before (every STEP-th), until all of it fits. It has to
end in one line and exit code 2, and with a larger disk, started again, to keep what was finished and to leave what one
without a full disk leaves. Mounting takes a name space of one's own (`unshare`), where the system lets users have it.
"""

from __future__ import annotations

import collections
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import kills

PAGE = 4096
MARK = "SEMSTAB_OWN_MOUNTS"
ENOUGH = 2**28


@contextmanager
def disk(path: Path, size: int) -> Iterator[Path]:
    """A file system of so many bytes."""
    path.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(path)], check=True)
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


def enlarge(path: Path) -> None:
    subprocess.run(["mount", "-o", f"remount,size={ENOUGH}", str(path)], check=True)


def taken(path: Path) -> int:
    """Bytes of a file system that are in use."""
    found = os.statvfs(path)
    return (found.f_blocks - found.f_bfree) * found.f_frsize


def finished_units(out: Path) -> dict[str, int]:
    """What is kept of a run or study, by the time at which it was written."""
    return {path.name: path.stat().st_mtime_ns for path in out.glob("units/*.json")}


def problem(code: int, said: str) -> str | None:
    """What is wrong with an end on a full disk; None where it is one line that names a file."""
    lines = [line for line in said.splitlines() if line.strip()]
    if code != 2:
        return f"exit code {code}: {said[-1000:]}"
    if len(lines) != 1 or not re.match(r"(error|warning): ", lines[0]) or len(lines[0]) > 410:
        return f"not one line: {said[-1000:]}"
    return None


def main(step: int, wanted: str) -> int:
    told, wrong = collections.Counter[str](), []
    with tempfile.TemporaryDirectory() as temporary:
        base = Path(temporary)
        for kind, (words, left) in kills.kinds(base).items():
            if wanted not in kind:
                continue
            with disk(base / "disk", ENOUGH) as whole:
                kills.finished(words(whole / "out"), base / "log")
                expected, size = left(whole / "out"), taken(whole)
            for limit in range(PAGE, 2 * size, step * PAGE):
                with disk(base / "disk", limit) as small:
                    _, status = os.waitpid(kills.in_a_child(words(small / "out"), base / "log"), 0)
                    code = os.waitstatus_to_exitcode(status)
                    fault = problem(code, (base / "log").read_text(errors="replace")) if code else None
                    kept = finished_units(small / "out")
                    enlarge(small)
                    kills.finished(words(small / "out"), base / "log")
                    again = finished_units(small / "out")
                    if any(again.get(name) != when for name, when in kept.items()):
                        fault = f"{len(kept)} finished units, not all of them kept"
                    if left(small / "out") != expected:
                        fault = "differs, started again"
                told[f"{kind}, {'ended' if code == 0 else 'full'}"] += 1
                if fault:
                    wrong.append(f"{kind}, {limit // 1024} kB: {fault}")
                    print(wrong[-1], flush=True)
                if code == 0:
                    break
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
        )  # as `settle` has it
    sys.exit(main(int((sys.argv[1:] or ["1"])[0]), (sys.argv[2:] or [""])[0]))
