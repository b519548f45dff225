"""Change lines of the product at random, one at a time, and say which of these mutants the tests find.

    python scripts/mutate.py                                    # 100 lines of the whole product; make mutants
    python scripts/mutate.py --lines 30 --seed 1 benchmark/metrics backends
    python scripts/mutate.py --at benchmark/metrics/summary.py:143  # all mutants of a line

A mutant lives in a copy of the repository. It meets the tests that `make quick` runs after a change of its function,
test files that name its function or class first, of equally near ones those that take less time, until one fails. A
test is said to have killed it only if it passes without it, and one that hangs only if it soon ends without it: else it
stays open. Mutants that survive either do what the code did, or show that a test is missing: at most a quarter of those
that change behaviour may. Where the time is over before all tests have started, a mutant stays open.
"""

from __future__ import annotations

import argparse
import ast
import collections
import copy
import itertools
import os
import queue
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from quick import FOLDERS, ROOT, module_of, selected
from recorded import functions_at, tests_of

HANGS = 120
"""Seconds after the last moment at which a test may start until it counts as one that hangs, ..."""

SOON = HANGS / 5
"""... if it ends within these seconds without the mutant: on a busy machine each test may take long."""

SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip

BOUNDS: dict[type[ast.AST], tuple[type[ast.AST], type[ast.AST]]] = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.GtE), ast.Gt: (ast.GtE, ast.Lt), ast.GtE: (ast.Gt, ast.LtE),
}  # fmt: skip
"""The comparisons that differ where both sides are equal, and where they are not."""

NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "argmin": "argmax", "argmax": "argmin"}


@dataclass(frozen=True)
class Mutant:
    """A change of one expression or statement: bytes begin to end of a file, in the function or class of a name."""

    file: Path
    within: str
    line: int
    begin: int
    end: int
    before: str
    after: str

    def source(self, content: bytes) -> bytes:
        """Return the content of the file with the change."""
        return content[: self.begin] + self.after.encode() + content[self.end :]

    def __str__(self) -> str:
        before, after = (re.sub(r"\s+", " ", text) for text in (self.before, self.after))
        return f"{self.file}:{self.line}  {_short(before)}  ->  {_short(after)}"


def _short(text: str, most: int = 60) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."


def changes(node: ast.AST) -> Iterator[str]:
    """Yield the source of what may stand in the place of an expression or statement."""
    match node:
        case ast.Compare(ops=ops):
            for k, op in enumerate(ops):
                for other in BOUNDS.get(type(op)) or (SWAPPED[type(op)],):
                    changed = copy.deepcopy(node)
                    changed.ops[k] = other()  # type: ignore[call-overload]
                    yield ast.unparse(changed)
        case ast.BinOp() | ast.AugAssign() | ast.BoolOp() if type(node.op) in SWAPPED and not _of_text(node):
            changed = copy.deepcopy(node)
            changed.op = SWAPPED[type(node.op)]()  # type: ignore[assignment]
            yield ast.unparse(changed)
            if isinstance(node, ast.AugAssign):
                yield "pass"
        case ast.UnaryOp(op=ast.Not()):
            yield f"({ast.unparse(node.operand)})"
        case ast.Constant(value=bool()):
            yield str(not node.value)
        case ast.Constant(value=int() | float()) if node.value + 1 != node.value:
            yield from (repr(node.value + 1), f"({node.value - 1!r})")
        case ast.Call(func=ast.Name(id=name)) if name in NAMES:
            yield ast.unparse(ast.Call(ast.Name(NAMES[name]), node.args, node.keywords))
        case ast.Call(func=ast.Attribute(attr=name)) if name in NAMES:
            yield ast.unparse(ast.Call(ast.Attribute(node.func.value, NAMES[name]), node.args, node.keywords))
        case ast.Expr(value=ast.Call()) | ast.Raise() | ast.Continue() | ast.Break():
            yield "pass"
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield "pass"


def _of_text(node: ast.AST) -> bool:
    """Return whether an operation joins texts or lists, where another one only raises an error."""
    sides = [child for child in ast.iter_child_nodes(node) if isinstance(child, ast.expr)]
    return not isinstance(node, ast.BoolOp) and any(
        isinstance(side, ast.JoinedStr | ast.List | ast.Tuple)
        or (isinstance(side, ast.Constant) and isinstance(side.value, str | bytes))
        for side in sides
    )


def _nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what a program computes with: no types, and no texts, in which Python 3.11 does not know the places.

    Where right code is called, what zip and data classes are told of errors and of comparison changes nothing.
    """
    if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
        return
    if isinstance(node, ast.keyword) and node.arg in ("strict", "frozen", "eq"):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name not in ("annotation", "returns", "type_params"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _nodes(child)


def mutants(file: Path) -> list[Mutant]:
    """Return all mutants of a file, relative to the repository."""
    content = (ROOT / file).read_bytes()
    starts = [0, *itertools.accumulate(len(line) for line in content.splitlines(keepends=True))]
    found = []
    for top in ast.parse(content).body:
        for node in (node for node in _nodes(top) if isinstance(node, ast.expr | ast.stmt)):
            begin = starts[node.lineno - 1] + node.col_offset
            end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
            place = file, getattr(top, "name", ""), node.lineno, begin, end, content[begin:end].decode()
            found += [Mutant(*place, after) for after in changes(node)]
    return found


def drawn(files: Iterable[Path], lines: int, rng: random.Random) -> list[Mutant]:
    """Return one mutant for each of `lines` random lines; each line has the same probability."""
    by_line: dict[tuple[Path, int], list[Mutant]] = {}
    for mutant in itertools.chain.from_iterable(map(mutants, files)):
        by_line.setdefault((mutant.file, mutant.line), []).append(mutant)
    chosen = rng.sample(sorted(by_line), min(lines, len(by_line)))
    return [rng.choice(by_line[line]) for line in chosen]


class Copy:
    """A copy of the repository, in which one mutant at a time meets the tests."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stamps = itertools.count(int(time.time()), 2)
        listed = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.splitlines()
        for name in filter(os.path.lexists, map(ROOT.joinpath, listed)):
            path = folder / name.relative_to(ROOT)
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(name, path, follow_symlinks=False)

    def write(self, file: Path, content: bytes) -> None:
        """Write a file of the product, with a time of its own: compiled code of another version is not taken."""
        (self.folder / file).write_bytes(content)
        os.utime(self.folder / file, (stamp := next(self._stamps), stamp))

    def first_failure(self, tests: list[str], seconds: float, longest: float = HANGS) -> str | None:
        """Return the first test that fails, None if all pass, OPEN if some did not start within `seconds`.

        If a test is still at work `longest` seconds later, it is that test, after HANG.
        """
        asked = ("-x", "-v", "--tb=no", "-rfE", "--durations=0", "-p", "no:cacheprovider")
        command, until = [sys.executable, "-m", "pytest", *asked, *tests], time.time() + seconds
        settings = {"PYTHONPATH": str(self.folder / "src"), "SEMSTAB_TESTS_UNTIL": str(until), "COLUMNS": "300"}
        options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        with subprocess.Popen(command, cwd=self.folder, env=os.environ | settings, **options) as process:
            try:
                said, _ = process.communicate(timeout=seconds + longest)
            except subprocess.TimeoutExpired as ended:
                process.kill()
                said = ended.output or b""  # bytes, though the process was opened for text
                return HANG + at_work(said.decode() if isinstance(said, bytes) else said)
        record(said)
        if process.returncode in (0, 5):  # 5: no tests are left
            return OPEN if time.time() > until else None
        failed = re.search(r"^(?:FAILED|ERROR) (.*?)(?: - .*)?$", said, re.MULTILINE)
        return failed[1] if failed else f"pytest ended with code {process.returncode}: {said[-200:]}"


def at_work(said: str) -> str:
    """Return the test that pytest had begun, and not ended, when it was killed; '' if it had begun no test."""
    last = said.rsplit("\n", 1)[-1].strip()
    return last if "::" in last else ""


def record(said: str) -> None:
    """Keep how long the tests of each file took, as pytest lists it."""
    seconds = collections.Counter[str]()
    for taken, file in re.findall(r"^ *([\d.]+)s (?:call|setup|teardown) +([^:\s]+)::", said, re.MULTILINE):
        seconds[file] += float(taken)
    TAKEN.update({file: max(now, TAKEN.get(file, 0.0)) for file, now in seconds.items()})


def cost(test: Path) -> float:
    """Return the seconds that a test file took, or else, after all that are known, its size."""
    return TAKEN.get(str(test), UNKNOWN + (ROOT / test).stat().st_size)


TAKEN: dict[str, float] = {}
"""Seconds that the tests of a file took with a mutant so far."""

UNKNOWN = 1e6
HANG = "a test that hangs: "
OPEN = "open: the time was over before all tests had started"


def met(mutant: Mutant, copies: queue.Queue[Copy], seconds: float) -> str | None:
    """Return the test that kills a mutant, None if the mutant survives, OPEN if time was over."""
    module = module_of(mutant.file)
    assert module is not None
    examples = f"src/{module.replace('.', '/')}"
    content, copied, passed = (ROOT / mutant.file).read_bytes(), copies.get(), list[str]()
    nearest = selected({mutant.file}, cost)
    tests = sorted(nearest, key=lambda test: mutant.within not in (ROOT / test).read_text("utf-8"))
    words = tests_of(mutant.file, functions_at(content.decode(), [mutant.line]))
    words += [*map(str, tests), examples + (".py" if (ROOT / f"{examples}.py").exists() else "/__init__.py")]
    until = time.time() + seconds
    try:
        while True:
            copied.write(mutant.file, mutant.source(content))
            try:
                found = copied.first_failure([*words, *passed], max(until - time.time(), 1))
            finally:
                copied.write(mutant.file, content)
            if found is not None and found.startswith(HANG):
                test = found.removeprefix(HANG)
                return found if test and copied.first_failure([test], SOON, 0.0) is None else OPEN
            if found is None or "::" not in found:
                return found
            if copied.first_failure([found], seconds) is None:
                return found
            passed += ["--deselect", found]  # it fails without the mutant, too
    finally:
        copies.put(copied)


def product(given: Iterable[Path]) -> list[Path]:
    """Return the files of the product in some files and folders, or all, relative to the repository."""
    chosen = [path.resolve() for path in given] or [ROOT / name for name in FOLDERS]
    files = {file for path in chosen for file in ([path] if path.is_file() else path.rglob("*.py"))}
    return sorted(name for file in files if module_of(name := file.relative_to(ROOT)) is not None)


def _each(pool: ThreadPoolExecutor, fates: Iterable[Future[str | None]]) -> Iterator[Future[str | None]]:
    """Yield the fates as they are known; start no other mutant after Ctrl-C."""
    try:
        yield from as_completed(fates)
    finally:
        pool.shutdown(cancel_futures=True)


def main() -> int:
    """Draw mutants, let them meet the tests, print what became of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path, help="files and folders of the product; all by default")
    parser.add_argument("--lines", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="mutants that are tested at once")
    parser.add_argument("--seconds", type=float, default=300, help="no test of a mutant starts later")
    parser.add_argument("--at", metavar="FILE:LINE", action="append", help="all mutants of this line, instead of drawn")
    arguments = parser.parse_args()
    if arguments.at:
        places = [
            (Path(file).resolve().relative_to(ROOT), int(line))
            for file, _, line in (x.rpartition(":") for x in arguments.at)
        ]
        chosen = [mutant for file, line in places for mutant in mutants(file) if mutant.line == line]
    else:
        chosen = drawn(product(arguments.paths), arguments.lines, random.Random(arguments.seed))
    told, copies = collections.Counter[str](), queue.Queue[Copy]()
    with tempfile.TemporaryDirectory(prefix="semstab-mutants-") as folder, ThreadPoolExecutor(arguments.jobs) as pool:
        for k in range(arguments.jobs):
            copies.put(Copy(Path(folder) / str(k)))
        fates = {pool.submit(met, mutant, copies, arguments.seconds): mutant for mutant in chosen}
        for fate in _each(pool, fates):
            killer = fate.result()
            became = "survived" if killer is None else "open" if killer == OPEN else "killed"
            told[became] += 1
            said = killer if became == "open" else "SURVIVED" if killer is None else f"killed by {killer}"
            print(f"{fates[fate]}\n    {said}", flush=True)
    counts = ", ".join(f"{told[became]} {became}" for became in ("killed", "survived", "open"))
    print(f"{len(chosen)} mutants: {counts}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
