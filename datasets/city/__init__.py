"""The built-in dataset `city`: a simulated UAV flight over a procedural town, with simulated models.

Five towns (scene0 to scene4) with roads, buildings, trees, cars and people, every face of a uavid8 class. Depth is
exact. Read on in this order: `flight` (where the camera flies), `town` (streets and blocks) with `ground`, `things`,
`traffic` and `mesh`, `rendering` (what the camera sees), `options` and `simulation` (how models err), `labellers`.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Mapping
from functools import cached_property, lru_cache

import numpy as np
from pydantic import BaseModel

from semstab.config import nearest
from semstab.core.types import Float64, UInt8
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import LabelSpace
from semstab.datasets.city.flight import FLIGHTS, Flight
from semstab.datasets.city.labellers import relabelled
from semstab.datasets.city.mesh import uavid8
from semstab.datasets.city.options import CityOptions, SimulatedModel
from semstab.datasets.city.rendering import LIGHTS, CityCaster, Rendered, render
from semstab.datasets.city.simulation import CityView, Simulation
from semstab.datasets.city.town import Town, build_town
from semstab.datasets.scene import GROUND_TRUTH, Dataset, Scene, fingerprint
from semstab.errors import ConfigError, DataError

__all__ = ["GENERATOR_VERSION", "City", "CityOptions", "CityScene", "SimulatedModel"]

GENERATOR_VERSION = 2
"""Part of every digest: raise it with any change of the towns, the flights, the rendering or the error model."""


FIELD_OF_VIEW = 60.0
"""Horizontal field of view of the camera, degrees."""


USUAL_LIGHT = "noon"
"""The light of which digests say nothing."""


@lru_cache(maxsize=2)
def _still_part(seed: int, flight: Flight) -> CityCaster:
    """Return what stands still in a town, which takes long to build; the same for every camera."""
    return CityCaster(build_town(seed, flight).still)


class City(Dataset):
    """The dataset. It keeps the scene that was opened last, so that its models share rendered frames."""

    Options: type[BaseModel] = CityOptions

    def __init__(self, options: CityOptions) -> None:
        self.options = options
        self._last: CityScene | None = None

    @property
    def scenes(self) -> tuple[str, ...]:
        """scene0 to scene4."""
        return tuple(FLIGHTS)

    def scene(self, name: str) -> CityScene:
        """Open a scene; its town is built when the first frame is asked for.

        Raises:
            DataError: For an unknown name.
        """
        if name not in FLIGHTS:
            raise DataError(f"city: scene '{name}' is not known; {nearest(name, self.scenes)}")
        if self._last is None or self._last.name != name:
            self._last = CityScene(name, self.options)
        return self._last


class CityScene(Scene):
    """One flight over one town; see `semstab.datasets.Scene`."""

    ground_truth = True
    made = True

    def __init__(self, name: str, options: CityOptions) -> None:
        self.name = name
        self.models = tuple(name for name, model in options.models.items() if not model.labeller)
        self.further = tuple(name for name in options.models if name not in self.models)
        self.up = np.array([0.0, 0.0, 1.0])
        self._options = options
        self._flight = FLIGHTS[name]
        self.origin = np.array(options.origin, dtype=np.float64)
        self.rendered: dict[int, Rendered] = {}
        """The rendered frames by index; those that fit into memory."""
        self._lock = threading.Lock()
        self._of_frame: dict[int, threading.Lock] = {}

    def __len__(self) -> int:
        return self._options.frames

    @cached_property
    def timestamps(self) -> Float64:
        """(len,) seconds since the flight began."""
        return np.array([self._share(index) * self._flight.seconds for index in range(len(self))])

    @property
    def camera(self) -> Intrinsics:
        """The camera of every frame: square pixels, the optical axis in the middle of the image."""
        W, H = self._options.width, self._options.height
        f = W / (2 * np.tan(np.deg2rad(FIELD_OF_VIEW) / 2))
        return Intrinsics(f, f, (W - 1) / 2, (H - 1) / 2)

    def label_space(self, model: str) -> LabelSpace:
        """Return uavid8, for every model.

        Raises:
            ConfigError: For an unknown one.
        """
        self._simulated(model)
        return uavid8()

    def frame(self, index: int, model: str, *, color: bool = True) -> Frame:
        """Render frame 0 <= index < len with a model's labels or scores; colour comes with it.

        Raises:
            DataError: For a frame.
            ConfigError: For a model that does not exist.
        """
        simulated = self._simulated(model)
        T = self._pose(index)
        T_wc = T.copy()
        T_wc[:3, 3] += self.origin
        rendered = self._render(index, T)
        labels: UInt8 | None = rendered.classes
        scores = None
        if simulated is not None:
            view = CityView(index, rendered, self.camera, T)
            simulation = Simulation(simulated, self._options.seed, model, self.name)
            labels = None if simulated.softness else relabelled(simulation, view)
            scores = simulation.scores(view) if simulated.softness else None
        where = f"city/{self.name}/frame {index}"
        files = {what: f"{where}, {what}" for what in ("depth", "pose", "labels", "scores", "color")}
        return Frame(
            index=index, depth=rendered.depth, intrinsics=self.camera, T_wc=T_wc, labels=labels, scores=scores,
            color=rendered.color, timestamp=float(self.timestamps[index]), files=files,
        )  # fmt: skip

    def digest(self, indices: list[int], model: str) -> str:
        """Return a hash of all settings that the frames depend on; nothing is rendered."""
        simulated = self._simulated(model)
        errors = None if simulated is None else simulated.model_dump(mode="json")
        light = [] if self._options.light == USUAL_LIGHT else [self._options.light]
        content = self._drawn([int(index) for index in indices], model, errors, *light)
        return hashlib.sha256(content).hexdigest()

    def fingerprints(self, index: int) -> Mapping[str, str]:
        """Return a short hash of all settings that the frame's geometry depends on; nothing is rendered."""
        return {f"frame {index}": fingerprint(self._drawn(index))}

    def _drawn(self, *more: object) -> bytes:
        """Return all that the scene's geometry depends on, and more, as bytes to hash."""
        options = self._options.model_dump(mode="json", exclude={"models", "cache_megabytes", "light"})
        return json.dumps([GENERATOR_VERSION, options, self.name, *more], sort_keys=True).encode()

    @cached_property
    def town(self) -> Town:
        """The town and its traffic, built when first asked for."""
        return build_town(self._options.seed, self._flight)

    @cached_property
    def still(self) -> CityCaster:
        """The still part of the town, at which rays are cast."""
        return _still_part(self._options.seed, self._flight)

    def _share(self, index: int) -> float:
        """Return the share of the flight that is over at a frame."""
        return index / max(1, len(self) - 1)

    def _pose(self, index: int) -> Float64:
        if not 0 <= index < len(self):
            raise DataError(f"city/{self.name}: there is no frame {index}; the scene has {len(self)} frames, from 0")
        land = self._built().ground
        ground = float(land.height(*self._flight.path(np.linspace(0, 1, 50))).mean())
        return self._flight.pose(self._share(index), ground, self._options.altitude)

    def _render(self, index: int, T: Float64) -> Rendered:
        """Return the rendered frame, stored while there is room.

        A pass over all frames would drop old ones too early.
        """
        town = self._built()
        with self._lock:
            of_frame = self._of_frame.setdefault(index, threading.Lock())
        with of_frame:  # of all that ask for a frame, one renders it
            if (rendered := self.rendered.get(index)) is not None:
                return rendered
            moving = CityCaster(town.moving(self._share(index) * self._flight.seconds, T[:3, 3]))
            size = (self._options.height, self._options.width)
            rendered = render((self.still, moving), T, self.camera, size, LIGHTS[self._options.light])
            with self._lock:
                stored = sum(other.nbytes for other in self.rendered.values())
                if stored + rendered.nbytes <= self._options.cache_megabytes * 1_000_000:
                    self.rendered[index] = rendered
            return rendered

    def _built(self) -> Town:
        """Return the town; whoever asks first builds it, and the still part at which rays are cast."""
        with self._lock:
            _ = self.still
            return self.town

    def _simulated(self, model: str) -> SimulatedModel | None:
        """Return the errors of a simulated model, None for the ground truth."""
        if model == GROUND_TRUTH:
            return None
        if model not in self._options.models:
            names = (*self.models, *self.by_name)
            raise ConfigError(f"city: model '{model}' is not known; {nearest(model, names)}")
        return self._options.models[model]
