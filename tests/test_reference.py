"""The reference pages are those of the code; every public name has its arguments described, and an example.

The examples are run as all doctests are, see conftest.py.
"""

from __future__ import annotations

import pytest
import reference

import semstab


@pytest.mark.parametrize("name", ["cli.md", "python.md"])
def test_a_page_is_what_the_code_says(name) -> None:
    stored = (reference.FOLDER / name).read_text(encoding="utf-8")
    assert stored == reference.pages()[name], "run: python scripts/reference.py"


def section(name: str) -> str:
    """The part of the page about a public name."""
    return reference.pages()["python.md"].partition(f"\n## semstab.{name}\n")[2].partition("\n## ")[0]


@pytest.mark.parametrize("name", semstab.__all__)
def test_every_argument_of_a_public_name_is_described(name) -> None:
    rows = [line for line in section(name).splitlines() if line.startswith("| `")]
    assert [row for row in rows if row.endswith("|  |")] == []


@pytest.mark.parametrize("name", semstab.__all__)
def test_every_public_name_has_an_example(name) -> None:
    assert "```python\n>>> " in section(name)
