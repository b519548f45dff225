"""Verdicts on labellers that agree with themselves for the wrong reasons.

    python simulations/simulate.py labellers [--scene scene0] [--frames 20] [--width 384]

Runs the simulated labellers of the city (datasets/city/labellers.py) without ground truth, as users do, and with it.
Prints a table in Markdown.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import cases

import semstab
from semstab.datasets.city.options import MODELS
from semstab.report.narrative import warnings

HEAD = (
    "labeller", "alpha", "labelled, %", "edges met, %", "flicker, %", "verdict without truth", "warned of",
    "verdict with truth", "wrong of consistent, %", "accuracy, %",
)  # fmt: skip
REASONS = {
    "no label": "no labels",
    "edges of depth": "coarse",
    "not that they are right": "no truth",
    "covers": "one class",
}
"""Words of a warning, and its name in the table."""


def rows(scene: str, frames: int, width: int) -> Iterator[list[str]]:
    """Yield the cells of each labeller."""
    names = [name for name in MODELS if name != "sim-soft"]
    options = {"frames": frames, "width": width, "height": round(width * 9 / 16)}
    settings = {"dataset": {"name": "city", "options": options}, "scenes": [scene], "check": None}
    with tempfile.TemporaryDirectory() as folder:
        results = []
        for truth in (False, True):
            out = Path(folder) / str(truth)
            semstab.run(
                semstab.load_config(overrides={**settings, "models": names, "truth": truth}),
                out=out,
                report=False,
            )
            results.append(semstab.load_result(out))
        plain, judged = results
        for name in names:
            (record,), (true,) = plain.select(model=name), judged.select(model=name)
            found, right = record.statistics, true.statistics
            said = [text for text in warnings(plain) if name in text or text.startswith("stable says")]
            reasons = [
                reason for part, reason in REASONS.items() if any(part in text and name in text for text in said)
            ]
            numbers = right.headline.wrong_of_consistent_op3.value, right.correctness.accuracy_op2.value
            yield [
                name, f"{found.headline.alpha.value:.2f}", f"{100 * found.spots.labelled:.0f}",
                f"{100 * record.image_space.edge_recall:.0f}", f"{record.image_space.compensated_flicker_percent:.1f}",
                found.verdict.level, ", ".join(reasons), right.verdict.level, f"{100 * numbers[0]:.0f}",
                f"{100 * numbers[1]:.0f}",
            ]  # fmt: skip


def main(scene: str = "scene0", frames: int = 20, width: int = 384) -> None:
    cases.head(HEAD)
    for cells in rows(scene, frames, width):
        cases.row(cells)
