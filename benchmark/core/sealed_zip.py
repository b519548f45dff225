"""Zip archives that have the digests of their members, so that a changed one is found.

The member `sha256` has the lines of the program sha256sum: `unzip FILE && sha256sum -c sha256` checks it by hand.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Mapping

from semstab.errors import DataError

DIGESTS = "sha256"
"""The member with the digests of all others."""


def packed(members: Mapping[str, bytes]) -> bytes:
    """Return an archive of members by name, byte for byte the same for the same content."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (*members.items(), (DIGESTS, _digests(members))):
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return data.getvalue()


def unpacked(archive: zipfile.ZipFile) -> dict[str, bytes]:
    """Return the members of an archive that `packed` made. Raises DataError if they have other digests."""
    members = {name: archive.read(name) for name in archive.namelist()}
    stated = members.pop(DIGESTS, b"")
    if stated != _digests(members):
        raise DataError("it has changed since it was written; write it again")
    return members


def _digests(members: Mapping[str, bytes]) -> bytes:
    """Return the lines that sha256sum prints for the members."""
    return "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in members.items()).encode()
