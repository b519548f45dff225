"""The examples of docstrings: what they may use, and the folder in which they are run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from _pytest.doctest import DoctestItem, DoctestModule

CITY = {"name": "city", "options": {"width": 160, "height": 90, "frames": 24}}
EXAMPLES = re.compile(r"^ *>>> |\.__doc__ = ", re.MULTILINE)
"""In a module that has examples, or takes them over."""

CONFIG = {"dataset": CITY, "scenes": ["scene0"], "voxel_size": 0.5}
SMALLER = CONFIG | {"dataset": {"name": "city", "options": {"width": 96, "height": 54, "frames": 12}}}
"""For examples that run it again, and print no number of it."""


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> DoctestModule | None:
    """Collect the examples of a module that has some; others need not be imported, as `--doctest-modules` does.

    Packages come first: pytest would put a module that it imports over what its package calls by the same name.
    """
    if file_path.suffix != ".py":
        return None
    if file_path.name == "__init__.py" or EXAMPLES.search(file_path.read_text(encoding="utf-8")):
        return DoctestModule.from_parent(parent, path=file_path)
    return None


@pytest.fixture(scope="session")
def example_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished run `run` of two models."""
    import semstab

    folder = tmp_path_factory.mktemp("examples")
    semstab.run({**CONFIG, "events": True}, out=folder / "run", report=False)
    return folder


@pytest.fixture(autouse=True)
def _of_examples(request: pytest.FixtureRequest) -> None:
    """Give an example `semstab`, `np`, six `frames` of a wall, a `config`, and the folder of the run if it names it."""
    item = request.node
    if not isinstance(item, DoctestItem):
        return
    import numpy as np

    import semstab

    source = "".join(example.source for example in item.dtest.examples)
    names: dict[str, Any] = request.getfixturevalue("doctest_namespace")
    names.update(np=np, semstab=semstab, config=SMALLER, frames=[wall(k) for k in range(6)])
    if "semstab." in source:
        request.getfixturevalue("monkeypatch").chdir(
            request.getfixturevalue("example_folder" if "run" in source else "tmp_path")
        )


def wall(k: int) -> Any:
    """A wall in front of a camera that stands still, and labels that move."""
    import numpy as np

    import semstab

    labels = ((np.indices((48, 64)).sum(axis=0) // 16 + k // 3) % 3).astype(np.uint8)
    camera = semstab.Intrinsics(60.0, 60.0, 31.5, 23.5)
    return semstab.Frame(k, np.full((48, 64), 5.0, np.float32), camera, np.eye(4), labels=labels)
