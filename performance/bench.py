"""Tables of times and memory: the timed code, its data, and its baseline."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path += [str(ROOT / folder) for folder in ("scripts", "tests")]

import cases  # noqa: E402

CASES = {
    "command": "timed.command",
    "end-to-end": "timed.end_to_end",
    "recording": "timed.recording",
    "start": "timed.start",
    "tricks": "timed.tricks",
    "fusion": "timed.fusion",
    "threads": "timed.threads",
    "random-scenes": "timed.random_scenes",
    "scores": "timed.scores",
    "by-hand": "timed.by_hand",
    "scans": "timed.scans",
    "rivals": "timed.rivals",
    "gpu": "timed.gpu",
    "statistics": "timed.statistics",
    "spots": "timed.spots",
    "online": "timed.online",
    "filters": "timed.filters",
    "casting": "timed.casting",
    "growth": "timed.growth",
    "long": "timed.long",
    "memory": "timed.memory",
    "tiles": "timed.tiles",
    "workers": "timed.workers",
    "annotation": "timed.annotation",
}
PREPARED = ("fusion", "random-scenes", "scores", "scans", "rivals", "statistics", "spots")
"""Cases whose process is made ready as the command makes its own, before anything starts threads."""


def main(words: list[str]) -> None:
    """Print the tables of the case that the first word names."""
    from semstab.core.process import configure_process

    if words and words[0] in PREPARED:
        configure_process()
    logging.getLogger("semstab").setLevel(logging.ERROR)
    cases.run(__doc__, CASES, words, json=True)


if __name__ == "__main__":
    main(sys.argv[1:])
