"""Write a model's label maps of a scene in the background, ahead of the run that reads them."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

from semstab.data.frames import Frame
from semstab.datasets.formats.images import read_features, read_labels, read_scores
from semstab.errors import ConfigError
from semstab.models import Image, Model, Prediction
from semstab.models.validation import Wrapped
from semstab.predict.images import ImageSequence, Picture, shown_digest
from semstab.predict.sequence import PredictionObserver, SequenceOptions, predict_sequence


class Producer(PredictionObserver):
    """A model's predictions of one sequence, in a folder; predictions of an earlier start are reused.

    One thread predicts for all threads that ask. A sequential model sees its `frames` in order, whichever frame is
    requested.

    Args:
        sequence: Images.
        model: Model, fitted to the sequence.
        folder: Folder above labels/ and scores/.
        name: Name of the maps: labels/NAME, scores/NAME.
        scores: Whether scores are written, too.
        frames: Frames that a sequential model is shown; None for a model that sees each image by itself.
        before: Producer of the maps that the model filters, if any.
    """

    def __init__(
        self,
        sequence: ImageSequence,
        model: Model,
        folder: Path,
        name: str,
        *,
        scores: bool = False,
        frames: Sequence[int] | None = None,
        before: Producer | None = None,
    ) -> None:
        self.sequence, self.model = sequence, model
        self._folder, self._name, self._frames, self._before = folder, name, frames, before
        self._options = SequenceOptions(
            name, scores, score_type=None, overwrite=True, at_image=True, fit=False, wait=True
        )
        self._done = dict[int, float]()  # seconds of the model; NaN for maps of an earlier start
        self._digests = dict[str, int]()
        self._coming = frozenset[int]()
        self._error: BaseException | None = None
        self._stopped = False
        self._changed, self._turn = threading.Condition(), threading.Lock()

    @contextlib.contextmanager
    def ahead(self, indices: Sequence[int]) -> Iterator[None]:
        """Predict these frames in the background while the block lasts; the rest is left at its end."""
        self._coming, self._error = frozenset(self.shown_for(indices)), None
        thread = threading.Thread(target=self._run, args=(indices,), name=f"semstab-{self._name}", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stopped = True
            thread.join()
            self._stopped = False

    def wait(self, index: int) -> None:
        """Return once the maps of the frame are there; one that nobody announced is predicted now.

        Raises what the model raised.
        """
        with self._changed:
            self._changed.wait_for(lambda: index in self._done or index not in self._coming)
        if index not in self._done and self._error is not None:
            raise self._error
        if index not in self._done:
            self._produce(self.shown_for([index]))

    def read(self, index: int, *, scores: bool = False) -> Prediction:
        """Return the prediction of a frame at the pixels of its image, once it is there.

        Raises what the model raised, and DataError for a damaged map.
        """
        self.wait(index)
        name = f"{self._name}/{self.sequence.image_name(index)}"
        labels, soft, features = read_labels(self._folder / f"labels/{name}.png"), None, None
        shape = (labels.shape[0], labels.shape[1])
        if self.model.gives_features:
            features = read_features(self._folder / f"features/{name}.npy", shape).vectors
        if scores:
            soft = read_scores(self._folder / f"scores/{name}.npz", "KHW", shape)
        return Prediction(labels, soft, features)

    def index_of(self, digest: str) -> int | None:
        """Wait for the frame whose image has this digest, and return it, or None if no announced image has it."""
        with self._changed:
            self._changed.wait_for(lambda: digest in self._digests or not self._coming)
        return self._digests.get(digest)

    def seconds(self, index: int) -> float:
        """Return the seconds that the model took for a frame, at the first call; NaN later, and if maps were reused."""
        seconds = self._done.get(index, math.nan)
        if index in self._done:
            self._done[index] = math.nan
        return seconds

    def shown_for(self, indices: Sequence[int]) -> list[int]:
        """Return the frames that the model is shown for the sake of these: a sequential one all up to the last.

        Raises:
            ConfigError: For a frame that a sequential model is not shown.
        """
        if self._frames is None:
            return [*indices]
        for index in indices:
            if index not in self._frames:
                raise ConfigError(
                    f"{self.sequence.name}: frame {index} is not among the {len(self._frames)} frames that a sequential"
                    " model is shown; its labels depend on these, so a sweep can only leave some of them out"
                )
        last = max(map(self._frames.index, indices), default=-1)
        return [*self._frames[: last + 1]]

    def frame_done(self, picture: Picture, seconds: float) -> None:
        """Let those who wait for the frame read it."""
        with self._changed:
            self._done[picture.index] = seconds
            self._digests[picture.digest] = picture.index
            self._changed.notify_all()
        if self._stopped:
            raise _StoppedError

    def _run(self, indices: Sequence[int]) -> None:
        """Predict frames in the thread of `ahead`; `wait` raises what goes wrong."""
        try:
            self._produce(indices)
        except _StoppedError:
            pass
        except BaseException as error:  # noqa: BLE001 - raised again by `wait`, in the threads that read
            self._error = error
        finally:
            with self._changed:
                self._coming = frozenset()
                self._changed.notify_all()

    def _produce(self, indices: Sequence[int]) -> None:
        with self._turn:
            missing = [index for index in indices if index not in self._done]
            if not missing:
                return
            predicted_frames = missing if self._frames is None else self._frames
            try:
                with contextlib.nullcontext() if self._before is None else self._before.ahead(predicted_frames):
                    predict_sequence(self.sequence, self.model, predicted_frames, self._folder, self._options, [self])
            finally:
                if self.model.sequential:
                    self.model.reset()  # its memory of the sequence can be large


class _StoppedError(Exception):
    """Nobody wants the rest."""


class Written(Wrapped):
    """A model whose predictions a producer has written: several filters over it share them."""

    def __init__(self, producer: Producer) -> None:
        super().__init__(producer.model)
        self._producer = producer

    def fit(self, images: Sequence[Image]) -> Self:
        """Return the model itself, which is fitted."""
        return self

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Model`."""
        frames = [[frame] for frame in geometry] or [[]] * len(images)
        return [self._one(image, scores, frame) for image, frame in zip(images, frames, strict=True)]

    def _one(self, image: Image, scores: bool, frame: Sequence[Frame]) -> Prediction:
        index = self._producer.index_of(shown_digest(image, frame))
        if index is None:
            return self.ask([image], scores, frame)[0]
        return self._producer.read(index, scores=scores)
