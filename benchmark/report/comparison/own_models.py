"""The comparison of a run's own models: the same one as `compare RUN` makes."""

from __future__ import annotations

from semstab.comparison.differences import differences_of
from semstab.comparison.opening import models_of
from semstab.data.records import Result
from semstab.report.comparison import tables as comparison_tables
from semstab.report.tables.table import Table


def own_models(result: Result) -> list[Table]:
    """Return the tables of the comparison of a run's models with the first one; none for one model."""
    handles = models_of(result)
    return comparison_tables.tables(differences_of(handles).result) if len(handles) > 1 else []
