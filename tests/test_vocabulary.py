"""Words of earlier versions that are gone from the code and the documentation; docs/glossary.md has those of today."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("benchmark", "backends", "backbones", "datasets", "configs", "conformance", "docs")
GONE = (
    "AtHand", "Arrangement", "BeyondCoin", "Contender", "FrameJudge", "MapLog", "Portion", "Scenery", "Sights",
    "Suspect", "Survey", "Votes", "first look", "foresight", "forensics", "frames to blame", "give_back", "judged_by",
    "least steady", "one_line", "rivals", "same looks", "settling", "tell_apart", "this map'",
)  # fmt: skip
TRANSLATED = ROOT / "benchmark/data/earlier.py"
"""What reads summaries of earlier versions, and so knows their words."""


@pytest.mark.parametrize("word", GONE)
def test_a_word_that_is_gone_stays_gone(word):
    pattern = re.compile(rf"(?<!\w){re.escape(word)}(?!\w)")
    pages = (
        path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md", ".yaml")
    )
    there = [path for path in pages if path != TRANSLATED and pattern.search(path.read_text(encoding="utf-8"))]
    assert there == []
