"""Files of one's own, damaged: one line that names the file, and what can be computed again is."""

from __future__ import annotations

import json
import random
import re
import shutil
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_scene
from command_line import error_of
from posed_config import configure
from rich.console import Console

import semstab
from semstab.convert import convert
from semstab.core.files import read_sealed, write_sealed
from semstab.core.json_form import from_json
from semstab.data.records import Record
from semstab.engine import load_result
from semstab.errors import LONGEST_LINE, SemstabError
from semstab.predict.folder import PredictionFolder
from semstab.report.tables import tables
from semstab.report.terminal import print_summary

VALUES = (None, True, -1, 1e308, float("nan"), "x", "\ud800", [], {}, "../../x", 10**400, "a" * 5000, 0)
WHOLES = (b"", b"[]", b"null", b"{}", b"[" * 100_000, b'{"a":' * 50_000, b"\xff\xfe", b"1" * 6000, b'"x"')
DAMAGES = 30
"""Of each file."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """OUT/run, OUT/converted, OUT/labels/net: a run with two backends, a conversion, predictions."""
    out = tmp_path_factory.mktemp("own")
    config = configure(tiny_scene.write(out / "wall"), backends=["numpy", "numba"], check=None)
    semstab.run(config, out=out / "run", report=False)
    list(convert(config, out / "converted"))
    predicted(out).close()
    return out


def predicted(out: Path, **settings: Any) -> PredictionFolder:
    folder = PredictionFolder(out / "labels" / "net", "labels", settings, {}, None)
    if not folder.has("0", "digest"):
        folder.write("0", "digest", np.zeros((3, 3), np.uint8), 0.1)
    return folder


def damaged(text: str, rng: random.Random) -> bytes:
    """Bytes changed, the end cut, a value replaced somewhere, or something else altogether."""
    how = rng.random()
    if how < 0.05:
        return rng.choice(WHOLES)
    if how < 0.15:
        return text.encode()[: rng.randrange(len(text))]
    if how < 0.4:
        content = bytearray(text.encode())
        for _ in range(rng.randrange(1, 5)):
            content[rng.randrange(len(content))] = rng.randrange(256)
        return bytes(content)
    values = json.loads(text)
    replace_somewhere(values, rng)
    return json.dumps(values).encode("utf-8", "surrogatepass")


def replace_somewhere(values: Any, rng: random.Random) -> None:
    keys = list(values) if isinstance(values, dict) else list(range(len(values)))
    key = rng.choice(keys)
    if isinstance(values[key], dict | list) and values[key] and rng.random() < 0.8:
        replace_somewhere(values[key], rng)
    elif isinstance(values, dict) and rng.random() < 0.2:
        del values[key]
    else:
        values[key] = rng.choice(VALUES)


def read_again(file: Path) -> None:
    result = load_result(file.parent)
    tables(result)
    if result.select():
        print_summary(result, Console(file=StringIO()))


def read_unit(file: Path) -> None:
    from_json(Record, read_sealed(file), file)


def converted_again(file: Path) -> None:
    out = file.parents[2]
    list(convert(configure(out / "wall", backends=["numpy", "numba"], check=None), out / "converted"))


def predicted_again(file: Path) -> None:
    predicted(file.parents[2]).close()


@pytest.mark.parametrize(("pattern", "read"), [
    ("run/summary.json", read_again), ("run/manifest.json", read_again), ("run/units/*.json", read_unit),
    ("converted/wall/conversion.json", converted_again), ("labels/net/predictions.json", predicted_again),
])  # fmt: skip
def test_a_damaged_file_is_one_line_or_still_whole(folder, pattern, read: Callable[[Path], None]) -> None:
    rng, refused = random.Random(pattern), list[str]()
    file = min(folder.glob(pattern))
    whole = file.read_text()
    for _ in range(DAMAGES):
        file.write_bytes(damaged(whole, rng))
        try:
            read(file)
        except SemstabError as error:
            refused.append(str(error))
        finally:
            file.write_text(whole)
    assert [line for line in refused if str(file.parent) not in line or len(line) > LONGEST_LINE] == []
    read(file)
    assert len(refused) > DAMAGES / 10


@pytest.mark.parametrize(("place", "value", "said"), [
    (("strata",), [], "has no strata"), (("classes",), [], "has no classes"),
    (("statistics", "verdict", "level"), "fine", "level"),
])  # fmt: skip
def test_a_summary_that_lacks_what_its_tables_are_made_of_is_refused(folder, place, value, said) -> None:
    file = folder / "run" / "summary.json"
    whole = file.read_text()
    content = read_sealed(file)
    part = content["runs"][0]
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    write_sealed(file, content)
    try:
        with pytest.raises(SemstabError, match=rf"summary\.json: .*{said}"):
            read_again(file)
    finally:
        file.write_text(whole)


@pytest.mark.parametrize("name", ["summary.json", "manifest.json"])
def test_a_changed_digit_in_a_file_of_a_run_is_one_line_in_whatever_reads_it(folder, tmp_path, name) -> None:
    run = shutil.copytree(folder / "run", tmp_path / "run")
    change_a_digit(run / name)
    for words in (("show", "run"), ("gate", "run", "--save-baseline", "x.semstab"), ("export", "run", "--to", "x.ply")):
        assert f"{name}: has changed since the run wrote it; run the same command again" in error_of(
            *words, cwd=tmp_path
        )
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_digit_that_was_changed_in_a_unit_is_never_carried_into_the_summary(folder, tmp_path, caplog) -> None:
    run = shutil.copytree(folder / "run", tmp_path / "run")
    before = read_sealed(run / "summary.json")["runs"]
    unit = min(run.glob("units/*.json"))
    change_a_digit(unit)
    config = configure(folder / "wall", backends=["numpy", "numba"], check=None)
    again = semstab.run(config, out=run, report=False)
    assert f"{unit.name}: damaged; the unit is computed again" in caplog.text
    assert again.manifest["units"]["computed"] == 1
    alphas = [
        [row["statistics"]["headline"]["alpha"] for row in rows]
        for rows in (before, read_sealed(run / "summary.json")["runs"])
    ]
    assert alphas[0] == alphas[1]


def change_a_digit(file: Path) -> None:
    """Change the first digit after a point of the file, or of a digest."""
    text = file.read_text()
    at = next(match.end() - 1 for match in re.finditer(r'(?<=[0-9]\.)[0-9]|": "[0-9a-f]', text))
    file.write_text(text[:at] + ("7" if text[at] != "7" else "3") + text[at + 1 :])
