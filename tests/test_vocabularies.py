"""Vocabularies over features: the labels that they give, their ranking in one run, and what bad ones say."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from command_line import bench, error_of
from room_scene import CLASSES, Room, walk, write

import semstab
from semstab.core.files import write_image
from semstab.data.features import Features
from semstab.errors import ConfigError, DataError
from semstab.predict.vocabulary import Vocabulary
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
    files = {each.unit.model: each.observations_file for each in semstab.load_result(tmp_path / "run").select()}
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
    error = error_of("room", "--voxel-size", "0.2", "-o", "run", "--vocabulary", "five.yaml", cwd=tmp_path)
    assert "embeddings have 5 components, and features 8" in error


def test_without_features_there_is_nothing_to_name(tmp_path):
    write(tmp_path / "room", Room(poses=walk(2)))
    vocabulary(tmp_path)
    error = error_of("room", "--voxel-size", "0.2", "-o", "run", "--vocabulary", "five.yaml", cwd=tmp_path)
    assert "a vocabulary needs features, and no model gives some" in error


def test_two_vocabularies_have_two_names(tmp_path):
    from semstab.predict.vocabulary import named

    one, other = vocabulary(tmp_path), vocabulary(tmp_path, "other", name_="five")
    other.write_text(other.read_text().replace("name_", "name"))
    with pytest.raises(ConfigError, match="two vocabularies are called 'five'"):
        named([one, other])
    with pytest.raises((ConfigError, DataError)):
        named([tmp_path / "none.yaml"])


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
