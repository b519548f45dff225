"""docs/datasets.md against the code: every dataset has a section, and every option that it names exists."""

from __future__ import annotations

import itertools
import re
import shlex
from pathlib import Path

import pytest
from pydantic import ValidationError

from semstab.config import Config
from semstab.core.files import parse_yaml
from semstab.datasets import REGISTRY, options_model
from semstab.model.labels import shipped_taxonomies

TEXT = (Path(__file__).parents[1] / "docs/datasets.md").read_text()
SECTIONS = {match[1]: match[2] for match in re.finditer(r"^## [^\n]*\(`(\w+)`\)\n(.*?)(?=^## |\Z)", TEXT, re.M | re.S)}
READERS = {
    name for name, entry in REGISTRY.builtin.items() if re.fullmatch(r"semstab\.datasets\.\w+:\w+", entry.target)
}


def test_every_reader_has_a_section_with_its_terms():
    assert set(SECTIONS) == READERS - {"city", "posed_folder", "predicted"}
    for name, section in SECTIONS.items():
        assert all(f"- **{word}**" in section for word in ("Get", "Licence", "Read", "Name")), name
        assert f"--dataset {name}" in section


COMMANDS = [
    (name, command)
    for name, section in SECTIONS.items()
    for block in re.findall(r"```bash\n(.*?)```", section, re.S)
    for command in block.replace("\\\n", " ").strip().splitlines()
]


@pytest.mark.parametrize(("name", "command"), COMMANDS)
def test_the_sample_commands_set_what_there_is(name, command):
    words = shlex.split(command)
    assert words[words.index("--dataset") + 1] == name
    options, frames = {"root": "."}, {}
    for setting in (word for before, word in itertools.pairwise(words) if before == "--set"):
        key, _, value = setting.partition("=")
        group = options if key.startswith("dataset.options.") else frames
        group[key.rpartition(".")[2]] = parse_yaml(value, key)
    try:
        model = options_model(name).model_validate(options)
    except ValidationError as error:
        pytest.fail(str(error))
    Config.build({"frames": frames})
    assert getattr(model, "taxonomy", None) in (None, *shipped_taxonomies())


def test_the_options_in_tables_are_those_of_every_reader():
    table = TEXT.split("## Options that every dataset below has")[1].split("## Frames")[0]
    named = set(
        re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in table.splitlines() if line.startswith("|")))
    )
    assert len(named) > 8
    for name in SECTIONS:
        assert named <= set(options_model(name).model_fields), name


def test_the_frames_that_are_shown_are_settings():
    table = TEXT.split("## Frames")[1].split("## UAVid")[0]
    shown = re.findall(r"\| `(\{.*?\})` \|", table)
    assert len(shown) == 4
    for text in shown:
        Config.build({"frames": parse_yaml(text, "docs/datasets.md")})
