"""Damage tiny true files of every kind that is read, and see that each is read, or refused in one line.

    python tests/fuzz/fuzz.py [--seconds 60] [--inputs N] [--seed 1] [--kind NAME] [--failures DIR]   make fuzz: an hour

A worker reads; a worker that dies or hangs is replaced. Prints a table by kind, and leaves inputs that fail in DIR,
each with what happened beside it. Exit code 1 where there are any.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import hashlib
import logging
import math
import multiprocessing as mp
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

from kinds import Kind, kinds  # noqa: E402

from semstab.errors import LONGEST_LINE, SemstabError  # noqa: E402

SLOW = 2.0
"""Seconds of computing after which an input hangs; of waiting, thirty times as many: others use the machine."""

DEAD = 90.0
"""Seconds after which a worker that does not even hear the alarm is killed."""

FRESH = 20_000
"""Inputs after which another worker takes over: what libraries leak adds up."""

PEAK = 500
"""Megabytes that one input may take beyond what the process had."""

DIED = "died.txt"
"""Where a worker says why it ends between two inputs."""

LIMIT = 4000
"""Megabytes of addresses beyond what the process had that it gets at all."""


class HangError(BaseException):
    """Raised by the alarm: no library takes it for an error of its own."""


@dataclass(frozen=True)
class Outcome:
    """How one input went: `fault` is None where it was read, or refused as promised; `refused` tells these apart."""

    refused: bool
    fault: str | None = None


def tried(kind: Kind, file: Path, slow: float) -> Outcome:
    """Read a damaged file."""
    signal.setitimer(signal.ITIMER_PROF, slow)
    signal.setitimer(signal.ITIMER_REAL, 30 * slow)
    try:
        kind.read(file)
    except SemstabError as error:
        return Outcome(True, unkind(str(error)))
    except HangError:
        return Outcome(False, f"hangs: {''.join(traceback.format_exc(limit=-6))}")
    except KeyboardInterrupt:
        raise
    except BaseException:  # noqa: BLE001  what it is all about; Rust's panics are no Exceptions
        return Outcome(False, traceback.format_exc())
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    return Outcome(False)


def unkind(message: str) -> str | None:
    """What is wrong with a message; None where it is one line of what people can read."""
    names = ("Error(", "Exception", "Traceback")
    bare = message.rsplit("(", 1)[-1].rstrip(")")
    if "\n" in message or len(message) > LONGEST_LINE or not message.isprintable() or not message:
        return f"no line: {message!r}"
    if any(name in message for name in names) or (bare.endswith("Error") and bare.isidentifier()):
        return f"an exception as message: {message}"
    return None


def inputs(every: list[Kind], seed: int) -> Iterator[tuple[Kind, Path, bytes]]:
    """Kind by kind, for ever: a file and its damaged content."""
    whole = {file: file.read_bytes() for kind in every for file in kind.files}
    rng = random.Random(seed)
    while True:
        for kind in every:
            file = rng.choice(kind.files)
            yield kind, file, kind.damaged(file)(whole[file], rng)


@contextlib.contextmanager
def watched() -> Iterator[None]:
    """The alarms are heard, and nothing is written to the terminal by libraries or by the program's remarks."""

    def ring(*_: object) -> None:
        raise HangError

    before = {alarm: signal.signal(alarm, ring) for alarm in (signal.SIGPROF, signal.SIGALRM)}
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)
        for alarm, handler in before.items():
            signal.signal(alarm, handler)


def attempt(kind: Kind, file: Path, content: bytes, slow: float = SLOW) -> Outcome:
    """Put a damaged file where the true one is, read it, and put that back."""
    whole = file.read_bytes()
    file.write_bytes(content)
    before = peak_mb()
    try:
        outcome = tried(kind, file, slow)
    finally:
        file.unlink(missing_ok=True)
        file.write_bytes(whole)
    if outcome.fault is None and peak_mb() > before + PEAK:
        return Outcome(outcome.refused, f"takes {peak_mb() - before:.0f} MB")
    return outcome


def peak_mb() -> float:
    """The most memory that the process ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def work(folder: str, seed: int, wanted: str | None, pipe: Any) -> None:
    """A worker: tells what it is about to read, then how it went."""
    terminal = os.open(os.devnull, os.O_WRONLY)
    os.dup2(terminal, 2)  # of libraries
    os.dup2(terminal, 1)
    every = [kind for kind in kinds(Path(folder)) if wanted is None or wanted in kind.name]
    for kind in every:
        for file in kind.files:
            kind.read(file)  # a true file is read
    pipe.send([kind.name for kind in every])
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + LIMIT * 2**20, resource.RLIM_INFINITY))
    try:
        with watched():
            for kind, file, content in inputs(every, seed):
                pipe.send((kind.name, file.name, content))
                outcome = attempt(kind, file, content)
                if outcome.fault and outcome.fault.startswith("takes"):
                    Path("/proc/self/clear_refs").write_text("5")  # the peak counts anew
                pipe.send(outcome)
    except BaseException:
        (Path(folder) / DIED).write_text(traceback.format_exc(), encoding="utf-8")
        raise


def report_of(counts: dict[str, collections.Counter[str]]) -> str:
    """The table."""
    lines = [f"{'kind':30} {'inputs':>8} {'read':>8} {'refused':>8} {'failures':>8}"]
    total = sum(counts.values(), collections.Counter[str]())
    for name, count in [*counts.items(), ("all", total)]:
        inputs = sum(count.values())
        lines.append(f"{name:30} {inputs:8} {count['read']:8} {count['refused']:8} {count['failed']:8}")
    return "\n".join(lines)


def fuzz(seconds: float, most: float, seed: int, wanted: str | None, failures: Path) -> int:
    """Run workers for so long, or until so many inputs were read; how many of them failed."""
    counts: dict[str, collections.Counter[str]] = {}
    faults: collections.Counter[str] = collections.Counter()
    end, start, left = None, seed, most
    while end is None or (time.monotonic() < end and left > 0):
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            ours, theirs = mp.Pipe()
            worker = mp.get_context("spawn").Process(target=work, args=(folder, start, wanted, theirs), daemon=True)
            worker.start()
            theirs.close()
            try:
                for name in ours.recv():
                    counts.setdefault(name, collections.Counter())
            except EOFError:
                sys.exit("a true file is not read; see what the worker says without its output shut")
            end = end or time.monotonic() + seconds
            for _ in range(FRESH):
                if time.monotonic() > end or left <= 0:
                    break
                try:
                    name, file, content = ours.recv()
                except EOFError:
                    worker.join()
                    why = Path(folder) / DIED
                    last = why.read_text(encoding="utf-8")[-600:] if why.is_file() else ""
                    faults[f"the worker died between two inputs ({worker.exitcode}), seed {start} {last}"] += 1
                    break
                try:
                    outcome = ours.recv() if ours.poll(DEAD) else Outcome(False, f"hangs for {DEAD} s, deaf")
                except (EOFError, ConnectionResetError):
                    worker.join()
                    outcome = Outcome(False, f"the worker died ({worker.exitcode})")
                left -= 1
                counts[name]["failed" if outcome.fault else "refused" if outcome.refused else "read"] += 1
                if outcome.fault:
                    faults[keep(failures, name, file, content, outcome.fault)] += 1
                    if "worker died" in outcome.fault or "deaf" in outcome.fault:
                        break
            worker.kill()
            worker.join()
            start += 1000
    print(report_of(counts))
    for fault, times in faults.most_common(60):
        print(f"{times:6} {fault}")
    return sum(faults.values())


def keep(failures: Path, name: str, file: str, content: bytes, fault: str) -> str:
    """Store an input that failed and what happened; the fault in a line."""
    where = failures / name.replace("/", "-").replace(" ", "-").replace("*", "")
    where.mkdir(parents=True, exist_ok=True)
    digest = hashlib.blake2b(content, digest_size=6).hexdigest()
    if len(list(where.iterdir())) < 400:
        (where / f"{digest}-{file}").write_bytes(content)
        (where / f"{digest}.log").write_text(fault, encoding="utf-8", errors="backslashreplace")
    lines = fault.strip().splitlines()
    ours = [line.strip() for line in lines if 'File "' in line and "tests/fuzz" not in line]
    return f"{name}: {lines[-1][:120]} {' < '.join(line.split('/')[-1] for line in ours[:-4:-1])}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--inputs", type=float, default=math.inf, help="stop after so many")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind")
    parser.add_argument("--failures", type=Path, default=Path(tempfile.gettempdir()) / "semstab-fuzz")
    given = parser.parse_args()
    found = fuzz(given.seconds, given.inputs, given.seed, given.kind, given.failures)
    if found:
        print(f"{found} inputs failed; they are in {given.failures}")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
