"""How a script of a study ends: with one line if the user can mend what is wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable

import semstab


class StudyError(Exception):
    """Something that the user can mend, in one line."""


def exit_code(work: Callable[[], None]) -> int:
    """Do the work, and return the exit code: 2 after an error that is told in a line."""
    try:
        work()
    except (StudyError, semstab.SemstabError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
