"""A sequential backbone inside a run: whichever frame is asked for, it has seen the sequence up to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from semstab.backbones import Backbone, Prediction, ask
from semstab.errors import ConfigError
from semstab.predict.images import ImageSequence, geometry_of

KEPT_BYTES = 1 << 28
"""Memory for the latest predictions: frames are asked for nearly, not quite in order."""

LEAST_KEPT = 4


class InOrder:
    """What a sequential backbone says of each frame of a sequence, shown to it in order, whatever is asked for when.

    indices  the frames that it is shown
    claim    is told whose the backbone is now, and says whether it was somebody else's: then it begins again
    Where a prediction is no longer at hand, the backbone is shown the sequence from its first frame again.
    """

    def __init__(
        self,
        backbone: Backbone,
        sequence: ImageSequence,
        indices: Sequence[int],
        scores: bool,
        claim: Callable[[InOrder], bool],
    ) -> None:
        self.indices = indices
        self._backbone, self._sequence, self._scores, self._claim = backbone, sequence, scores, claim
        self._place = {index: place for place, index in enumerate(indices)}
        self._next = 0
        self._kept: dict[int, Prediction] = {}

    def at(self, index: int) -> Prediction:
        """Raises ConfigError for a frame that the backbone is not shown."""
        place = self._placed(index)
        if index not in self._kept:
            if self._claim(self) or place < self._next:
                self._backbone.reset()
                self._next = 0
            for shown in self.indices[self._next : place + 1]:
                self._show(shown)
        return self._kept[index]

    def shown_for(self, indices: Sequence[int]) -> list[int]:
        """The frames that the backbone is shown for the sake of these: its labels depend on all of them.

        Raises ConfigError for a frame that is not among them.
        """
        return list(self.indices[: max(map(self._placed, indices), default=-1) + 1])

    def _placed(self, index: int) -> int:
        if index not in self._place:
            raise ConfigError(
                f"{self._sequence.name}: frame {index} is not among the {len(self.indices)} frames that a sequential"
                " backbone is shown; its labels depend on these, so a sweep can only leave some of them out"
            )
        return self._place[index]

    def _show(self, index: int) -> None:
        image = self._sequence.image(index)
        geometry = geometry_of(self._sequence, index, image, self._backbone)
        (prediction,) = ask(self._backbone, [image], scores=self._scores, geometry=geometry)
        self._kept[index] = prediction
        self._next += 1
        while len(self._kept) > LEAST_KEPT and sum(map(size_of, self._kept.values())) > KEPT_BYTES:
            del self._kept[next(iter(self._kept))]


def size_of(prediction: Prediction) -> int:
    """Bytes that a prediction keeps in memory."""
    return prediction.labels.nbytes + (0 if prediction.scores is None else prediction.scores.nbytes)
