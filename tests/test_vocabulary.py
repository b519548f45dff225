"""Words of earlier versions that are gone from the code and the documentation; docs/glossary.md has those of today."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("benchmark", "backends", "models", "datasets", "configs", "conformance", "docs")
GONE = (
    "AtHand", "Arrangement", "backbone", "backbones", "BeyondCoin", "Contender", "FrameJudge", "MapLog", "Portion",
    "Scenery", "Sights", "Suspect", "Survey", "Votes", "first look", "foresight", "forensics", "frames to blame",
    "give_back", "judged_by", "least steady", "one_line", "remedies", "rivals", "same looks", "settling",
    "stable_wrong", "tell_apart", "this map'", "wrong_of_stable",
)  # fmt: skip
TRANSLATED = {
    ROOT / name
    for name in (
        "benchmark/backbones.py", "benchmark/cli/__init__.py", "benchmark/cli/show_commands.py",
        "benchmark/core/registry.py", "benchmark/data/earlier.py", "benchmark/settings.py",
        "datasets/files/options.py",
    )
}  # fmt: skip
"""Modules that read summaries and command lines of earlier versions, and so know their words."""

DECLARED = re.compile(r"^    earlier: ClassVar.*$", re.MULTILINE)
"""The line of a class of settings that names what its settings were called."""


@pytest.mark.parametrize("word", GONE)
def test_a_word_that_is_gone_stays_gone(word):
    pattern = re.compile(rf"(?<!\w){re.escape(word)}(?!\w)")
    pages = (
        path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md", ".yaml")
    )
    texts = ((path, DECLARED.sub("", path.read_text(encoding="utf-8"))) for path in pages if path not in TRANSLATED)
    there = [path for path, text in texts if pattern.search(text)]
    assert there == []
