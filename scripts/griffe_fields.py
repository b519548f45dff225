"""Lines 'name  what it is' of docstrings as lists, for the pages that are made from them."""

from __future__ import annotations

import re
from typing import Any

import griffe

FIELD = re.compile(r"^(\S[^.:]{0,60}?) {2,}(\S.*)$")


class Fields(griffe.Extension):  # type: ignore[misc]
    """Rewrites each docstring as it is read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Of a module, class or function."""
        if obj.docstring is not None:
            obj.docstring.value = listed(obj.docstring.value)


def listed(text: str) -> str:
    r"""Return the text with its aligned fields as list items.

    >>> print(listed("Two.\n\nop      frames\n        that saw it\nclass   its name"))
    Two.
    <BLANKLINE>
    - `op`: frames that saw it
    - `class`: its name
    """
    lines: list[str] = []
    for line in text.splitlines():
        if field := FIELD.match(line):
            lines += ([""] if lines and lines[-1] and not lines[-1].startswith("- ") else []) + [
                f"- `{field[1]}`: {field[2]}"
            ]
        elif line.startswith("    ") and lines and lines[-1].startswith("- "):
            lines[-1] += f" {line.strip()}"
        else:
            lines.append(line)
    return "\n".join(lines)
