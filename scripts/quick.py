"""Run the tests of what changed since HEAD, the nearest first, then a core of the suite; start none after 40 seconds.

    python scripts/quick.py             # since HEAD; where nothing changed, the core alone
    python scripts/quick.py HEAD~3      # since another commit

Tests that changed come first, then those that call a changed function, if there is a record of that (recorded.py), then
those that are near a changed file: a test file is near a file if it has its name (test_readers_odm.py for odm.py), else
by the fewest imports from the test file to the changed module. `make test` runs all.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from recorded import functions_at, tests_of

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 40
CORE = (
    "test_metrics", "test_measures", "test_statistics_agreement", "test_config", "test_registry", "test_declared",
    "test_pipeline", "test_cli", "test_backends",
)  # fmt: skip
"""Equations, settings, what a fresh machine has, a run, the command line, backends: in this order."""

FAR = 5
"""Imports between a test and a module from which on it is not near."""

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


def changed_lines(file: Path, since: str) -> list[int]:
    """Return the lines of a file that differ from a commit, all of a new file."""
    listed = subprocess.run(
        ["git", "diff", "-U0", since, "--", file], cwd=ROOT, capture_output=True, text=True, check=True
    )
    hunks = re.findall(r"^@@ -\S+ \+(\d+)(?:,(\d+))? @@", listed.stdout, re.MULTILINE)
    if not hunks:
        return [*range(1, len((ROOT / file).read_text("utf-8").splitlines()) + 1)]
    return [line for first, number in hunks for line in range(int(first), int(first) + max(int(number or 1), 1))]


def calling(files: Iterable[Path], since: str) -> list[str]:
    """Return the recorded tests that call functions that changed, a few of each file."""
    found = []
    for file in sorted(file for file in files if module_of(file) is not None and (ROOT / file).exists()):
        found += tests_of(file, functions_at((ROOT / file).read_text("utf-8"), changed_lines(file, since)))
    return list(dict.fromkeys(found))


def module_of(file: Path) -> str | None:
    """Return the name under which a file of the product is imported; None for another file."""
    if file.suffix != ".py" or file.parts[0] not in FOLDERS:
        return None
    below = file.relative_to(file.parts[0]).with_suffix("").parts
    return ".".join((FOLDERS[file.parts[0]], *(part for part in below if part != "__init__")))


def imported(file: Path) -> Iterator[str]:
    """Yield the modules that a file imports, names that it takes from them, and modules that it names in strings."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("semstab."):
            yield node.value.partition(":")[0]  # of a registry: imported when it is asked for


def importers() -> dict[str, set[str]]:
    """Return by whom each module is imported: modules of the product, helpers of the tests, tests by their path."""
    files = {module: file for name in FOLDERS for file in (ROOT / name).rglob("*.py")
             if (module := module_of(file.relative_to(ROOT))) is not None}  # fmt: skip
    for file in (ROOT / "tests").rglob("*.py"):
        files[str(file.relative_to(ROOT)) if file.stem.startswith("test_") else file.stem] = file
    by: dict[str, set[str]] = {module: set() for module in files}
    for module, file in files.items():
        for name in by.keys() & set(imported(file)):
            by[name].add(module)
    return by


def distances(modules: Iterable[str]) -> dict[str, int]:
    """Return how many imports lie between some modules and whatever imports them, itself or by way of others."""
    by, far, met = importers(), dict.fromkeys(modules, 0), list(modules)
    for module in met:  # grows
        for name in sorted(by.get(module, set()) - far.keys()):
            far[name] = far[module] + 1
            met.append(name)
    return far


def selected(files: set[Path], cost: Callable[[Path], float] = lambda test: 0.0) -> list[Path]:
    """Return the test files to run, the nearest first, of equally near ones the cheapest, then the core."""
    tests = sorted(path.relative_to(ROOT) for path in (ROOT / "tests").rglob("test_*.py"))
    stems = {file.stem for file in files if module_of(file) is not None}
    far = distances([module for file in files if (module := module_of(file)) is not None])
    far |= {str(test): 0 for test in tests if test in files or stems & set(test.stem.split("_"))}
    near = sorted(
        (test for test in tests if far.get(str(test), FAR) < FAR), key=lambda test: (far[str(test)], cost(test))
    )
    core = [(ROOT / "tests" / f"{name}.py").relative_to(ROOT) for name in CORE]
    return list(dict.fromkeys([*near, *core]))


def main() -> int:
    """Run them; return the exit code of pytest."""
    since = sys.argv[1] if len(sys.argv) > 1 else "HEAD"
    files = changed(since)
    near, calls = selected(files), calling(files, since)
    tests = [*(str(test) for test in near if test in files), *calls, *(str(test) for test in near if test not in files)]
    print(f"{len(calls)} tests that call what changed, {len(near)} test files, until {SECONDS} s are over:")
    print(f"{', '.join(test.removeprefix('tests/') for test in tests[:6])} ...")
    options = ("-q", "-n", "2", "--dist", "load", "--maxfail", "5", "-rN")
    command = [sys.executable, "-m", "pytest", *options, *tests]
    environment = os.environ | {"SEMSTAB_TESTS_UNTIL": str(time.time() + SECONDS)}
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
