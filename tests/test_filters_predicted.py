"""Filters on disk and inside a run, over models and over labels that are there: the same labels, also after a stop."""

from __future__ import annotations

import json

import numpy as np
import predicted_scene
import pytest
from posed_config import dataset_of
from typer.testing import CliRunner

from semstab.api import run
from semstab.cli import app
from semstab.configure import filtered_config, predicted_config, resolve
from semstab.datasets import open_dataset
from semstab.datasets.formats.images import read_labels
from semstab.errors import ConfigError, DataError
from semstab.predict.filters import REGISTRY, parse
from semstab.predict.predictor import PredictorConfig, load_predictor, parse_predictor, stored_labels
from semstab.predict.sequence import SequenceOptions, predict_sequence

MODEL = """
import os

import numpy as np

class Noisy:
    classes = ["dark", "middle", "bright"]
    seen = 0

    def predict(self, image):
        self.seen += 1
        if self.seen == int(os.environ.get("FAILS_AT", 0)):
            raise ValueError("power failure")
        grey = image.mean(axis=2) / 255
        noise = np.random.default_rng(int(image.sum())).normal(0, 0.15, grey.shape)
        scores = np.exp(-(((grey + noise)[..., None] - [0.25, 0.5, 0.75]) / 0.15) ** 2)
        return (scores / scores.sum(axis=2, keepdims=True)).astype(np.float32)
"""
FILTERS = [*(str(parse(name)) for name in REGISTRY.builtin), "ema-warped:0.8+vote:3", "vote:3+guided:2"]


@pytest.fixture
def scene(tmp_path):
    folder = predicted_scene.write(tmp_path / "flight")
    (tmp_path / "model.py").write_text(MODEL)
    return folder


def predictor(scene, text="", **more):
    filters = [] if not text else text.split("+")
    return PredictorConfig(model=f"{scene.parent}/model.py:Noisy", name="noisy", filters=filters, **more).resolved()


def to_disk(scene, config, name="noisy", indices=range(6), scores=False, **options):
    opened = open_dataset("posed_folder", {"root": str(scene)}).scene("flight")
    settings = SequenceOptions(name, scores, **options)
    return predict_sequence(opened, load_predictor(config), indices, scene, settings)


def stored(scene, name="noisy"):
    return [read_labels(scene / f"labels/{name}/{k:03d}.png") for k in range(6)]


def live(config):
    opened = open_dataset("predicted", resolve(config).dataset.options).scene("flight")
    (name,) = opened.models
    return [opened.frame(k, name).labels for k in (2, 0, 1, 3, 5, 4)], opened.digest([0, 1], name)


def test_live_and_on_disk_are_the_same(scene):
    raw = None
    for text in ["", *FILTERS]:
        config = predictor(scene, text)
        to_disk(scene, config, batch=4, overwrite=True)
        found, _ = live(predicted_config([config], None, {"dataset": dataset_of(scene)}))
        on_disk = stored(scene)
        np.testing.assert_array_equal(np.array(on_disk)[[2, 0, 1, 3, 5, 4]], found, err_msg=text)
        raw = on_disk if raw is None else raw
        changed = np.mean(np.not_equal(on_disk, raw))
        assert 0.001 < changed < 0.5 or not text, (text, changed)
    said = json.loads((scene / "labels/noisy/predictions.json").read_text())
    assert said["settings"]["filters"] == ["vote:3", "guided:2"]


@pytest.mark.parametrize("scores", [True, False])
def test_over_labels_that_are_there_they_say_what_they_say_over_the_model(scene, scores):
    to_disk(scene, predictor(scene), scores=scores, score_type="float32")
    source = "noisy-scores" if scores else "noisy"
    for text in FILTERS if scores else ["ema:0.6", "ema-warped:0.6", "vote:3"]:
        filters = text.split("+")
        config = resolve(filtered_config(filters, None, {"dataset": dataset_of(scene), "models": [source]}))
        opened = open_dataset("predicted", config.dataset.options).scene("flight")
        (name,) = opened.models
        assert name == "-".join(["noisy", *filters]).replace(":", "-") + "-scores" * scores
        if scores:
            images, frames = zip(
                *((predicted_scene.image(k), predicted_scene.frame(k, 1)) for k in range(6)), strict=True
            )
            wanted = load_predictor(predictor(scene, text)).predict(images, geometry=frames)
            for k in range(6):
                np.testing.assert_array_equal(opened.frame(k, name).predicted, wanted[k].labels, err_msg=text)
        on_disk = PredictorConfig(model="stored", options={"source": source}, filters=filters)
        recorded, model = stored_labels(on_disk, open_dataset("posed_folder", {"root": str(scene)}).scene("flight"))
        predict_sequence(recorded, model, range(6), scene, SequenceOptions("out", overwrite=True, batch=2))
        for k, labels in enumerate(stored(scene, "out")):
            np.testing.assert_array_equal(opened.frame(k, name).predicted, labels, err_msg=text)


@pytest.mark.parametrize("text", FILTERS)
def test_what_was_stopped_ends_as_if_it_had_not_been(scene, text, monkeypatch):
    to_disk(scene, predictor(scene, text), "whole")
    monkeypatch.setenv("FAILS_AT", "4")
    with pytest.raises(DataError, match="power failure"):
        to_disk(scene, predictor(scene, text), "half")
    monkeypatch.delenv("FAILS_AT")
    assert len([*(scene / "labels/half").glob("*.png")]) == 3
    to_disk(scene, predictor(scene, text), "half")
    np.testing.assert_array_equal(stored(scene, "half"), stored(scene, "whole"))


def test_the_filters_are_part_of_what_a_unit_depends_on(scene):
    def digest(text):
        return live(predicted_config([predictor(scene, text)], None, {"dataset": dataset_of(scene)}))[1]

    assert len({digest(text) for text in ("", "ema:0.6", "ema:0.7", "ema:0.6+guided:8")}) == 4


def test_labels_that_change_on_disk_are_filtered_again(scene):
    to_disk(scene, predictor(scene))
    config = {"dataset": dataset_of(scene), "models": ["noisy"]}
    before = live(filtered_config(["ema:0.6"], None, config))[1]
    assert live(filtered_config(["ema:0.6"], None, config))[1] == before
    from PIL import Image

    Image.fromarray(np.zeros((48, 80), np.uint8)).save(scene / "labels/noisy/000.png")
    assert live(filtered_config(["ema:0.6"], None, config))[1] != before


COUNTED = """
import os

import numpy as np

classes = ["dark", "bright"]
gives_scores = True

def net(image):
    with open(os.environ["COUNTS"], "a") as file:
        file.write("x")
    bright = image.mean(axis=2, dtype=np.float32)[..., None] / 255
    return np.concatenate([1 - bright, bright], axis=2)
"""


@pytest.mark.parametrize("unfiltered", [True, False])
def test_filters_over_one_model_share_its_maps(scene, monkeypatch, unfiltered):
    (scene.parent / "counted.py").write_text(COUNTED)
    monkeypatch.setenv("COUNTS", str(scene.parent / "count"))
    file = f"{scene.parent / 'counted.py'}:net"
    chains = [["ema:0.6"], ["vote:3"], ["guided:4", "vote:3"]]
    models = [parse_predictor(file)] * unfiltered + [parse_predictor(file, filters=chain) for chain in chains]
    out = scene.parent / "run"
    config = predicted_config(models, None, {"dataset": dataset_of(scene), "voxel_size": 0.25})
    found = run(config, out=out, report=False)
    assert (scene.parent / "count").read_text() == "x" * 6
    base = "net" if unfiltered else "net-ema-0.6-unfiltered"
    assert {path.name for path in (out / "predictions/flight/scores").iterdir()} == {base}
    names = ["net-ema-0.6", "net-vote-3", "net-guided-4-vote-3"]
    assert [record.unit.model for record in found.runs] == ["net"] * unfiltered + names
    for name, chain in zip(names, chains, strict=True):
        alone = load_predictor(parse_predictor(file, filters=chain))
        frames = [predicted_scene.frame(k, 1) for k in range(6)]
        wanted = alone.predict([predicted_scene.image(k) for k in range(6)], geometry=frames)
        for k in range(6):
            read = read_labels(out / f"predictions/flight/labels/{name}/{k:03d}.png")
            np.testing.assert_array_equal(read, wanted[k].labels, err_msg=name)


# --- The command line -------------------------------------------------------------------------------------------------


def bench(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_a_chain_from_the_command_line(scene):
    to_disk(scene, predictor(scene))
    chain = ("--filter", "vote:3", "--filter", "guided:2")
    result = bench("predict", "--model", "stored", "--set", "source=noisy", *chain, "--data", scene, "--quiet")
    assert result.exit_code == 0, result.output
    said = json.loads((scene / "labels/noisy-vote-3-guided-2/predictions.json").read_text())
    assert said["settings"]["filters"] == ["vote:3", "guided:2"]
    assert not np.array_equal(stored(scene, "noisy-vote-3-guided-2"), stored(scene))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--model", "noisy", "--filter", "smooth"), "filter 'smooth' is not known"),
        (("--predict", "stored,source=nosy", "--filter", "ema"), "model 'nosy' is not there; did you mean 'noisy'"),
        (("--predict", "stored,filters=[ema]"), "source"),
    ],
)
def test_bad_input_is_one_line(scene, words, said):
    to_disk(scene, predictor(scene))
    result = bench("run", "--data", scene, *words, "--voxel-size", "0.2", "--report", "off", "--rerun", "off")
    assert result.exit_code == 2
    assert said in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_stored_labels_need_a_scene(scene):
    with pytest.raises(ConfigError, match="takes the labels of a scene; choose one with --data or --dataset"):
        load_predictor(parse_predictor("stored,source=x"))
