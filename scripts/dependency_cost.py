"""Print the size of each dependency of the base install: its own files, and what would go with it (MB).

Run in the environment to measure: python scripts/dependency_cost.py
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import fresh
from packaging.requirements import Requirement


def megabytes(name: str) -> float:
    """Return the size of the installed files of a distribution."""
    paths = (Path(str(file.locate())) for file in metadata.distribution(name).files or ())
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def main() -> None:
    """One line a dependency, the dearest first."""
    base = [fresh.key(Requirement(line).name) for line in fresh.setup()["options"]["install_requires"].split()]
    every = fresh.needed(base)
    rows = []
    for name in base:
        alone = every - fresh.needed(set(base) - {name})
        rows.append((sum(map(megabytes, alone)), megabytes(name), len(alone), name))
    print(f"{sum(map(megabytes, every)):.0f} MB in {len(every)} packages\n   own  saved  packages")
    for saved, megabytes_alone, packages, name in sorted(rows, reverse=True):
        print(f"{megabytes_alone:6.1f} {saved:6.1f} {packages:9}  {name}")


if __name__ == "__main__":
    main()
