"""The shipped study of UAVid-3D-Scenes from images to its numbers, by the commands that stand in its file."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import tiny_models
import yaml
from dataset_writers import save, source, write_colmap
from model_folders import tiny
from typer.testing import CliRunner

from semstab import load_result, load_study
from semstab.cli import app

CONFIGS = Path(__file__).parents[1] / "configs"
STUDY = CONFIGS / "studies" / "uavid3d.yaml"

TINY_SAM = ["--set", "points_per_side=3", "--set", "pred_iou=0.5", "--set", "stability=0.3",
            "--set", "stability_offset=0.01", "--set", "min_area=5"]  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Frames of the city in UAVid's layout, without labels."""
    folder = tmp_path_factory.mktemp("uavid")
    for name, frame in zip(write_colmap(folder / "scene0", source()), source(), strict=True):
        save(folder / f"scene0/depth/{name}.npy", frame.depth)
    return folder


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    tiny_models.segformer(folder / "segformer", tiny_models.CITYSCAPES)
    for kind in ("clip", "sam"):
        (folder / kind).symlink_to(tiny(kind))
    prompts = yaml.safe_load((CONFIGS / "models" / "segearth_uavid.yaml").read_text())
    prompts |= {"prob_threshold": 0.0, "templates": prompts["templates"][:2]}  # of random weights nothing is likely
    (folder / "prompts.yaml").write_text(yaml.safe_dump(prompts))
    return folder


def called(arguments):
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    return result.output


def documented():
    text = STUDY.read_text()
    return [shlex.split(line)[1:] for line in re.findall(r"^#   (semstab-bench .*)$", text, flags=re.MULTILINE)]


def test_from_images_to_numbers_by_the_documented_commands(data, models, tmp_path):
    *predictions, study = documented()
    assert [words[0] for words in (*predictions, study)] == ["predict"] * 4 + ["study"]
    for words in (*predictions, study):
        words[:] = [word.replace("DATA", str(data)).replace("MODELS", str(models)) for word in words]
    for words in predictions:
        more = {"segearth-ov": ["--set", f"prompts={models / 'prompts.yaml'}"], "segformer": []}
        called([*words, *more.get(words[words.index("--model") + 1], TINY_SAM), "-q"])
    small = ["scenes=[scene0]", "scene_frames={}", "frames={stop: 3}", "pixel_stride=2", "backends=[numpy]"]
    settings = [part for setting in small for part in ("--set", setting)]
    parts = ["--only", "shared_taxonomy", "--report", "off"]
    called([*study, *settings, *parts, "--out", str(tmp_path / "study"), "-q"])
    result = load_result(tmp_path / "study")
    units = {(record.variation.sweep, record.unit.model): record for record in result.records}
    names = load_study("uavid3d").models or []
    assert set(units) == {(sweep, name) for sweep in ("base", "shared_taxonomy") for name in names}
    classes = {(sweep, summary.map_summary.K) for (sweep, _), summary in units.items()}
    assert classes == {("base", 6), ("shared_taxonomy", 3)}
    assert all(summary.frames == 3 for summary in units.values())
    assert [region.model for region in result.regions] == ["sam-raw"]
