"""A model that a user brings as a class or a function: an image in, labels or scores out."""

from __future__ import annotations

import reprlib
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from semstab.core.code import Code, guarded
from semstab.data.features import OF_FEATURES
from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.errors import ConfigError, DataError
from semstab.models import Image, Labels, Model, Prediction, content_digest, narrowed
from semstab.models.names import class_names
from semstab.models.validation import Wrapped


class OwnOptions(BaseModel):
    """The options that the code is called with, and the names of its classes."""

    model_config = ConfigDict(extra="allow", frozen=True)

    classes: list[str] | str | None = Field(
        None, description="names in the order of ids; or a file: a name a line, or a taxonomy's YAML; the code's own"
    )
    threads: int | None = Field(None, ge=1, description="of torch on a CPU; of the code, if it has such an option")

    @property
    def of_labels(self) -> dict[str, Any]:
        """The options of the code that may change its labels."""
        return dict(self.model_extra or {})

    def of_speed(self, code: Code) -> dict[str, Any]:
        """Return those that change no label."""
        return {"threads": self.threads} if self.threads is not None and code.has("threads") else {}

    def limit_torch(self, code: Code) -> None:
        """Give torch its threads, where the code has loaded it and does not do so itself."""
        if self.threads is not None and not code.has("threads") and "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(self.threads)


def own_maker(text: str) -> tuple[type[BaseModel], Callable[[Any], Model]]:
    """Return the options of a user's class or function, and a function that makes a model of it with them.

    Both raise ConfigError, DataError, MissingDependencyError, each in one line.
    """
    code = Code.load(text, "model")
    cls: Any = code.target
    if not (isinstance(cls, type) and Model in cls.__mro__):
        return OwnOptions, lambda options: OwnModel(code, options)
    options_class = getattr(cls, "Options", None)
    if isinstance(options_class, type) and issubclass(options_class, BaseModel):
        return options_class, lambda options: OfCode(guarded(text, lambda: cls(options)), code, {})

    def make(options: OwnOptions) -> Model:
        arguments = options.of_labels | options.of_speed(code)
        code.accepts(arguments)
        model = OfCode(guarded(text, lambda: cls(**arguments)), code, options.of_labels)
        options.limit_torch(code)
        return model

    return OwnOptions, make


class OfCode(Wrapped):
    """A model of a user's own class: its file is part of the key under which its predictions are stored."""

    def __init__(self, inner: Model, code: Code, options: Mapping[str, Any]) -> None:
        super().__init__(inner)
        self._about = {"code": code.digest, "options": contents(options)}

    def identity(self) -> dict[str, Any]:
        """Return its own, its file and its options."""
        return {**self.inner.identity(), **self._about}


class OwnModel(Model):
    """A function of an image (H, W, 3) uint8 RGB, or an object with such a method `predict`, or that is called so.

    It gives labels (H, W), whole numbers in the order of its classes, 255 (65535 with more than 255 classes) or less
    than 0 for pixels without a prediction; or scores (H, W, K) that sum to 1. A tensor is as good as an array. It may
    say `classes`, `gives_scores`, `sequential` (then it has `reset`) and `wants_geometry` (then it is called with image
    and frame). With `gives_features = True` it gives a mapping with `features` (h, w, D), float, and labels or scores;
    without classes it gives features alone, as a mapping or an array.
    """

    def __init__(self, code: Code, given: OwnOptions) -> None:
        self._code, self._options = code, given.of_labels
        options = self._options | given.of_speed(code)
        made: Any = code.target
        if isinstance(code.target, type):
            code.accepts(options)
            made = guarded(code.text, lambda: code.target(**options))
            self._call: Callable[..., Any] = getattr(made, "predict", made)
        else:
            self._call = partial(code.target, **options)
        if not callable(self._call):
            raise ConfigError(f"{code.text}: has no method predict(image), and cannot be called with an image")
        self._made = made
        stated = getattr(made, "gives_features", getattr(code.module, "gives_features", False))
        self.gives_features = bool(stated)
        self.label_space = _label_space(code, made, given.classes, alone=self.gives_features)
        self.gives_scores = bool(getattr(made, "gives_scores", True))
        self.sequential = bool(getattr(made, "sequential", False))
        self.wants_geometry = bool(getattr(made, "wants_geometry", False))
        if self.sequential and not hasattr(made, "reset"):
            raise ConfigError(f"{code.text}: a sequential model needs a method reset(), called before each sequence")
        if not isinstance(code.target, type):
            code.accepts(options, *([None] * (1 + self.wants_geometry)))
        given.limit_torch(code)

    def reset(self) -> None:
        """Forget all images."""
        guarded(self._code.text, self._made.reset)

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Model`.

        Raises:
            DataError: For an answer that is neither labels nor scores.
        """
        inputs = zip(images, geometry, strict=True) if self.wants_geometry else zip(images, strict=True)
        return [self._predict(image, frame, scores) for image, *frame in inputs]

    def identity(self) -> dict[str, Any]:
        """Return its file, its options, its classes."""
        assert self.label_space is not None
        about = {"code": self._code.digest, "name": self._code.name, "options": contents(self._options)}
        return {**about, "classes": list(self.label_space.classes)}

    def _predict(self, image: Image, frame: Sequence[Any], scores: bool) -> Prediction:
        image = image if image.flags.writeable else image.copy()  # torch warns of arrays that cannot be written to
        answer = guarded(self._code.text, lambda: self._call(image, *frame))
        features, shape, K = None, image.shape[:2], len(self.label_space or ())
        if self.gives_features:
            answer, features = self._split(answer, shape)
        output = guarded(self._code.text, lambda: _array(answer))
        if output.shape == shape and output.dtype.kind in "iu":
            if scores:
                raise DataError(
                    f"{self._code.text}: gives labels, no scores; leave scores out, or let it give (H, W, K)"
                )
            return Prediction(_ids(output, K, self._code.text), None, features)
        if output.shape == (*shape, K) and output.dtype.kind == "f":
            soft = output if output.dtype == np.float16 else output.astype(np.float32, copy=False)
            return Prediction(_ids(soft.argmax(axis=2), K, self._code.text), soft if scores else None, features)
        raise DataError(
            f"{self._code.text}: gave {output.dtype} of shape {output.shape} for an image of {shape}; give labels"
            f" {shape} of whole numbers, or scores {(*shape, K)}"
        )

    def _split(self, answer: Any, shape: tuple[int, ...]) -> tuple[Any, npt.NDArray[Any]]:
        """Return labels or scores, and the features of an answer; all labels are 0 if it has features alone."""
        alone = self.label_space == OF_FEATURES
        answers = answer if isinstance(answer, Mapping) else {"features": answer} if alone else {}
        features = answers.get("features")
        labels = answers.get("scores", answers.get("labels"))
        if features is None or (labels is None) != alone:
            expected = "features" if alone else "features and labels, or features and scores"
            raise DataError(
                f"{self._code.text}: gave {reprlib.repr(sorted(answers)) if answers else type(answer).__name__}; with"
                f" gives_features = True let it give a dict with {expected}"
            )
        return np.zeros(shape, np.uint8) if alone else labels, _array(features)


def contents(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options by their value; a file or a folder by its content."""
    return {
        key: content_digest(Path(value).expanduser()) if is_path(value) else value for key, value in options.items()
    }


def is_path(value: Any) -> bool:
    """Return whether an option names a file or a folder that is there."""
    return isinstance(value, str) and bool(Path(value).suffix or "/" in value) and Path(value).expanduser().exists()


def _array(output: Any) -> npt.NDArray[Any]:
    """Return the output of a model as an array; tensors are copied from their device."""
    return np.asarray(output.detach().cpu().numpy() if hasattr(output, "detach") else output)


def _ids(labels: npt.NDArray[Any], classes: int, who: str) -> Labels:
    """Return labels as the narrowest type.

    Raises:
        DataError: For one that is no class and not ignored.
    """
    ignore = IGNORE_8BIT if classes <= IGNORE_8BIT else IGNORE_16BIT
    wrong = (labels >= classes) & (labels != ignore)
    if wrong.any():
        raise DataError(f"{who}: gave the label {labels[wrong][0]}, but has {classes} classes, 0 to {classes - 1}")
    return narrowed(np.where(labels < 0, ignore, labels), classes)


def _label_space(code: Code, made: Any, classes: Sequence[str] | str | None, *, alone: bool = False) -> LabelSpace:
    """Return the stated classes; without them, the label space `OF_FEATURES` of a model of features `alone`."""
    names = class_names(classes) if classes is not None else None
    for owner in (made, code.module):
        for attribute in ("label_space", "classes", "names", "CLASSES"):
            names = getattr(owner, attribute, None) if names is None else names
    if isinstance(names, LabelSpace):
        return names
    if isinstance(names, Mapping):  # from ids, as Ultralytics has it
        names = [names[k] for k in sorted(names)]
    if names is None and alone:
        return OF_FEATURES
    if names is None or isinstance(names, str) or not all(isinstance(name, str) for name in names):
        hint = "give it classes = [...], or name them with --classes a,b,c"
        raise ConfigError(f"{code.text}: its classes are not known; {hint}")
    return LabelSpace(code.name, tuple(names))
