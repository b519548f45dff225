"""Print lines of code by part, and words of documentation, beside their budgets; exit with 1 where one is exceeded.

    python scripts/budgets.py             # 1 if a budget is exceeded
    python scripts/budgets.py --report    # the table only

A part has the Python files of its paths, those below a folder included. Each file belongs to the part that names the
longest path to it, so that a new folder without a budget is an error, too.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

PRODUCT = ("benchmark", "backends", "backbones", "datasets", "configs", "conformance")
BUDGETS: dict[str, tuple[int, tuple[str, ...]]] = {
    "cli": (1_100, ("benchmark/cli", "benchmark/__main__.py")),
    "config": (
        800,
        ("benchmark/config", "benchmark/settings.py", "benchmark/task.py", "benchmark/api.py", "benchmark/__init__.py",
         "configs"),
    ),
    "core": (900, ("benchmark/core", "benchmark/errors.py")),
    "model": (3_000, ("benchmark/model",)),
    "datasets": (4_600, ("datasets",)),
    "city": (1_950, ("datasets/city",)),
    "backends": (4_000, ("backends",)),
    "backbones": (2_600, ("backbones",)),
    "predict": (2_100, ("benchmark/predict", "benchmark/remedies.py")),
    "metrics": (1_300, ("benchmark/metrics", "benchmark/pixels")),
    "statistics": (6_500, ("benchmark/statistics",)),
    "comparison": (2_600, ("benchmark/comparison",)),
    "engine": (3_000, ("benchmark/engine",)),
    "check": (1_750, ("benchmark/check",)),
    "report": (4_500, ("benchmark/report",)),
    "recording": (1_600, ("benchmark/recording",)),
    "exports": (1_950, ("benchmark/exports", "benchmark/convert.py")),
    "online, annotation": (
        1_300,
        ("benchmark/online", "benchmark/exports/annotation.py", "benchmark/exports/annotation_formats.py",
         "benchmark/model/display.py"),
    ),
    "testing, conformance": (1_000, ("benchmark/testing", "conformance")),
}  # fmt: skip
"""Lines of each part, docstrings included, and its paths."""

MOST_LINES, MOST_FILES, MOST_TEST_LINES = 44_000, 220, 24_000

MOST_WORDS, MOST_README_WORDS = 20_000, 900
"""Of the documentation with README, without code; and of README with its code."""

NO_PROSE = re.compile(r"```.*?```|^    .*?$|\]\([^)]*\)", re.DOTALL | re.MULTILINE)


def lines_of(path: Path) -> int:
    """The lines of a file."""
    return len(path.read_text(encoding="utf-8").splitlines())


def words_by_hand() -> int:
    """The words of the documentation and README outside of code and of links."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    return sum(len(re.findall(r"[A-Za-z0-9][^\s|]*", NO_PROSE.sub(" ", page.read_text("utf-8")))) for page in pages)


def python_files(*folders: str) -> Iterator[Path]:
    """The Python files below folders of the repository, relative to it."""
    for folder in folders:
        yield from (path.relative_to(ROOT) for path in sorted((ROOT / folder).rglob("*.py")))


def part_of(file: Path) -> str:
    """The part with the longest path to a file."""
    fits = [
        (len(Path(path).parts), name)
        for name, (_, paths) in BUDGETS.items()
        for path in paths
        if file.is_relative_to(path)
    ]
    return max(fits)[1] if fits else f"{file.parent} (no budget)"


def main(arguments: list[str] | None = None) -> int:
    """Print the table; return 1 if a budget is exceeded, and the table alone was not asked for."""
    parser = argparse.ArgumentParser(description="Print the lines of each part beside its budget.")
    parser.add_argument("--report", action="store_true", help="print only; exit with 0 whatever the numbers are")
    report_only = parser.parse_args(arguments).report

    lines: Counter[str] = Counter(dict.fromkeys(BUDGETS, 0))
    files: Counter[str] = Counter()
    for file in python_files(*PRODUCT):
        lines[part_of(file)] += lines_of(ROOT / file)
        files[part_of(file)] += 1
    test_lines = sum(lines_of(ROOT / file) for file in python_files("tests"))

    rows = [(name, count, BUDGETS[name][0] if name in BUDGETS else 0) for name, count in lines.items()]
    rows += [
        ("all lines", lines.total(), MOST_LINES),
        ("all files", files.total(), MOST_FILES),
        ("test lines", test_lines, MOST_TEST_LINES),
        ("words of docs", words_by_hand(), MOST_WORDS),
        ("words of README", len((ROOT / "README.md").read_text("utf-8").split()), MOST_README_WORDS),
    ]
    width = max(len(name) for name, _, _ in rows)
    print(f"{'part':{width}}  {'files':>5}  {'now':>7}  {'budget':>7}  {'over':>6}")
    for name, count, budget in rows:
        over = f"{count - budget:6,}" if count > budget else ""
        print(f"{name:{width}}  {files[name] or '':>5}  {count:7,}  {budget:7,}  {over:>6}".rstrip())
    exceeded = [name for name, count, budget in rows if count > budget]
    if exceeded and not report_only:
        print(f"over budget: {', '.join(exceeded)}", file=sys.stderr)
    return 1 if exceeded and not report_only else 0


if __name__ == "__main__":
    sys.exit(main())
