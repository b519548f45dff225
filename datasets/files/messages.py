"""Names and paths as error messages list them."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Sequence

MAX_LISTED = 5


def listed(missing: Sequence[str], folder: str = "") -> str:
    """The number of missing files and the first of them, as they are called in the folder."""
    missing = [path.removeprefix(f"{folder}{os.sep}") for path in missing]
    more = f", ... ({len(missing) - MAX_LISTED} more)" if len(missing) > MAX_LISTED else ""
    return f"{len(missing)} missing: {', '.join(missing[:MAX_LISTED])}{more}"


def nearest(name: str, known: Iterable[str]) -> str:
    """The known names, those most like `name` first."""
    names = list(known)
    return f"there are {', '.join(difflib.get_close_matches(name, names, n=len(names), cutoff=0))}"
