"""The colours of models: the same in report, figures and viewer, for any colour vision, on light and dark ground."""

from __future__ import annotations

MODEL_COLORS = (
    (0, 158, 115), (122, 92, 200), (160, 125, 20), (204, 121, 167), (58, 150, 200), (176, 48, 96),
    (107, 142, 35), (60, 130, 105), (138, 109, 59), (148, 103, 189), (199, 140, 120), (95, 115, 135),
)  # fmt: skip
"""RGB of each model in order, of like lightness, and none that a stability category has (`CATEGORY_COLORS`)."""

DASHES, MARKERS = ("", "6 3", "2 2.5"), ("circle", "square", "diamond", "triangle", "cross")
"""Patterns of lines, and markers, by which models are told apart where colours are not."""


KINDS = {"stable": "good", "usable": "part", "undecided": "open", "uninformative": "open", "no verdict": "open"}
"""The kinds of levels by which verdicts have their colour; all other levels are bad."""

KIND_COLORS = {"good": "#1a8f68", "part": "#a17a10", "open": "#808085", "bad": "#c75a1a"}
"""The colours of kinds where the ground is not known, as in a notebook; a report's own are darker, or lighter."""


def model_color(k: int) -> tuple[int, int, int]:
    """Return the RGB of the k-th model."""
    return MODEL_COLORS[k % len(MODEL_COLORS)]


def hexadecimal(color: tuple[int, int, int]) -> str:
    """Return RGB as '#0072b2'."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def dash(k: int) -> str:
    """Return the pattern of the k-th model's line, '' for a solid line; the pattern changes after every six colours."""
    return DASHES[2 * k // len(MODEL_COLORS) % len(DASHES)]


def marker(k: int) -> str:
    """Return the marker of the k-th model."""
    return MARKERS[k % len(MARKERS)]
