"""The console on which all is printed: names of folders and of files of others cannot steer the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Any

import rich.console
from rich.segment import Segment

from semstab.errors import printable

WIDTH = 80
"""Columns that a text takes at most, unless the caller says otherwise."""


class Console(rich.console.Console):
    """A console that writes a character without a shape, as ESC and marks of direction are, as its code.

    Colours and the cursor's moves come from rich, apart from the text.
    """

    def render(self, renderable: Any, options: Any = None) -> Iterable[Segment]:
        """Return what rich makes of it, its text as people can read it."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(printable(segment.text, keep="\n"), segment.style)


def wrapped(text: str, width: int = WIDTH, *, begin: str = "  ", hanging: int = 4) -> list[str]:
    """Return a text as lines that are broken between words, never at the hyphen of a name.

    Args:
        text: The text.
        width: Columns of a line.
        begin: Begins the first line.
        hanging: Columns by which the other lines are indented.
    """
    return textwrap.wrap(text, width, initial_indent=begin, subsequent_indent=" " * hanging, break_on_hyphens=False)
