"""Features that views give spots of the surface, in bounded memory, and the log of them.

The spots are those of the `Sampler`, which do not depend on labels. If the vectors take more memory than their budget,
those of every second spot are dropped, by the hash of its cell.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.files import atomic_path
from semstab.core.types import Float64, Int32, Int64, Mask, UInt32
from semstab.data.events import Events
from semstab.data.features import Features
from semstab.data.frames import Frame
from semstab.errors import DataError
from semstab.statistics.cluster_sums import distinct_rows
from semstab.statistics.observations import SpotObservations

logger = logging.getLogger("semstab")

MOST_BYTES = 1 << 27
"""Most bytes of the vectors of one model, which are kept in half precision."""

CHUNK = 1 << 24
"""Most numbers of vectors that are in double precision at a time."""

UNCHANGED = 1 << 32


class FeatureStore:
    """Takes the features of spots, frame by frame.

    Args:
        most_bytes: Most bytes of the vectors.
    """

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._D = 0
        self.clear()

    def clear(self) -> None:
        """Forget all answers, but not the number of components."""
        self.share, self._count = UNCHANGED, 0
        self._spot, self._view = np.empty(0, np.int32), np.empty(0, np.int32)
        self._vectors = np.empty((0, self._D), np.float16)

    def __len__(self) -> int:
        return self._count

    @property
    def most(self) -> int:
        """Most answers that are kept."""
        return max(1, self._most_bytes // (2 * self._D))

    def start(self, frame: Frame) -> None:
        """Say how much memory features of this kind take, or that they differ from those of earlier frames.

        Raises:
            DataError: If their number of components differs.
        """
        assert frame.features is not None
        D = frame.features.D
        if not self._D:
            self._D = D
            self.clear()
            logger.info(
                "features of %d components: at most %g MB are kept, %d answers of spots",
                D, self._most_bytes / (1 << 20), self.most,
            )  # fmt: skip
        elif self._D != D:
            raise DataError(
                f"{frame.where('features')}: features have {D} components, {self._D} in the frames before; give all"
                " frames features of one network"
            )

    def add(self, features: Features, view: int, spot: Int32, cell: Int64, hashed: UInt32) -> None:
        """Add the features that a view gives spots (n,), by the cells of the grid (n,) and hashes of spots (n,).

        hashed is of all spots of the sampler.
        """
        rows = np.flatnonzero((cell >= 0) & (hashed[spot] < self.share))
        end = self._count + len(rows)
        if end > len(self._spot):
            room = max(2 * len(self._spot), end)
            self._spot, self._view = _longer(self._spot, room), _longer(self._view, room)
            self._vectors = _longer(self._vectors, min(room, self.most + len(rows)))
        if end > len(self._vectors):
            self._vectors = _longer(self._vectors, end)
        new_rows = slice(self._count, end)
        self._spot[new_rows], self._view[new_rows], self._vectors[new_rows] = (
            spot[rows],
            view,
            features.at(cell[rows]),
        )
        self._count = end
        while self._count > self.most and self.share > 1:
            self.share //= 2
            self._keep(hashed[self._spot[: self._count]] < self.share)

    def renumber(self, left: Mask, number: Int32) -> None:
        """Take over that only the spots `left` (n,) are in the sample, and their new numbers (n,)."""
        self._keep(left[self._spot[: self._count]])
        self._spot[: self._count] = number[self._spot[: self._count]]

    def _keep(self, which: Mask) -> None:
        rows = np.flatnonzero(which)
        for column in (self._spot, self._view, self._vectors):
            column[: len(rows)] = column[: self._count][rows]
        self._count = len(rows)

    @property
    def is_empty(self) -> bool:
        """Return whether no frame had features."""
        return not self._D

    def sample(self, spots: SpotObservations) -> FeatureObservations:
        """Return a copy of the answers so far, whose spots and views a sample of the same frames has."""
        n, one_in = self._count, max(1, spots.share // self.share)
        answers = self._spot[:n].copy(), self._view[:n].copy(), self._vectors[:n].copy()
        return FeatureObservations.from_answers(*answers, spots, one_in)


def _longer(array: npt.NDArray[Any], length: int) -> npt.NDArray[Any]:
    """Return an array with room for more rows."""
    longer = np.empty((length, *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer


@dataclass(frozen=True, eq=False)
class FeatureObservations:
    """Features that views give spots: a row (m,) for each spot and view, in the order of the log.

    Attributes:
        spots: The spots and views; all labels are class 0.
        vectors: (a, D) float16 of the answers of `spots`, a row each.
        one_in: The share of the spots of the sample that is kept is 1 / one_in.
    """

    spots: SpotObservations
    vectors: npt.NDArray[np.float16]
    one_in: int = 1

    @classmethod
    def from_answers(
        cls, spot: Int32, view: Int32, vectors: npt.NDArray[np.float16], spots: SpotObservations, one_in: int = 1
    ) -> FeatureObservations:
        """Build them from answers (a,) with vectors (a, D), and a sample that has their spots and views."""
        zeros, lengths = np.zeros(len(spot), np.uint16), np.zeros(len(spot), np.float32)
        answers: dict[str, Any] = dict.fromkeys(("label", "neighbour", "beyond"), zeros)
        answers |= {"spot": spot, "view": view, "near": lengths, "far": lengths}
        alone = dataclasses.replace(spots, **answers, K=1, classes=("surface",), distances=None)
        return cls(alone, vectors, one_in)

    def save(self, path: Path) -> None:
        """Write an .npz, atomically; `load` reads it with the sample of the same frames."""
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez(file, spot=self.spots.spot, view=self.spots.view, vectors=self.vectors, one_in=self.one_in)

    @classmethod
    def load(cls, path: Path, spots: SpotObservations) -> FeatureObservations:
        """Read a file that `save` wrote, of the frames of a sample."""
        with np.load(path) as content:
            answers = content["spot"], content["view"], content["vectors"]
            return cls.from_answers(*answers, spots, int(content["one_in"]))

    def __len__(self) -> int:
        """Return the number of observations: spots and views."""
        return len(self.log)

    @property
    def D(self) -> int:
        """Number of components."""
        return int(self.vectors.shape[1])

    @property
    def log(self) -> Events:
        """The log of spots, without vectors."""
        return self.spots.observations()

    @functools.cached_property
    def _order(self) -> tuple[Int64, Int64]:
        """The answers in order of observations, and (m + 1,) the first one of each observation."""
        spots, spot_ids = self.spots, np.unique(self.spots.spot)
        number = np.zeros(len(spots.point), np.int64)
        number[spot_ids] = distinct_rows(spots.places(spot_ids))[1]  # as the log numbers its voxels
        key = number[self.spots.spot] * max(len(self.spots.views), 1) + self.spots.view
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        return order, np.append(first, len(order))

    def rows(self, some: slice) -> Float64:
        """Return the vectors (n, D) of some observations: the mean over the frames of a view."""
        order, bounds = self._order
        start, stop, _ = some.indices(len(bounds) - 1)
        if stop <= start:
            return np.zeros((0, self.D))
        answer_bounds = bounds[start : stop + 1]
        answers = self.vectors[order[answer_bounds[0] : answer_bounds[-1]]].astype(np.float64)
        lengths = np.sqrt(np.einsum("ij,ij->i", answers, answers))  # half precision rounds them
        answers /= lengths[:, None]
        if len(answers) == stop - start:
            return answers
        sums: Float64 = np.add.reduceat(answers, answer_bounds[:-1] - answer_bounds[0], axis=0)
        return sums / np.diff(answer_bounds)[:, None]

    def stretches(self) -> list[slice]:
        """Return observations in stretches of whole spots, so that their vectors are in memory stretch by stretch."""
        bounds, most = self.log.bounds, max(1, CHUNK // self.D)
        cuts = [0]
        while cuts[-1] < len(self.log):
            last = int(np.searchsorted(bounds, cuts[-1] + most, side="right")) - 1
            following = int(np.searchsorted(bounds, cuts[-1], side="right"))
            cuts.append(int(bounds[max(last, following)]))
        return [slice(a, b) for a, b in itertools.pairwise(cuts)]

    def within(self, share: int) -> FeatureObservations:
        """Return the answers for the spots of a smaller share of the coarse cells."""
        in_share = self.spots.drawn[self.spots.spot] < share
        return dataclasses.replace(self, spots=self.spots.within(share), vectors=self.vectors[in_share])

    def only(self, answers: Mask) -> FeatureObservations:
        """Return some of the answers (a,)."""
        return dataclasses.replace(self, spots=self.spots.only(answers), vectors=self.vectors[answers])
