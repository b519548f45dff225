"""What each dependency of the base install costs: its own files, and what would go with it if it went (MB).

Run in the environment to measure: python scripts/dependency_cost.py
"""

from __future__ import annotations

import configparser
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement


def megabytes(name: str) -> float:
    """Of the installed files of a distribution."""
    paths = (Path(str(file.locate())) for file in metadata.distribution(name).files or ())
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def needed(names: Iterable[str]) -> set[str]:
    """These distributions and all that they need, as far as installed."""
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop().lower().replace("_", "-")
        try:
            own = map(Requirement, metadata.requires(name) or ())
        except metadata.PackageNotFoundError:
            continue
        if name not in found:
            found.add(name)
            waiting += [each.name for each in own if each.marker is None or each.marker.evaluate({"extra": ""})]
    return found


def main() -> None:
    """One line a dependency, the dearest first."""
    setup = configparser.ConfigParser()
    setup.read(Path(__file__).parents[1] / "setup.cfg")
    base = [Requirement(line).name for line in setup["options"]["install_requires"].split()]
    every = needed(base)
    rows = []
    for name in base:
        alone = every - needed(set(base) - {name})
        rows.append((sum(map(megabytes, alone)), megabytes(name), len(alone), name))
    print(f"{sum(map(megabytes, every)):.0f} MB in {len(every)} packages\n   own  saved  packages")
    for saved, own, packages, name in sorted(rows, reverse=True):
        print(f"{own:6.1f} {saved:6.1f} {packages:9}  {name}")


if __name__ == "__main__":
    main()
