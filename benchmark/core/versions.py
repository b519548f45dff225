"""The version of semstab, which setup.cfg takes from here, and of the packages that it uses."""

from __future__ import annotations

VERSION = "1.0.0"


def version_of(package: str) -> str | None:
    """Return the version of semstab, or of an installed distribution; None if it is not installed.

    >>> version_of("semstab") == VERSION, version_of("no-such-package")
    (True, None)
    """
    from importlib import metadata

    if package == "semstab":
        return VERSION
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
