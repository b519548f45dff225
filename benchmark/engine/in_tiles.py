"""The units of a start that are fused in tiles: some from its beginning, others since they outgrew the memory."""

from __future__ import annotations

from semstab.config import Config
from semstab.engine.beside import Beside
from semstab.engine.observer import Observers
from semstab.engine.sizing import begun_again
from semstab.engine.survey import Survey
from semstab.engine.tiled_unit import TiledUnit
from semstab.engine.tiling.partition import Tiling
from semstab.engine.units import Planned, PlannedUnit
from semstab.engine.waiting import Waiting
from semstab.engine.work.jobs import Outcome


class InTiles:
    """Puts them together, and begins them again where they turn out too large."""

    def __init__(self, config: Config, survey: Survey, waiting: Waiting, told: Observers) -> None:
        self._config, self._survey, self._waiting, self._told = config, survey, waiting, told
        self._units: dict[str, TiledUnit] = {}
        self._beside = Beside(threaded=survey.executor.elsewhere)

    def __contains__(self, identity: str) -> bool:
        return identity in self._units

    def begin(self, planned: PlannedUnit, tiling: Tiling) -> Outcome | None:
        """A unit; its own outcome where it has failed already."""
        tiled = TiledUnit(planned, tiling, self._survey.folder, self._survey.executor.width, self._beside)
        self._units[planned.identity] = tiled
        if planned.kept:
            self._told.tell(lambda observer: observer.unit_in_tiles(planned.unit, tiled.key, tiled.finished))
        self._waiting.add_tiled(tiled)
        return tiled.take(None)

    def take(self, planned: Planned, outcome: Outcome) -> Outcome | None:
        """What became of a unit, or of a portion of one; the unit's own outcome, where it has come to its end."""
        tiled = self._units.get(planned.identity)
        if tiled is None:
            again = isinstance(planned, PlannedUnit) and outcome.outgrown
            return self._begin_again(planned, outcome) if again else outcome  # type: ignore[arg-type]
        if outcome.portion is None:
            return outcome
        if outcome.error is None:
            self._told.tell(lambda observer: observer.advanced(tiled.step(), tiled.name))
        return tiled.take(outcome)

    def _begin_again(self, planned: PlannedUnit, outcome: Outcome) -> Outcome | None:
        sizing = begun_again(self._config, planned, self._survey)
        for line in sizing.remarks:
            self._told.tell(lambda observer, line=line: observer.remarked(line))  # type: ignore[misc]
        tiling = sizing.tilings.get(planned.identity)
        if tiling is None:
            return outcome
        if planned.kept:
            self._told.tell(lambda observer: observer.unit_begun_again(planned.unit))
        return self.begin(planned, tiling)
