"""Names of version 0.3 work for one version, each with a warning that says today's name."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from typer.testing import CliRunner

from semstab.cli import app
from semstab.config import Config
from semstab.configure import load_study
from semstab.core import registry
from semstab.core.registry import Registry
from semstab.datasets.files.options import Template
from semstab.errors import ConfigError
from semstab.models import REGISTRY, Model, options_model
from semstab.models.checkpoint import ModelOptions
from semstab.predict.dataset import PredictedOptions
from semstab.predict.predictor import PredictorConfig


@pytest.fixture
def warned(caplog):
    """What a text has to hold: today's name beside the old one."""

    def check(old: str, new: str) -> None:
        assert any(old in record.message and new in record.message for record in caplog.records), caplog.text

    return check


def test_settings(warned):
    assert Config.build({"backbones": ["net"]}, "x").models == ["net"]
    warned("'backbones'", "'models'")
    config = PredictorConfig(backbone="segformer", options={"model": "weights"})
    assert config.model == "segformer"
    warned("'backbone'", "'model'")
    assert ModelOptions(model="weights").checkpoint == "weights"
    warned("'model'", "'checkpoint'")
    options = PredictedOptions(dataset={"name": "city"}, models=[{"backbone": "colour-clusters"}], remedies=["vote:3"])
    assert options.try_filters == ["vote:3"]
    warned("'remedies'", "'try_filters'")
    options = PredictedOptions(dataset={"name": "city"}, models=[{"model": "colour-clusters"}], kept="predictions")
    assert options.folder == Path("predictions")
    warned("'kept'", "'folder'")


def test_a_setting_that_is_given_under_both_names_is_refused():
    with pytest.raises(ConfigError, match="unknown setting 'backbones'"):
        Config.build({"backbones": ["net"], "models": ["net"]}, "x")


@pytest.mark.parametrize(
    "name", [name for name in REGISTRY.entries() if name != "stored" and not REGISTRY.missing(name)]
)
def test_no_model_has_its_weights_under_the_old_name(name):
    assert "model" not in options_model(name).model_fields


def test_the_checkpoint_of_segearth_has_a_default():
    assert options_model("segearth-ov")().checkpoint == "openai/clip-vit-base-patch16"
    assert options_model("segearth-ov")(model="clip").checkpoint == "clip"
    assert "checkpoint" not in options_model("segearth-ov")().identity()


def test_only_what_was_renamed_is_translated():
    assert "model" not in options_model("colour-clusters").model_fields
    with pytest.raises(ValueError, match="model"):
        options_model("colour-clusters")(model="weights")


def test_templates_of_paths(warned):
    assert Template("labels", "labels/{backbone}/{name}", ("model", "name")).text == "labels/{model}/{name}"
    warned("{backbone}", "{model}")


def test_studies_and_modules():
    assert load_study("remedies").name == "filters"
    import semstab.backbones

    with pytest.warns(DeprecationWarning, match=r"semstab.models"):
        assert semstab.backbones.Backbone is Model


def test_entry_points_of_other_packages(monkeypatch):
    declared = [
        EntryPoint("before", "fractions:Fraction", "semstab.backbones"),
        EntryPoint("today", "fractions:Fraction", "semstab.models"),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: [p for p in declared if p.group == group])
    assert list(Registry("model", {}).entries()) == ["before", "today"]
    assert not Registry("backend", {}).entries()


@pytest.mark.parametrize(
    ("words", "now"),
    [
        (["run", "--backbone", "nobody"], ["--backbone is now called --model", "nobody"]),
        (["predict", "--backbone", "no-net", "--model", "weights"], ["--model is now called --checkpoint", "no-net"]),
        (["predict", "-m", "no-net", "--model=weights"], ["--model is now called --checkpoint", "no-net"]),
        (["remedies", "--backbone", "nobody"], ["remedies is now called filters", "nobody"]),
    ],
)
def test_words_of_the_command_line(words, now, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert all(text in " ".join(done.stderr.split()) for text in now), done.stderr


def test_today_s_words_bring_no_warning(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["predict", "--model", "no-net", "--checkpoint", "weights"])
    assert done.exit_code == 2
    assert "now called" not in done.stderr
