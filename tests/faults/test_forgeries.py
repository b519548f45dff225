"""Forged results are refused in one line, or change no rank; `make faults` judges many more, and all of these."""

from __future__ import annotations

from pathlib import Path

import forgeries
import pytest
from corners import combination

RESULTS = Path(__file__).parents[2] / "results"


@pytest.mark.parametrize(("name", "model", "one_in"), [
    ("apc_shelf@1", "fcn-scores", 1), ("livingroom@1", "dicenet-0.2", 6),
    pytest.param("livingroom@1", "espnetv2-1.0", 1, marks=combination),
    pytest.param("city@1", "trick-world-locked", 6, marks=combination),
])  # fmt: skip
def test_no_forgery_changes_a_rank(name, model, one_in) -> None:
    referee = forgeries.Referee.from_folder(RESULTS, name)
    file = RESULTS / f"{name}__{model}.semstab"
    outcomes = [(what, outcome) for _, what, outcome in forgeries.judged(referee, file, fields=False, one_in=one_in)]
    assert len(outcomes) >= 100 // one_in
    assert [outcome for outcome in outcomes if outcome[1] not in ("refused", "no rank changes")] == []
    assert sum(outcome == "refused" for _, outcome in outcomes) > len(outcomes) / 2
