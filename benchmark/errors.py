"""The one exception root: what the command line reports in one line, with its exit code."""

import re

EXCEPTION_NAMES = re.compile(r"\b\w+(?:Error|Exception): ")
TERMINAL_CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")

LONGEST = 200
"""Characters of another library's error that are told."""

OUT_OF_MEMORY = (
    "the memory does not suffice; use larger voxels (voxel_size), fewer frames (frames), a larger pixel_stride, or"
    " fewer processes (--jobs)"
)

LONGEST_LINE = 400
"""Characters of a message; what a longer one has in its middle is left out."""


class SemstabError(Exception):
    """Something the caller can mend. The message, a line, says what is wrong, where, and what to do."""

    exit_code = 2

    def __init__(self, message: str = "") -> None:
        super().__init__(told(message))


class ConfigError(SemstabError, ValueError):
    """A setting or an argument that cannot be used."""


class OutgrownError(ConfigError):
    """A map that turned out larger than the memory for it."""


class DataError(SemstabError, ValueError):
    """Data that is missing, damaged, or that contradicts itself."""


class MissingDependencyError(SemstabError, ImportError):
    """An optional package that is not installed; the message holds the command that installs it."""


def told(text: str) -> str:
    """A text as a line for people: escaped where a character has no shape of its own, in bounds.

    >>> told("no scene 'a\\nb'")
    "no scene 'a\\\\nb'"
    """
    if len(text) <= LONGEST_LINE and text.isprintable():
        return text
    head = LONGEST_LINE * 2 // 3
    line = _escaped(text[:LONGEST_LINE] + text[LONGEST_LINE:][-LONGEST_LINE:])
    if len(text) <= 2 * LONGEST_LINE and len(line) <= LONGEST_LINE:
        return line
    return f"{line[:head]} ... {line[head + 5 - LONGEST_LINE :]}"


def _escaped(text: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(error: BaseException) -> str:
    """What another library's error says, in bounds, without line breaks, colours and names of exceptions."""
    text = EXCEPTION_NAMES.sub("", " ".join(TERMINAL_CODES.sub("", str(error)).split())) or "no reason is given"
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
