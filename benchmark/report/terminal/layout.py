"""Text of 80 columns: wrapped sentences, aligned rows, names cut to fit, numbers and shares."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence

from semstab.core.console import wrapped
from semstab.data.statistics import short
from semstab.statistics.verdict import LIMITS

STABLE, USABLE = short(LIMITS.stable), short(LIMITS.usable)
ALPHA = f"alpha: agreement of two views of a spot beyond chance; {STABLE} stable, {USABLE} usable"
COLUMNS = (
    "agree: views with the same class; flicker: pixels that change class per frame",
    "VSS: agreement of a voxel's frames, 1 is perfect; SBD: change of a voxel's belief per frame, in bits; OP: frames"
    " that saw the voxel",
)
OVERLAP = "; mIoU: of the map"
"""The meaning of the numbers on the screen, for readers who know mIoU."""

TEXTS = 3
"""The number of columns of text, which are aligned left; numbers are aligned right."""

LEAST_NAME = 9
"""The least columns of a model's name, which is cut where the terminal has no room for all of it."""


def laid_out(rows: Sequence[Sequence[str]], width: int, texts: int = TEXTS) -> list[str]:
    """Return rows of cells as lines, each column as wide as its cells; names of models are cut to fit the width.

    The first `texts` columns after the name are aligned left, numbers right.
    """
    sizes = [max(map(len, column)) for column in zip(*rows, strict=True)]
    sizes[0] = min(sizes[0], max(LEAST_NAME, width - 2 - sum(sizes[1:]) - len(sizes[1:])))
    lines = []
    for name, *cells in rows:
        sized = zip(cells, sizes[1:], strict=True)
        aligned = (f"{c:<{n}}" if k < texts else f"{c:>{n}}" for k, (c, n) in enumerate(sized, 1))
        lines.append(" ".join(["", f" {cut(name, sizes[0]):<{sizes[0]}}", *aligned]).rstrip())
    return lines


def cut(name: str, size: int) -> str:
    """Return a name without its middle if it is too long: names differ at their ends."""
    if len(name) <= size:
        return name
    first = (size - 3) // 2
    return f"{name[:first]}...{name[first + 3 - size :]}"


LONG_NAME = 16
"""Length from which on names of models are printed without their common beginning."""


def common_beginning(names: Sequence[str]) -> str:
    """Return the common beginning of the names of models, up to a space, '_' or '-'; '' if it is short."""
    shared = itertools.takewhile(lambda letters: len({*letters}) == 1, zip(*names, strict=False))
    to_last_sign = re.match(r".*[ _-]", "".join(letters[0] for letters in shared))
    begin = to_last_sign[0] if to_last_sign and len(names) > 1 else ""
    return begin if len(begin) > LEAST_NAME and max(map(len, names)) > LONG_NAME and begin not in names else ""


def percents(shares: Sequence[float]) -> list[str]:
    """Return shares of one whole in percent, rounded so that they keep their sum; '-' where undefined.

    The shares that rounding down makes smaller by most are rounded up.
    """
    if any(map(math.isnan, shares)):
        return [percent(share) for share in shares]
    rounded = [math.floor(100 * share) for share in shares]
    lost = sorted(range(len(shares)), key=lambda k: rounded[k] - 100 * shares[k])
    for k in lost[: round(100 * math.fsum(shares)) - sum(rounded)]:
        rounded[k] += 1
    return [f"{n} %" for n in rounded]


def percent(share: float) -> str:
    """Return a share from 0 to 1 in whole percent; '-' where undefined."""
    return "-" if math.isnan(share) else f"{100 * share:.0f} %"


def number(value: float, digits: int) -> str:
    """Return a number with `digits` digits after its point; '-' if undefined."""
    return "-" if math.isnan(value) else f"{value:z.{digits}f}"


def legend(*, has_truth: bool) -> Iterator[str]:
    """Yield the meaning of the columns of a table of models."""
    *texts, last = (ALPHA, *COLUMNS)
    for text in (*texts, f"{last}{OVERLAP if has_truth else ''}"):
        yield from wrapped(text)
