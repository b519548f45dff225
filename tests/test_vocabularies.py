"""Vocabularies over features: the labels that they give, their ranking in one run, and what bad ones say."""

from __future__ import annotations

import dataclasses
from unittest.mock import patch

import numpy as np
import pytest
import yaml
from command_line import bench, error_of
from room_scene import CLASSES, Room, walk, write

import semstab
from semstab import Features
from semstab.core.files import write_image
from semstab.datasets import open_dataset
from semstab.datasets.posed_folder import PosedFolder
from semstab.errors import ConfigError, DataError
from semstab.predict.vocabulary import Vocabulary, vocabularies_by_name
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import value

D = 8
UNCHECKED = ("--check", "none", "--no-geometry-check")
EMBEDDINGS = np.random.default_rng(7).normal(size=(len(CLASSES), D))


def vocabulary(folder, name="five", names=CLASSES, embeddings=EMBEDDINGS, **more):
    """The file of a vocabulary."""
    np.save(folder / f"{name}.npy", np.asarray(embeddings, np.float32))
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({"names": [*names], "embeddings": f"{name}.npy", **more}))
    return path


def room(folder, model="net", frames=12, noise=0.7):
    """A room with features of a model: embeddings of the true classes, and noise."""
    scene = Room(poses=walk(frames))
    write(folder, scene)
    rng = np.random.default_rng(0)
    (folder / "features" / model).mkdir(parents=True)
    for i in range(frames):
        cells = EMBEDDINGS[scene.frame(i, "gt").labels[2::4, 2::4]]
        values = cells + noise * rng.normal(size=cells.shape)
        np.save(folder / f"features/{model}/{i:03d}.npy", values.astype(np.float32))
    return folder


def test_predictions_of_the_dataset_below_go_to_the_folder_of_the_run(tmp_path):
    below = {"name": "posed_folder", "options": {"root": str(room(tmp_path / "room"))}}
    options = {"dataset": below, "vocabularies": [str(vocabulary(tmp_path))]}
    dataset = open_dataset("vocabularies", options, tmp_path / "run")
    (scene,) = dataset.scenes
    with patch.object(PosedFolder, "scene", autospec=True, side_effect=PosedFolder.scene) as opened:
        dataset.scene(scene)
    assert opened.call_args.args[0].run_folder == tmp_path / "run"


def test_a_cell_has_the_likeliest_name(tmp_path):
    words = Vocabulary.load(vocabulary(tmp_path))
    cells = np.random.default_rng(1).normal(size=(6, 7, D))
    unit = EMBEDDINGS / np.linalg.norm(EMBEDDINGS, axis=1, keepdims=True)
    labels = words.labels(Features.over(cells, (60, 70)), "here")
    assert np.array_equal(labels, (cells @ unit.T).argmax(axis=2))
    assert words.space.classes == CLASSES


def test_a_classifiers_weights_give_its_labels(tmp_path):
    """Weights of any length, with a bias as the last component."""
    rng = np.random.default_rng(2)
    weights, bias, cells = (
        rng.normal(size=(5, D)) * [[1], [2], [3], [4], [5]],
        rng.normal(size=5),
        rng.normal(size=(9, 9, D)),
    )
    path = vocabulary(tmp_path, embeddings=np.column_stack([weights, bias]), normalise=False)
    features = Features.over(np.concatenate([cells, np.ones((9, 9, 1))], axis=2), (9, 9))
    assert np.array_equal(Vocabulary.load(path).labels(features, "here"), (cells @ weights.T + bias).argmax(axis=2))


def test_synonyms_count_as_one(tmp_path):
    names = ["room", {"name": "furniture", "synonyms": ["table", "shelf"]}, "box"]
    words = Vocabulary.load(vocabulary(tmp_path, names=names))
    features = Features.over(EMBEDDINGS[None], (1, 5))
    assert words.labels(features, "here").tolist() == [[0, 1, 1, 1, 2]]
    assert words.space.members == ((), ("table", "shelf"), ())


def test_a_threshold_leaves_cells_without_a_label(tmp_path):
    words = Vocabulary.load(vocabulary(tmp_path, threshold=0.99))
    cells = np.concatenate([EMBEDDINGS, -EMBEDDINGS])[None]
    assert words.labels(Features.over(cells, (1, 10)), "here").tolist() == [[0, 1, 2, 3, 4, *[255] * 5]]


def test_distances_are_of_the_names(tmp_path):
    close = EMBEDDINGS.copy()
    close[2] = close[1] + 0.1 * close[2]
    distances = Vocabulary.load(vocabulary(tmp_path, embeddings=close)).distances
    assert distances == pytest.approx(distances.T)
    assert distances[1, 2] < 0.05 < np.delete(distances[1], [1, 2]).min()


def test_a_run_ranks_vocabularies_over_one_network(tmp_path):
    room(tmp_path / "room")
    vocabulary(tmp_path)
    mixed = EMBEDDINGS.copy()
    mixed[3] = mixed[0] + 0.05 * mixed[3]  # 'crate' is much like 'room'
    vocabulary(tmp_path, "mixed", names=["room", "table", "shelf", "wall", "box"], embeddings=mixed)
    words = "room", "--voxel-size", "0.2", "-o", "run", "--model", "net", "--no-truth", *UNCHECKED
    screen = bench(*words, "--vocabulary", "five.yaml", "--vocabulary", "mixed.yaml", cwd=tmp_path).stdout
    assert "most stable first: 1. net; 2. net@five; 3. net@mixed" in screen
    assert "net@mixed: 5 names" in screen
    assert "net@mixed: by meaning: alpha" in screen
    result = semstab.load_result(tmp_path / "run")
    assert [*result.models] == ["net", "net@five", "net@mixed"]
    five = result.record(model="net@five")
    assert five.statistics.headline.alpha.value > result.record(model="net@mixed").statistics.headline.alpha.value
    assert result.record(model="net").statistics.features.alpha.value > 0
    again = bench(*words, "--vocabulary", "five.yaml", "--vocabulary", "mixed.yaml", "--overwrite", cwd=tmp_path)
    assert "most stable first: 1. net; 2. net@five; 3. net@mixed" in again.stdout


def test_other_numbers_of_names_do_not_change_alpha(tmp_path):
    from semstab.comparison.ranking import over_one_model, with_one_number_of_classes
    from semstab.statistics import SpotObservations

    room(tmp_path / "room")
    vocabulary(tmp_path)
    vocabulary(tmp_path, "two", names=["room", {"name": "thing", "synonyms": ["a", "b", "c"]}], threshold=0.2)
    bench("room", "--voxel-size", "0.2", "-o", "run", "--vocabulary", "five.yaml", "--vocabulary", "two.yaml",
          "--no-truth", *UNCHECKED, cwd=tmp_path)  # fmt: skip
    files = {record.unit.model: record.observations_file for record in semstab.load_result(tmp_path / "run").select()}
    names = over_one_model([*files])
    assert names == ("net@five", "net@two")
    samples = {name: SpotObservations.load(files[name]) for name in names}
    for name, wide in with_one_number_of_classes(samples).items():
        assert wide.K == 5
        assert value(sums_of_spots(wide), "alpha") == pytest.approx(value(sums_of_spots(samples[name]), "alpha"))
        assert wide.labelled_share() == samples[name].labelled_share()


def test_the_network_runs_once(tmp_path):
    write(tmp_path / "room", Room(poses=walk(4)))
    (tmp_path / "room/color").mkdir()
    for i in range(4):
        write_image(tmp_path / f"room/color/{i:03d}.png", np.full((72, 96, 3), 8 * i, np.uint8))
    (tmp_path / "net.py").write_text(
        "import pathlib\nimport numpy as np\ngives_features = True\n\n"
        "def net(image):\n    with pathlib.Path('calls').open('a') as file:\n        file.write('x')\n"
        f"    return np.random.default_rng(0).normal(size=(9, 12, {D})).astype(np.float32)\n"
    )
    vocabulary(tmp_path)
    vocabulary(tmp_path, "three", names=["a", "b", "c"], embeddings=EMBEDDINGS[:3])
    bench("room", "--voxel-size", "0.2", "-o", "run", "--predict", "net.py:net", "--vocabulary", "five.yaml",
          "--vocabulary", "three.yaml", "--no-truth", *UNCHECKED, cwd=tmp_path)  # fmt: skip
    assert (tmp_path / "calls").read_text() == "x" * 4
    assert [*semstab.load_result(tmp_path / "run").models] == ["net", "net@five", "net@three"]


def test_each_name_is_left_out_in_one_run(tmp_path):
    """A name that is mixed up with another one costs alpha; what leaving it out changes is counted by hand."""
    from semstab.report.tables import tables
    from semstab.statistics import SpotObservations

    room(tmp_path / "room")
    mixed = EMBEDDINGS.copy()
    mixed[3] = mixed[0] + 0.05 * mixed[3]  # 'crate' is much like 'room'
    vocabulary(tmp_path, embeddings=mixed)
    words = "room", "--voxel-size", "0.2", "-o", "run", "--no-truth"
    bench(*words, "--vocabulary", "five.yaml,without=each", *UNCHECKED, cwd=tmp_path)
    result = semstab.load_result(tmp_path / "run")
    assert [*result.models] == ["net", "net@five", *(f"net@five,without={name}" for name in CLASSES)]
    (table,) = (table for table in tables(result) if table.name == "prompts")
    (group,) = table.groups
    assert group.name == "net@five"
    assert group.rows[0][0] == "all names"
    rows = {row[0]: row for row in group.rows[1:]}
    assert {*rows} == {f"without {name}" for name in CLASSES}
    assert {group.rows[1][0], group.rows[2][0]} == {"without room", "without crate"}
    full, less = (
        SpotObservations.load(result.record(model=name).observations_file)
        for name in ("net@five", "net@five,without=crate")
    )
    alpha = [value(sums_of_spots(sample), "alpha") for sample in (full, less)]
    _, _, change, changed, most, share = rows["without crate"]
    assert change.value == pytest.approx(alpha[1] - alpha[0], abs=1e-6)
    assert 0 < change.low < change.value < change.high
    assert changed == pytest.approx(100 * np.mean(full.label == CLASSES.index("crate")))  # others keep their label
    assert most == "crate to room"
    assert share > 90
    screen = bench("show", "run", "prompts", cwd=tmp_path).stdout
    assert "without shelf" in screen


def test_names_change_as_the_text_beside_the_file_says(tmp_path, monkeypatch):
    """Names are left out, added and renamed; a new name is encoded, the others are not encoded again."""
    from semstab.predict import vocabulary as module

    vectors = {
        name: row.astype(np.float32)
        for name, row in zip((*CLASSES, "lamp", "rack"), [*EMBEDDINGS, *EMBEDDINGS[:2] + 1], strict=True)
    }
    asked = []
    monkeypatch.setattr(
        module, "_encoded", lambda encoder, words, path: (asked.append(words), np.stack([vectors[w] for w in words]))[1]
    )
    path = tmp_path / "five.yaml"
    path.write_text(yaml.safe_dump({"names": [*CLASSES], "encoder": {"checkpoint": "clip"}}))
    texts = ["", ",without=crate,add=lamp", ",rename=shelf:rack"]
    full, other, renamed = module.vocabularies_by_name([f"{path}{text}" for text in texts]).values()
    assert other.space.name == "five,without=crate,add=lamp"
    assert other.space.classes == (*(name for name in CLASSES if name != "crate"), "lamp")
    assert renamed.space.classes == tuple("rack" if name == "shelf" else name for name in CLASSES)
    assert asked == [[*CLASSES], ["lamp"], ["rack"]]
    for words in (full, other, renamed):
        expected = np.stack([vectors[name] / np.linalg.norm(vectors[name]) for name in words.space.classes])
        assert words.embeddings == pytest.approx(expected, abs=1e-6)


def test_a_name_in_other_words_is_no_change(tmp_path):
    """Renaming with the same labels changes none; a label that is taken away becomes another one, or none."""
    from semstab.comparison.prompts import effect
    from semstab.predict.prompts import VocabularyChanges
    from semstab.statistics import SpotObservations

    room(tmp_path / "room")
    bench("room", "--voxel-size", "0.2", "-o", "run", "--no-truth", "--vocabulary", vocabulary(tmp_path), cwd=tmp_path)
    full = SpotObservations.load(semstab.load_result(tmp_path / "run").record(model="net@five").observations_file)
    same = dataclasses.replace(full, classes=("space", *full.classes[1:]))
    found = effect(full, same, VocabularyChanges(rename=((full.classes[0], "space"),)))
    assert (found.changed, found.most, found.difference.value) == (0, "", 0)
    silent = dataclasses.replace(full, label=np.where(full.label == 1, full.K, full.label).astype(np.uint16))
    found = effect(full, silent, VocabularyChanges(without=(full.classes[1],)))
    assert found.changed == pytest.approx(np.mean(full.label == 1))
    assert found.most == f"{full.classes[1]} to no label"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("without=crat", "no name 'crat'; did you mean 'crate'?"),
        ("without=", "'without=' says no name; write without=NAME"),
        ("rename=crate", "'rename=crate' says no name; write rename=OLD:NEW"),
        ("add=lamp", "five.yaml holds embeddings, of its own names alone; give it an encoder, or put 'lamp' into the"),
        ("without=each,without=crate", "without=each stands alone"),
        (",".join(f"without={name}" for name in CLASSES[1:]), "leaves 1 name; at least 2 are needed"),
    ],
)
def test_a_bad_change_of_names_is_one_line(tmp_path, text, line):
    room(tmp_path / "room", frames=2)
    vocabulary(tmp_path)
    error = error_of("room", "--voxel-size", "0.2", "-o", "run", "--vocabulary", f"five.yaml,{text}", cwd=tmp_path)
    assert line in error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"names": ["room"], "embeddings": EMBEDDINGS[:1]}, "1 name; at least 2 are needed"),
        ({"embeddings": EMBEDDINGS[:3]}, "has the shape (3, 8); there are 5 names and synonyms, so (5, D) is needed"),
        ({"embeddings": EMBEDDINGS * np.array([[1], [1], [0], [1], [1]])}, "embedding of 'shelf' has no length"),
        ({"names": ["a", "b", "c", "d", "A"]}, "'a' is named twice"),
        ({"encoder": {"checkpoint": "clip"}}, "give embeddings or encoder, one of the two"),
        ({"treshold": 0.2}, "treshold"),
    ],
)
def test_a_bad_vocabulary_is_one_line(tmp_path, change, line):
    room(tmp_path / "room", frames=2)
    vocabulary(tmp_path, **change)
    error = error_of("room", "--voxel-size", "0.2", "-o", "run", "--vocabulary", "five.yaml", cwd=tmp_path)
    assert line in error
    assert not (tmp_path / "run").exists()


def test_embeddings_of_another_network_are_one_line(tmp_path):
    room(tmp_path / "room", frames=2)
    vocabulary(tmp_path, embeddings=EMBEDDINGS[:, :5])
    numpy = ("-b", "numpy", "--check", "none")  # compiles nothing, of which a line would tell
    error = error_of("room", "--voxel-size", "0.2", *numpy, "-o", "run", "--vocabulary", "five.yaml", cwd=tmp_path)
    assert "embeddings have 5 components, and features 8" in error


def test_without_features_there_is_nothing_to_name(tmp_path):
    write(tmp_path / "room", Room(poses=walk(2)))
    vocabulary(tmp_path)
    error = error_of("room", "--voxel-size", "0.2", "-o", "run", "--vocabulary", "five.yaml", cwd=tmp_path)
    assert "a vocabulary needs features, and no model gives some" in error


def test_two_vocabularies_have_two_names(tmp_path):
    one, other = vocabulary(tmp_path), vocabulary(tmp_path, "other", name_="five")
    other.write_text(other.read_text().replace("name_", "name"))
    with pytest.raises(ConfigError, match="two vocabularies are called 'five'"):
        vocabularies_by_name([one, other])
    with pytest.raises((ConfigError, DataError)):
        vocabularies_by_name([tmp_path / "none.yaml"])


def test_a_text_encoder_makes_embeddings(tmp_path):
    torch = pytest.importorskip("torch")
    from model_folders import tiny
    from transformers import AutoTokenizer, CLIPModel

    path = tmp_path / "words.yaml"
    encoder = {"checkpoint": str(tiny("clip")), "templates": ["a {}.", "a photo of a {}."]}
    names = ["road", {"name": "tree", "synonyms": ["bush"]}]
    path.write_text(yaml.safe_dump({"names": names, "encoder": encoder}))
    words = Vocabulary.load(path)
    clip, tokenizer = CLIPModel.from_pretrained(tiny("clip")).eval(), AutoTokenizer.from_pretrained(tiny("clip"))
    for row, word in zip(words.embeddings, ("road", "tree", "bush"), strict=True):
        with torch.inference_mode():
            parts = []
            for sentence in (f"a {word}.", f"a photo of a {word}."):
                found = clip.get_text_features(**tokenizer([sentence], return_tensors="pt")).pooler_output[0]
                parts.append(found / found.norm())
            mean = torch.stack(parts).mean(dim=0)
        assert row == pytest.approx((mean / mean.norm()).numpy(), abs=1e-5)
    assert words.of.tolist() == [0, 1, 1]
    changed = vocabularies_by_name([f"{path},without=road,add=grass,add=sky", f"{path},rename=road:street"])
    less, more = changed.values()
    assert less.space.classes == ("tree", "grass", "sky")
    assert np.array_equal(less.embeddings[:2], words.embeddings[1:])
    assert more.space.classes == ("street", "tree")
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump({"names": ["street", "grass", "sky"], "encoder": encoder}))
    expected = Vocabulary.load(other).embeddings
    assert np.stack([more.embeddings[0], *less.embeddings[2:]]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("model", "options"), [("segearth-ov", ",resize=64"), ("transformers", "")])
def test_prompts_of_a_model_with_its_own_text_encoder_are_ranked(tmp_path, model, options):
    """SegEarth-OV and CLIPSeg with two lists of prompts, called NET@PROMPTS: ranked beyond chance."""
    pytest.importorskip("torch")
    from model_folders import tiny

    write(tmp_path / "room", Room(poses=walk(4)))
    (tmp_path / "room/color").mkdir()
    rng = np.random.default_rng(0)
    for i in range(4):
        image = np.kron(rng.integers(0, 255, (9, 12, 3)), np.ones((8, 8, 1)))
        write_image(tmp_path / f"room/color/{i:03d}.png", image.astype(np.uint8))
    lists = {"few": ["road", "tree"], "many": ["road", "tree", "car", "building"]}
    words = []
    for name, prompts in lists.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({"classes": prompts, "templates": ["a {}."]}))
        value_of = f"{name}.yaml" if model == "segearth-ov" else f"[{','.join(prompts)}]"
        checkpoint = tiny("clip" if model == "segearth-ov" else "clipseg")
        words += ["--predict", f"{model},checkpoint={checkpoint},prompts={value_of},name=net@{name}{options}"]
    screen = bench("room", "--voxel-size", "0.2", "-o", "run", "--no-truth", *words, cwd=tmp_path).stdout
    from semstab.comparison.ranking import rank_models

    result = semstab.load_result(tmp_path / "run")
    assert [*result.models] == ["net@few", "net@many"]
    for name, prompts in lists.items():
        assert len(prompts) == result.record(model=f"net@{name}").map_summary.K
    (difference,) = rank_models(result).differences
    assert {difference.model, difference.other} == {"net@few", "net@many"}
    assert difference.low < difference.value < difference.high
    assert "net@many: 4 names, worth" in screen
