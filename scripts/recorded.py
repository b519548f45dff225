"""Say which tests call a function of the product, as recorded by coverage.py while they ran.

    make record    # runs the suite, and writes what it recorded to .tests_of_functions.json

`make quick` and `make mutants` begin with these tests. Without a record, and for what no test calls in its own process
(compiled loops, what a worker does), they choose test files by imports; see quick.py. A function keeps its tests while
it keeps its name, so a record needs to be made again only now and then.
"""

from __future__ import annotations

import ast
import collections
import json
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import coverage

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / ".tests_of_functions.json"

MOST = 100
"""Most tests of a function that are kept: those that call the fewest functions."""


def functions(source: str) -> Iterator[tuple[str, range, range]]:
    """Yield each function of a module: its qualified name, its lines with decorators, and those of its body."""
    inside: list[tuple[ast.AST, str]] = [(ast.parse(source), "")]
    for node, prefix in inside:  # grows
        for child in ast.iter_child_nodes(node):
            name = f"{prefix}{child.name}" if isinstance(child, ast.FunctionDef | ast.ClassDef) else ""
            if isinstance(child, ast.FunctionDef):
                end = (child.end_lineno or child.lineno) + 1
                first = min([child.lineno, *(decorator.lineno for decorator in child.decorator_list)])
                yield name, range(first, end), range(child.body[0].lineno, end)
            inside.append((child, f"{name}." if name else prefix))


def functions_at(source: str, lines: Iterable[int]) -> set[str]:
    """Return the names of the innermost functions that have one of the lines."""
    spans, names = list(functions(source)), set()
    for line in lines:
        around = [(len(whole), name) for name, whole, _ in spans if line in whole]
        names |= {min(around)[1]} if around else set()
    return names


def tests_of(file: Path, names: Iterable[str]) -> list[str]:
    """Return the tests, as pytest takes them, that call functions of a file; those that call the fewest come first."""
    if not RECORD.exists():
        return []
    record = json.loads(RECORD.read_text("utf-8"))
    of_file = record["functions"].get(str(file), {})
    numbers = sorted({number for name in names for number in of_file.get(name, ())})
    return [test for test in (record["tests"][number] for number in numbers) if _is_there(test)]


def _is_there(test: str) -> bool:
    """Return whether a test still has its name."""
    file, *_, name = test.split("::")
    return (ROOT / file).exists() and f"def {name}(" in (ROOT / file).read_text("utf-8")


def condensed(data: coverage.CoverageData) -> dict[str, Any]:
    """Return the tests, those that call the fewest functions first, and their numbers by file and function.

    Args:
        data: Recorded with a context for each test.
    """
    calls: dict[tuple[str, str], set[str]] = {}
    for path in map(Path, sorted(data.measured_files())):
        if not path.is_relative_to(ROOT) or not path.exists():
            continue
        by_line = data.contexts_by_lineno(str(path))
        for name, _, body in functions(path.read_text("utf-8")):
            contexts = {context for line in body for context in by_line.get(line, ())}
            tests = {context.rpartition("|")[0].partition("[")[0] for context in contexts} - {""}
            if tests:
                calls[str(path.relative_to(ROOT)), name] = tests
    counts = collections.Counter(test for tests in calls.values() for test in tests)
    ordered = sorted(counts, key=lambda test: (counts[test], test))
    number = {test: place for place, test in enumerate(ordered)}
    by_file: dict[str, dict[str, list[int]]] = {}
    for (file, name), tests in calls.items():
        by_file.setdefault(file, {})[name] = sorted(number[test] for test in tests)[:MOST]
    return {"tests": ordered, "functions": by_file}


def main() -> int:
    """Run the tests, all or those that are named, and write the record; return the exit code of pytest."""
    import coverage

    found = ROOT / ".coverage"
    options = (
        "-q",
        "-n",
        "auto",
        "--maxprocesses",
        "4",
        "--dist",
        "loadfile",
        "--no-loadscope-reorder",
        "-p",
        "pytest_cov",
    )
    recorded = ("--cov=semstab", "--cov-context=test", "--cov-report=")
    chosen = sys.argv[1:] or ["--ignore", "tests/docs"]
    code = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *recorded, *chosen], cwd=ROOT, check=False
    ).returncode
    data = coverage.CoverageData(str(found))
    data.read()
    record = condensed(data)
    RECORD.write_text(json.dumps(record, separators=(",", ":")), "utf-8")
    found.unlink()
    print(f"{RECORD.name}: {len(record['tests'])} tests, {sum(map(len, record['functions'].values()))} functions")
    return code


if __name__ == "__main__":
    sys.exit(main())
