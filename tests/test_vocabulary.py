"""Words of earlier versions that are gone from the code and the documentation; docs/glossary.md has those of today."""

from __future__ import annotations

import re
from pathlib import Path

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
        "benchmark/core/registry.py", "benchmark/data/earlier.py", "benchmark/configure.py",
        "datasets/files/options.py",
    )
}  # fmt: skip
"""Modules that read summaries and command lines of earlier versions, and so know their words."""

DECLARED = re.compile(r"^    earlier: ClassVar.*$", re.MULTILINE)
"""The line of a class of settings that names what its settings were called."""


def test_words_that_are_gone_stay_gone():
    pattern = re.compile(rf"(?<!\w)({'|'.join(map(re.escape, GONE))})(?!\w)")
    pages = (
        path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md", ".yaml")
    )
    texts = ((path, DECLARED.sub("", path.read_text(encoding="utf-8"))) for path in pages if path not in TRANSLATED)
    assert [(path, found) for path, text in texts for found in pattern.findall(text)] == []
