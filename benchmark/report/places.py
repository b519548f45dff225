"""Describe the worst places of a map for the page: where they are, the frames that see them, and small pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.data.records import Record
from semstab.data.voxels import VoxelTable
from semstab.engine.series import read_names
from semstab.report.figures.located import Located, metres
from semstab.report.figures.maps import Overview, PlacePictures, scale_length, scale_text
from semstab.report.figures.topdown import FromAbove
from semstab.report.html import jpeg, label_picture
from semstab.statistics.places import Place, places_of

LISTED, NAMED = 10, 12
"""The most places that the page lists, and the most frames of a place that it names."""


END = 0.04
"""The share of an edge next to a corner of the map without ticks, whose text would stand out of the page."""


@dataclass(frozen=True, eq=False)
class ShownMap:
    """A map as the page shows it.

    Attributes:
        above: Its voxels that are seen from above.
        places: Its worst places.
    """

    above: FromAbove
    places: Sequence[Place]

    @classmethod
    def from_record(cls, record: Record, table: VoxelTable) -> ShownMap:
        """Find both in the voxels of a unit, which are in memory; up must be known."""
        return cls(FromAbove.from_table(table, np.asarray(record.up)), places_of(record, LISTED, table))


def frame_names(record: Record) -> dict[int, str]:
    """Return the names of a unit's frames by their index, as its time series has them; no names without a file."""
    return {} if record.series is None or not record.series.exists() else read_names(record.series)


def map_frame(located: Located) -> dict[str, Any]:
    """Return what the page draws around a map: ticks in percent of its edges, the scale bar, north, the system."""
    lower, left = located.edges
    length = scale_length(located.size[0])
    axes = " and ".join(edge.name for edge in (lower, left) if edge.name)
    return {
        "lower": [(100 * share, metres(value)) for share, value in lower.ticks if END <= share <= 1 - END],
        "left": [(100 * (1 - share), metres(value)) for share, value in left.ticks if END <= share <= 1 - END],
        "axes": f"{axes}, metres: {located.system}" if axes else "",
        "bar": (100 * length / located.size[0], scale_text(length)),
        "north": located.north,
    }


def described_places(
    places: Sequence[Place], record: Record, located: Located, overview: Overview | None, classes: Sequence[str]
) -> list[dict[str, Any]]:
    """Return what the page says of the worst places: where each is in the picture and in the coordinates of exports."""
    names, pictures = frame_names(record), None if overview is None else overview.places
    palette = None if overview is None else overview.palette
    return [
        {
            "number": place.number,
            "at": [100 * share for share in located.share(place.centre)],
            "title": _title(place, classes),
            "where": _where(place, located),
            "text": f"{place.voxels:,} voxels, {place.size:.2g} m from end to end; {100 * place.agreement:.0f} % of the"
            f" pairs of frames agree; {100 * place.share:.1f} % of the map's disagreement",
            "frames": _frames(place, names, classes),
            "pictures": [] if pictures is None else list(_pictures(place, pictures, palette, names, classes)),
        }
        for place in places
    ]


def _title(place: Place, classes: Sequence[str]) -> str:
    return f"{classes[place.label]}, confused with {classes[place.other]}"


def _where(place: Place, located: Located) -> str:
    point = located.coordinates(place.centre)
    return ", ".join(f"{name} {metres(round(value, 2))}" for name, value in zip(located.names, point, strict=True))


def _frames(place: Place, names: Mapping[int, str], classes: Sequence[str]) -> str:
    """Return the frames that see a place, by the class that they give it."""
    frames_by_class: dict[str, list[str]] = {}
    for view in place.views[:NAMED]:
        label = "no class" if view.label < 0 else classes[view.label]
        frames_by_class.setdefault(label, []).append(names.get(view.frame, str(view.frame)))
    more = f"; and {len(place.views) - NAMED} more frames" if len(place.views) > NAMED else ""
    return "; ".join(f"{label}: {', '.join(frames)}" for label, frames in frames_by_class.items()) + more


def _pictures(
    place: Place, pictures: PlacePictures, palette: Any, names: Mapping[int, str], classes: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """Yield the pictures of a place, where those that were kept are of it."""
    labels = {view.frame: view.label for view in place.views}
    for k in np.flatnonzero(pictures.of == place.number):
        if not np.allclose(pictures.centre[k], place.centre):
            continue
        frame, (x, y, radius) = int(pictures.frame[k]), pictures.ring[k].tolist()
        label = labels.get(frame, -1)
        images = [] if pictures.color is None else [("image", jpeg(pictures.color[k]))]
        yield {
            "title": f"{names.get(frame, frame)}: {'no class' if label < 0 else classes[label]}",
            "shown": [*images, ("labels", label_picture(pictures.labels[k], palette))],
            "ring": [100 * x, 100 * y, 200 * radius],
        }
