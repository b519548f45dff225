"""Run commands in one process in which no distribution can be imported but those that `install_requires` brings.

    python tests/declared_only.py '[["list"], ["--frames", "::4"]]'

Each command ends with the exit code 0, or this program ends with its code. `hide_undeclared` comes before every other
import, so that neither semstab nor what it depends on finds more than on a fresh machine.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import fresh

BESIDE = {"semstab", "pip", "setuptools"}


def hide_undeclared() -> list[str]:
    """Hide the packages of all other distributions, as if they were not installed; returns their import names."""
    declared = fresh.needed(["semstab"]) | BESIDE
    brought = metadata.packages_distributions()
    hidden = {name for name, by in brought.items() if not {fresh.key(requirement) for requirement in by} & declared}
    find = PathFinder.find_spec

    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        return None if name.partition(".")[0] in hidden else find(name, path, target)

    PathFinder.find_spec = find_spec  # type: ignore[method-assign]
    return sorted(hidden)


def main() -> None:
    """Run the commands of the first argument."""
    hidden = hide_undeclared()
    assert "pandas" in hidden
    assert "pytest" in hidden
    for name in [name for name in sys.modules if name.partition(".")[0] in hidden]:
        del sys.modules[name]
    from semstab.cli import app
    from semstab.report.figures import style

    style.DPI = 60  # of 300: half of a report's time
    subprocess.run = _without_a_viewer  # type: ignore[assignment]
    for words in json.loads(sys.argv[1]):
        try:
            if words[0] == "python":
                exec(words[1], {})
            else:
                app(words, standalone_mode=True)
        except SystemExit as end:
            if end.code:
                print(f"{words} ends with {end.code}", file=sys.stderr)
                raise


run = subprocess.run


def _without_a_viewer(command: Sequence[str], **options: Any) -> Any:
    """Run a program, or note the viewer that would need a screen."""
    if "--bind" not in command:
        return run(command, **options)
    print(f"viewer of {command[-1]}")
    return subprocess.CompletedProcess(command, 0)


if __name__ == "__main__":
    main()
