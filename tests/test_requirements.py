"""setup.cfg declares each package that is imported, lowest versions are those that were run, each extra has a use."""

from __future__ import annotations

import ast
import re
import sys
from configparser import ConfigParser
from pathlib import Path

import extras
import lowest
import pytest

SOURCE = Path(__file__).parents[1]
PRODUCT = ("benchmark", "backends", "models", "datasets")
BROUGHT_BY = {
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "lazrs": "laspy[lazrs]",
    "rerun": "rerun-sdk",
    "yaml": "pyyaml",
}


def lines(text: str) -> set[str]:
    """The names of requirements, with their extras."""
    return {re.split(r"[<>=]", line)[0] for line in text.split()}


@pytest.fixture(scope="module")
def declared() -> ConfigParser:
    found = ConfigParser()
    found.read(SOURCE / "setup.cfg")
    return found


def imports(folder: str) -> set[str]:
    """The packages that a folder's files import, wherever in a file."""
    found: set[str] = set()
    for file in (SOURCE / folder).glob("**/*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.partition(".")[0])
    return found - sys.stdlib_module_names - {"semstab"}


def test_every_import_is_declared(declared) -> None:
    extras = dict(declared["options.extras_require"])
    del extras["dev"]
    requirements = lines(declared["options"]["install_requires"]).union(*map(lines, extras.values()))
    used = set.union(*map(imports, PRODUCT))
    assert {"numpy", "torch", "laspy", "pytest"} <= used
    brought = {BROUGHT_BY.get(name, name.replace("_", "-")) for name in used}
    requirements.add("laspy")
    assert brought - requirements == set()


def test_what_is_required_always_is_imported(declared) -> None:
    used = {BROUGHT_BY.get(name, name.replace("_", "-")) for folder in PRODUCT for name in imports(folder)}
    assert lines(declared["options"]["install_requires"]) - used == set()


def test_the_constraints_are_the_lower_bounds() -> None:
    assert lowest.FILE.read_text() == lowest.constraints()
    assert "numpy==2.0\n" in lowest.constraints()


def test_each_extra_has_a_use(declared) -> None:
    assert set(extras.USES) | {"dev"} == set(declared["options.extras_require"])


def test_each_message_names_an_extra_that_there_is(declared) -> None:
    named_extras: set[str] = set()
    for folder in PRODUCT:
        for file in (SOURCE / folder).glob("**/*.py"):
            said = re.findall(r"pip install ([^;,)\n]+)", file.read_text())
            named_extras |= {
                "".join(re.findall(r"semstab\[(\w+)\]", message)) or message.strip("\"' ") for message in said
            }
    extras = set(declared["options.extras_require"]) - {"dev"}
    assert {"geo", "torch", "cluster"} <= named_extras
    assert {
        name for name in named_extras - extras if not name.startswith(("semstab", "opencv-python-headless<5"))
    } == set()
