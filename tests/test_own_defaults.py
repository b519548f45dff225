"""Settings that a user wants everywhere: below all others, said, listed, and left out where a file is named."""

from __future__ import annotations

import pytest
import tiny_scene
import yaml
from command_line import bench

from semstab.cli.options import own_defaults
from semstab.engine import load_result


@pytest.fixture
def folder(tmp_path):
    tiny_scene.write(tmp_path / "wall", models=("a",))
    (tmp_path / "config/semstab").mkdir(parents=True)
    (tmp_path / "config/semstab/config.yaml").write_text("voxel_size: 0.3\ncheck: null\n")
    return tmp_path


def size_of(folder, *words, **more):
    said = bench("--data", "wall", "--out", "out", "--overwrite", *words, cwd=folder, **more).stderr
    (run,) = load_result(folder / "out").runs
    return run.map_summary.voxel_size, said


def test_they_are_taken_where_no_file_is_named_and_said(folder) -> None:
    defaults = folder / "config/semstab/config.yaml"
    size, said = size_of(folder, SEMSTAB_CONFIG=str(defaults))
    assert size == 0.3
    assert f"settings of {defaults}" in said
    assert yaml.safe_load((folder / "out/config.yaml").read_text())["check"] is None
    assert size_of(folder, "--voxel-size", "0.5", SEMSTAB_CONFIG=str(defaults))[0] == 0.5
    (folder / "other.yaml").write_text("voxel_size: 0.45\n")
    size, said = size_of(folder, "--config", "other.yaml", SEMSTAB_CONFIG=str(defaults))
    assert size == 0.45
    assert "settings of" not in said
    assert "settings of" not in size_of(folder, "--quiet", SEMSTAB_CONFIG=str(defaults))[1]


def test_they_lie_in_the_folder_of_configurations_and_are_listed(folder, monkeypatch) -> None:
    defaults = folder / "config/semstab/config.yaml"
    monkeypatch.setenv("XDG_CONFIG_HOME", str(folder / "config"))
    monkeypatch.delenv("SEMSTAB_CONFIG", raising=False)
    assert own_defaults() == defaults
    monkeypatch.setenv("SEMSTAB_CONFIG", "")
    assert own_defaults() is None
    monkeypatch.delenv("SEMSTAB_CONFIG")
    defaults.unlink()
    assert own_defaults() is None
    defaults.write_text("voxel_size: 0.3\n")
    said = bench("list", cwd=folder, columns=400, SEMSTAB_CONFIG=str(defaults)).stdout
    assert said.endswith(f"settings used without --config: {defaults}\n  voxel_size: 0.3\n")
    assert "no settings in" in bench("list", cwd=folder, columns=400).stdout


def test_a_wrong_one_is_named_by_its_file(folder) -> None:
    defaults = folder / "config/semstab/config.yaml"
    defaults.write_text("voxel_sise: 0.3\n")
    said = bench("--data", "wall", "--out", "out", cwd=folder, code=2, SEMSTAB_CONFIG=str(defaults)).stderr
    assert f"error: {defaults}: unknown setting 'voxel_sise'; did you mean 'voxel_size'?" in said
    lost = folder / "lost.yaml"
    assert str(lost) in bench("--data", "wall", "--out", "out", cwd=folder, code=2, SEMSTAB_CONFIG=str(lost)).stderr
