"""The root of all exceptions, which the command line reports in one line, with its exit code."""

import re
from collections.abc import Sequence

EXCEPTION_NAMES = re.compile(r"\b\w+(?:Error|Exception): ")
TERMINAL_CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")

LONGEST, LONGEST_LINE = 200, 400
"""Characters of another library's error, and of a message; the middle of a longer message is left out."""

OUT_OF_MEMORY = (
    "the memory does not suffice; use larger voxels (voxel_size), fewer frames (frames), a larger pixel_stride, or"
    " fewer processes (--jobs)"
)


class SemstabError(Exception):
    """An error that the caller can mend. The message, a line, names the fault, its source and the remedy.

    Examples:
        >>> try:
        ...     semstab.load("nowhere")
        ... except semstab.SemstabError as error:
        ...     print(error)
        nowhere: there is no such folder; give the folder of a finished run
    """

    exit_code = 2

    def __init__(self, message: str = "") -> None:
        super().__init__(sanitize(message))


class ConfigError(SemstabError, ValueError):
    """A setting or an argument that cannot be used.

    Examples:
        >>> try:
        ...     semstab.load_config({"voxel_size": -1})
        ... except semstab.ConfigError as error:
        ...     print(error)
        configuration: voxel_size: input should be greater than or equal to 0.000000001 (got -1)
    """


class OutgrownError(ConfigError):
    """A map that turned out larger than the memory for it."""


class DataError(SemstabError, ValueError):
    """Data that is missing, damaged, or that contradicts itself.

    Examples:
        >>> try:
        ...     semstab.fuse([])
        ... except semstab.DataError as error:
        ...     print(error)
        there are no frames to fuse; give posed label maps: labels, depth, intrinsics, T_wc
    """


class MissingDependencyError(SemstabError, ImportError):
    """An optional package that is not installed; the message holds the command that installs it.

    Examples:
        >>> try:
        ...     table = semstab.load("run").summary
        ... except semstab.MissingDependencyError as error:
        ...     print(error)  # data frames need pandas; pip install 'semstab[pandas]', ...
        ... else:
        ...     print(len(table))
        2
    """


def nearest(name: str, names: Sequence[str]) -> str:
    """Return a hint at the name that may be meant by one that is not known."""
    import difflib

    near = difflib.get_close_matches(name, names, n=1)
    return f"did you mean '{near[0]}'?" if near else f"known: {', '.join(names) or 'none'}"


def printable(text: str, keep: str = "") -> str:
    r"""Return a text for people, with codes for characters that have no shape of their own, but for those to keep.

    These are what steers a terminal (ESC, carriage return), turns the direction of writing, or cannot be seen.

    >>> printable("a\x1b[31mb\u202ec")
    'a\\x1b[31mb\\u202ec'
    """
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode() for c in text)


def sanitize(text: str) -> str:
    r"""Return a text as a line for people: escaped where a character has no shape of its own, in bounds.

    >>> sanitize("no scene 'a\nb'")
    "no scene 'a\\nb'"
    """
    head = LONGEST_LINE * 2 // 3
    ends = text[:LONGEST_LINE] + text[LONGEST_LINE:][-LONGEST_LINE:]
    line = printable(ends)
    is_short = len(text) <= 2 * LONGEST_LINE and len(line) <= LONGEST_LINE
    return line if is_short else f"{line[:head]} ... {line[head + 5 - LONGEST_LINE :]}"


def summarize_error(error: BaseException) -> str:
    """Return the message of another library's error, in bounds, without line breaks, colours, names of exceptions."""
    text = EXCEPTION_NAMES.sub("", " ".join(TERMINAL_CODES.sub("", str(error)).split())) or "no reason is given"
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
