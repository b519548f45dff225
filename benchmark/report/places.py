"""Name the frames that see the worst places of a map."""

from __future__ import annotations

import csv

from semstab.data.digests import require_unchanged
from semstab.data.records import Record


def frame_names(record: Record) -> dict[int, str]:
    """Return the names of a unit's frames by their index, as its time series has them; none where it has no file."""
    file = record.series
    if file is None or not file.exists():
        return {}
    require_unchanged(file)
    with file.open(newline="", encoding="utf-8") as rows:
        return {int(row["frame"]): row.get("name") or row["frame"] for row in csv.DictReader(rows)}
