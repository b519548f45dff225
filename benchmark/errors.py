"""The one exception root: what the command line reports in one line, with its exit code."""

LONGEST = 200
"""Characters of another library's error that are told."""


class SemstabError(Exception):
    """Something the caller can mend. The message says what is wrong, where, and what to do."""

    exit_code = 2


class ConfigError(SemstabError, ValueError):
    """A setting or an argument that cannot be used."""


class DataError(SemstabError, ValueError):
    """Data that is missing, damaged, or that contradicts itself."""


class MissingDependencyError(SemstabError, ImportError):
    """An optional package that is not installed; the message holds the command that installs it."""


def one_line(error: BaseException) -> str:
    """What another library's error says, without its line breaks and in bounds; its type where it says nothing."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."
