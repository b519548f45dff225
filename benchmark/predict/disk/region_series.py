"""How much regions without classes change from frame to frame: the series of a sequence."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from semstab.datasets.formats.images import read_labels
from semstab.metrics import RegionChange, macro_mean, matched_region_flicker
from semstab.pixels.warp import warp
from semstab.predict.images import ImageSequence
from semstab.runtime.files import csv_text, write_text

COLUMNS = ("previous", "frame", *(field.name for field in fields(RegionChange)))


@dataclass(frozen=True)
class RegionSeries:
    """One change a pair of successive frames: at the same pixel coordinates, and with camera motion taken out.

    frames       names, one more than there are changes
    plain        previous and current map as they are
    compensated  the previous map warped by depth and pose; empty where these are not known
    """

    frames: tuple[str, ...]
    plain: tuple[RegionChange, ...]
    compensated: tuple[RegionChange, ...]

    @property
    def flicker_percent(self) -> float:
        """Mean over the pairs; NaN where there are none."""
        return macro_mean([change.flicker_percent for change in self.plain])

    @property
    def compensated_flicker_percent(self) -> float:
        """The same with camera motion taken out; NaN where it is not known."""
        return macro_mean([change.flicker_percent for change in self.compensated])

    def write(self, path: Path) -> None:
        """One row a pair and kind, as CSV; an undefined number is an empty field."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(("kind", *COLUMNS))
        for kind, changes in (("plain", self.plain), ("compensated", self.compensated)):
            for (before, now), change in zip(itertools.pairwise(self.frames), changes, strict=False):
                cells = ["" if value != value else value for value in asdict(change).values()]  # noqa: PLR0124  NaN
                writer.writerow((kind, csv_text(before), csv_text(now), *cells))
        write_text(path, text.getvalue())


def region_series(sequence: ImageSequence, indices: Sequence[int], file: Callable[[str], Path]) -> RegionSeries:
    """Compare the region maps of successive frames, which `file` finds by a frame's name."""
    names = tuple(sequence.image_name(index) for index in indices)
    plain, compensated = [], []
    for (a, b), (before, now) in zip(itertools.pairwise(indices), itertools.pairwise(names), strict=True):
        previous, current = read_labels(file(before)), read_labels(file(now))
        if previous.shape != current.shape:
            continue
        plain.append(matched_region_flicker(previous, current))
        source, target = sequence.predicted(a, labels=previous), sequence.predicted(b, labels=current)
        if source is not None and target is not None:
            brought, visible = warp(source.predicted, source, target)
            compensated.append(matched_region_flicker(brought, target.predicted, visible))
    return RegionSeries(names, tuple(plain), tuple(compensated))
