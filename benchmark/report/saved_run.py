"""Give a notebook the summaries, tables and series of a finished run by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import values_of
from semstab.data import voxels
from semstab.data.digests import require_unchanged
from semstab.data.events import Events
from semstab.data.records import Result
from semstab.data.voxels import VoxelTable
from semstab.engine.folder import load_result
from semstab.errors import ConfigError, DataError, summarize_error

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


@dataclass(frozen=True)
class Run:
    """A finished run or study; a unit is named by scene, model and backend as far as that is needed.

    Attributes:
        result: Its results, typed.
    """

    folder: Path
    result: Result

    def __repr__(self) -> str:
        return f"{self.folder}: {self.result!r}"

    @property
    def summary(self) -> pd.DataFrame:
        """Return one row per unit: its names, its verdict, alpha with its interval, and the mean of every measure."""
        return self.result.to_pandas()

    @property
    def classes(self) -> pd.DataFrame:
        """One row per unit and class: alpha with its interval, and the class's share of the disagreement.

        `unstable` is the probability that alpha of the class is below the level 'usable'.
        """
        rows: list[dict[str, Any]] = []
        for unit in (run for run in self.result.runs if run.statistics is not None):
            spots = None if unit.statistics is None else unit.statistics.spots
            rows += [
                {
                    "scene": unit.unit.scene, "model": unit.unit.model, "backend": unit.unit.backend, "class": row.name,
                    "locations": row.locations, "counts_for_verdict": row.counts_for_verdict,
                    "alpha": row.alpha.value, "alpha_low": row.alpha.low, "alpha_high": row.alpha.high,
                    "unstable": row.unstable, "disagreement": row.disagreement,
                }
                for row in (() if spots is None else spots.classes)
            ]  # fmt: skip
        return voxels.to_pandas({name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())})

    def table(self, model: str | None = None, *, scene: str | None = None, backend: str | None = None) -> VoxelTable:
        """Return the voxels of a unit, as arrays; `.to_pandas()` of it is a data frame."""
        return self.result.record(scene=scene, model=model, backend=backend).table()

    def series(self, model: str | None = None, *, scene: str | None = None, backend: str | None = None) -> pd.DataFrame:
        """Return the time series of a unit: one row per frame.

        Raises:
            DataError: If its file cannot be read.
        """
        file = self.result.record(scene=scene, model=model, backend=backend).series
        if file is None:
            raise DataError(f"{self.folder}: the run stored no series of this unit; run it again")
        return voxels.to_pandas(_columns(file))

    def events(self, model: str | None = None, *, scene: str | None = None, backend: str | None = None) -> Events:
        """Return the log of a unit's observations.

        Raises:
            ConfigError: If the run stored none.
        """
        file = self.result.record(scene=scene, model=model, backend=backend).events_file
        if file is None or not file.exists():
            raise ConfigError(f"{self.folder}: the run stored no log of observations; run it with --events")
        return Events.load(file)

    def _repr_html_(self) -> str:
        return self.result._repr_html_()


def load(folder: str | Path) -> Run:
    """Return a finished run from its folder.

    Args:
        folder: The run's --out.

    Returns:
        Data frames `summary` (a row a unit; the screen's flicker is `compensated_flicker_percent`, as `flicker_percent`
        counts the camera's motion, too; its 'two views see the same class' is `agreeing`, its VSS at OP >= 3
        `vss_op3`) and `classes` (a row a class: alpha with its interval, share of the
        disagreement). For a unit, which scene, model and backend name as far as that is needed, `table()`, its voxels;
        `series()`, a row a frame; `events()`, the log of a run with --events. `result`: all numbers, typed.

    Raises:
        DataError: If the run does not exist or is damaged.

    Examples:
        >>> run = semstab.load("run")
        >>> run.summary[["model", "verdict"]]
                 model    verdict
        0   sim-steady     stable
        1  sim-flicker  undecided
        >>> run.classes[["model", "class", "alpha", "alpha_low", "alpha_high"]].head(2).round(2)
                model     class  alpha  alpha_low  alpha_high
        0  sim-steady  building   0.92       0.91        0.93
        1  sim-steady      road   0.89       0.88        0.91
    """
    return Run(Path(folder), load_result(folder))


def read_series(file: Path) -> dict[str, npt.NDArray[Any]]:
    """Read the time series in a file: (n,) values by column, one per frame, NaN or None for a missing value.

    Raises:
        DataError: If it cannot be read.
    """
    return {name: values_of(column) for name, column in _columns(file).items()}


def _columns(file: Path) -> dict[str, pa.ChunkedArray]:
    import pyarrow as pa
    from pyarrow import csv

    require_unchanged(file)
    try:
        read = csv.read_csv(str(file))
        return {name: read.column(name) for name in read.column_names}
    except (OSError, ValueError, LookupError, pa.ArrowException) as error:  # LookupError: a repeated name
        raise DataError(f"{file}: cannot be read ({summarize_error(error)})") from error
