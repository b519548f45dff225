"""Run the tests of what changed since HEAD, the nearest first, then a core of the suite; start none after 40 seconds.

    python scripts/quick.py             # since HEAD; where nothing changed, the core alone
    python scripts/quick.py HEAD~3      # since another commit

A test file is near a changed file where it changed itself, where it has its name (test_readers_odm.py that of odm.py),
or where it imports the changed module, its package or a neighbour in it. `make test` runs all.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 40
CORE = (
    "test_metrics", "test_measures", "test_statistics_agreement", "test_config", "test_registry", "test_declared",
    "test_pipeline", "test_cli", "test_backends",
)  # fmt: skip
"""Equations, settings, what a fresh machine has, a run, the command line, backends: in this order."""

FOLDERS = {"benchmark": "semstab"} | {
    name: f"semstab.{name}" for name in ("backends", "models", "datasets", "configs", "conformance")
}


def changed(since: str) -> set[Path]:
    """Return the files that differ from a commit, new ones too, relative to the repository."""
    found: set[Path] = set()
    for words in (["diff", "--name-only", since], ["ls-files", "--others", "--exclude-standard"]):
        listed = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        found.update(map(Path, listed.splitlines()))
    return found


def module_of(file: Path) -> str | None:
    """Return the name under which a file of the product is imported; None for another file."""
    if file.suffix != ".py" or file.parts[0] not in FOLDERS:
        return None
    below = file.relative_to(file.parts[0]).with_suffix("").parts
    return ".".join((FOLDERS[file.parts[0]], *(part for part in below if part != "__init__")))


def imported(file: Path) -> Iterator[str]:
    """Yield the modules that a file imports, and the names that it takes from them."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def distance(names: Iterable[str], module: str) -> int:
    """Return 0 where the module itself is among the names, 1 where its package is, 2 for a neighbour, else 9."""
    package = module.rpartition(".")[0]
    known = set(names)
    if module in known:
        return 0
    if package == "semstab":
        return 9
    return 1 if package in known else 2 if any(name.startswith(f"{package}.") for name in known) else 9


def selected(files: set[Path]) -> list[Path]:
    """Return the test files to run, the nearest first, then the core."""
    tests = {path.relative_to(ROOT): set(imported(path)) for path in sorted((ROOT / "tests").rglob("test_*.py"))}
    modules = [module for file in files if (module := module_of(file)) is not None]
    near = {test: min((distance(names, module) for module in modules), default=9) for test, names in tests.items()}
    named = {file.stem for file in files if module_of(file) is not None}
    near |= {test: -1 for test in tests if test in files or named & set(test.stem.split("_"))}
    core = [ROOT / "tests" / f"{name}.py" for name in CORE]
    order = sorted((test for test, far in near.items() if far < 9), key=near.__getitem__)
    return list(dict.fromkeys([*order, *(path.relative_to(ROOT) for path in core)]))


def main() -> int:
    """Run them; return the exit code of pytest."""
    tests = selected(changed(sys.argv[1] if len(sys.argv) > 1 else "HEAD"))
    print(f"{len(tests)} test files, until {SECONDS} s are over: {', '.join(path.stem for path in tests[:6])} ...")
    options = ("-q", "-n", "2", "--dist", "load", "--maxfail", "5", "-rN")
    command = [sys.executable, "-m", "pytest", *options, *map(str, tests)]
    known = os.environ | {"SEMSTAB_TESTS_UNTIL": str(time.time() + SECONDS)}
    return subprocess.run(command, cwd=ROOT, env=known, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
