"""Names that would collide, climb, or be too long as those of files: every result has a file of its own, inside OUT."""

from __future__ import annotations

import csv
import shutil

import pyarrow.parquet as pq
import pytest
import tiny_scene
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from posed_config import configure
from typer.testing import CliRunner

import semstab
from semstab import LabelSpace
from semstab.cli import app
from semstab.data.results import UnitName, slug
from semstab.engine.folder import require_file_names
from semstab.errors import ConfigError
from semstab.exports import export

HORRORS = (
    "a b", "a-b", "x", "x__y", "-rf", "[/bold]", "$x^{", "<b>&amp;", "ä" * 100, "new\nline", "\u202e",
)  # fmt: skip
"""Every one of them can be the name of a folder."""


@settings(max_examples=200, deadline=None)
@given(st.lists(st.lists(st.text("ab_-. /\u00e9", max_size=5), min_size=3, max_size=3), min_size=2, max_size=2))
def test_other_names_give_another_file_name(pair) -> None:
    one, other = pair
    assert (slug(*one) == slug(*other)) == (one == other)


@settings(max_examples=100, deadline=None)
@given(st.text(st.characters(exclude_categories=()), max_size=400))
def test_a_file_name_is_short_plain_and_visible(name) -> None:
    path = f"{slug(name, name, name)}.parquet"
    assert len(path.encode()) < 220
    assert not set(path) & set("/\\\0\n *?[]'\"$&;")
    assert path[0] not in "."


def test_names_that_share_a_file_are_refused_and_usual_ones_stay(tmp_path) -> None:
    """Two names with one digest of five bytes."""
    one, other = UnitName("a#>@$ b", "a", "numpy"), UnitName("a#>@:+b", "a", "numpy")
    assert one.slug == other.slug
    with pytest.raises(ConfigError, match="would be written to one file"):
        require_file_names(tmp_path / "out", [one, other])
    require_file_names(tmp_path / "out", [one, one])
    assert slug("scene-1", "segformer.b5_ade", "Gebäude") == "scene-1__segformer.b5_ade__Gebäude"


def test_every_hostile_name_gets_results_of_its_own(tmp_path) -> None:
    """Scenes and label sources: as many files as there are, all within OUT, and a second start finds them again."""
    tiny_scene.write(tmp_path / "scenes" / "plain", models=("z", "y__z"), frames=1)
    for name in HORRORS:
        shutil.copytree(tmp_path / "scenes" / "plain", tmp_path / "scenes" / name)
    config = configure(tmp_path / "scenes", models=["z", "y__z"], check=None, voxel_size=1.0)
    result = semstab.run(config, out=tmp_path / "out", report=False)
    files = [record.voxels_file for record in result.records]
    assert len(set(files)) == len(files) == 2 * (len(HORRORS) + 1)
    assert all(file.parent == tmp_path / "out" / "voxels" and file.is_file() for file in files)
    again = semstab.run(config, out=tmp_path / "out", report=False)
    assert again.manifest["units"]["kept"] == len(files)


def test_a_study_is_kept_below_studies_whatever_its_name(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    tiny_scene.write(tmp_path / "wall")
    content = {"name": "../../escape", "dataset": {"name": "posed_folder", "options": {"root": "wall"}}}
    (tmp_path / "study.yaml").write_text(yaml.safe_dump({**content, "backends": ["numpy"], "models": ["a"]}))
    done = CliRunner().invoke(app, ["study", "study.yaml", "--report", "off", "--quiet"])
    assert done.exit_code == 0, done.stderr
    assert len(list((tmp_path / "studies").iterdir())) == 1
    assert not list(tmp_path.parent.parent.glob("escape"))


@pytest.mark.parametrize("name", ["a\nelement face 9", "\x1b[31mred", "tab\t", "line\u2028", "\ufffe"])
def test_a_class_name_with_a_control_character_is_refused_where_it_is_read(name) -> None:
    with pytest.raises(ConfigError, match=r"holds a control character; rename it"):
        LabelSpace("t", ("wall", name))
    LabelSpace("t", ("Gebäude", "=cmd|' /C calc'!A0", "a b\u00a0c"))  # text, whatever it says


def test_a_spreadsheet_sees_no_formula_in_an_exported_table(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall", models=("a",))
    scene = yaml.safe_load((root / "scene.yaml").read_text())
    (root / "scene.yaml").write_text(yaml.safe_dump(scene | {"classes": ["=cmd|' /C calc'!A0", "+door", "@window"]}))
    semstab.run(configure(root, models=["a"], check=None), out=tmp_path / "run", report=False)
    export(tmp_path / "run", [tmp_path / "m.csv", tmp_path / "m.parquet"])
    rows = list(csv.DictReader((tmp_path / "m.csv").read_text(encoding="utf-8").splitlines()))
    assert {row["class"] for row in rows} <= {"'=cmd|' /C calc'!A0", "'+door", "'@window"}
    assert set(pq.read_table(tmp_path / "m.parquet")["class"].to_pylist()) <= {"=cmd|' /C calc'!A0", "+door", "@window"}
