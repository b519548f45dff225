"""Models whose labels depend on the frames before: shown the selected frames in order, on disk and inside a run."""

from __future__ import annotations

import itertools
import json

import numpy as np
import predicted_scene
import pytest
from PIL import Image
from posed_config import dataset_of

from semstab import LabelSpace
from semstab.api import run
from semstab.config import Config, FrameSelection
from semstab.configure import predicted_config, resolve
from semstab.datasets import open_dataset
from semstab.datasets.formats.images import read_labels
from semstab.errors import ConfigError, DataError
from semstab.models import Model, Prediction
from semstab.models.names import InTaxonomy
from semstab.predict.command import ImageFiles
from semstab.predict.predictor import PredictorConfig
from semstab.predict.sequence import SequenceOptions, predict_sequence


class Average(Model):
    """Dark, middle or bright by the average of all images so far, in which the last one counts half."""

    label_space = LabelSpace("brightness", ("dark", "middle", "bright"))
    sequential = True

    def __init__(self, fails_at=None):
        self.mean, self.seen, self.fails_at = None, 0, fails_at

    def reset(self):
        self.mean = None

    def predict(self, images, *, scores=False):
        return [self.one(image.mean(axis=2)) for image in images]

    def one(self, grey):
        self.seen += 1
        if self.seen == self.fails_at:
            raise DataError("out of memory")
        self.mean = grey if self.mean is None else (self.mean + grey) / 2
        return Prediction(np.digitize(self.mean, (85, 170)).astype(np.uint8))

    def identity(self):
        return {"average": 0.5}


@pytest.fixture
def scene(tmp_path):
    return predicted_scene.write(tmp_path / "flight")


def expected(frames, images=predicted_scene.image):
    model = Average()
    return {k: model.predict([images(k)])[0].labels for k in frames}


def predict(folder, model, indices=range(6), **options):
    opened = open_dataset("posed_folder", {"root": str(folder)}).scene("flight")
    return predict_sequence(opened, model, indices, folder, SequenceOptions("average", **options))


def assert_stored(folder, labels):
    for k, wanted in labels.items():
        np.testing.assert_array_equal(read_labels(folder / f"labels/average/{k:03d}.png"), wanted)


# --- On disk ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [1, 4])
def test_frames_come_in_order_from_the_first(scene, batch):
    model = Average()
    model.predict([predicted_scene.image(5)])  # of another sequence
    predict(scene, model, batch=batch)
    assert_stored(scene, expected(range(6)))


def test_what_was_stopped_goes_on_as_if_it_had_not_been(scene):
    with pytest.raises(DataError, match="out of memory"):
        predict(scene, Average(fails_at=4))
    model = Average()
    report = predict(scene, model)
    assert (report.predicted, report.reused, model.seen) == (6, 0, 6)
    assert_stored(scene, expected(range(6)))
    model = Average()
    assert (predict(scene, model).reused, model.seen) == (6, 0)


def test_an_image_that_changed_changes_what_follows_even_where_that_was_stopped(scene):
    predict(scene, Average())
    Image.fromarray(predicted_scene.image(2, seed=9)).save(scene / "color/002.png")
    with pytest.raises(DataError, match="out of memory"):
        predict(scene, Average(fails_at=5))
    predict(scene, Average())
    assert_stored(scene, expected(range(6), lambda k: predicted_scene.image(k, seed=9 if k == 2 else 0)))


def test_another_selection_is_another_setting(scene):
    predict(scene, Average(), range(0, 6, 2))
    said = r"other settings \(frames: \"3 from 000 to 004 .*there, \"6 from 000 to 005 .*here"
    with pytest.raises(ConfigError, match=said):
        predict(scene, Average())
    predict(scene, Average(), overwrite=True)
    assert_stored(scene, expected(range(6)))


# --- Depth and pose ---------------------------------------------------------------------------------------------------


class Looking(Average):
    """Keeps what it is shown of depth and pose."""

    wants_geometry = True

    def __init__(self):
        super().__init__()
        self.shown = []

    def predict(self, images, *, scores=False, geometry=()):
        self.shown += geometry
        return super().predict(images)


def test_depth_and_pose_come_at_the_images_pixels(tmp_path):
    folder = predicted_scene.write(tmp_path / "flight", depth_scale=2)
    depth = np.asarray(Image.open(folder / "depth/003.png")).copy()
    depth[3, 7] = 0
    Image.fromarray(depth).save(folder / "depth/003.png")
    model = Looking()
    predict(folder, model, batch=4)
    assert [frame.shape for frame in model.shown] == [(48, 80)] * 6
    for k, frame in enumerate(model.shown):
        assert frame.T_wc[0, 3] == pytest.approx(0.1 * k)
        assert frame.intrinsics == predicted_scene.frame(k, 1).intrinsics
    holes = np.argwhere(model.shown[3].depth == 0)
    np.testing.assert_array_equal(holes, [(6, 14), (6, 15), (7, 14), (7, 15)])
    assert (model.shown[2].depth == 2).all()


def test_a_pose_that_changed_is_predicted_again(scene):
    predict(scene, Looking())
    pose = np.loadtxt(scene / "pose/004.txt")
    pose[0, 3] += 0.01
    np.savetxt(scene / "pose/004.txt", pose)
    assert predict(scene, Looking()).predicted == 6


def test_single_images_have_no_depth(scene, tmp_path):
    files = ImageFiles(str(scene / "color/*.png"))
    with pytest.raises(ConfigError, match="looks at depth and pose, which single images do not have; use --data"):
        predict_sequence(files, Looking(), range(6), tmp_path / "out", SequenceOptions("x"))


def test_a_taxonomy_leaves_a_model_sequential():
    model = InTaxonomy(Looking(), LabelSpace("two", ("dark", "bright"), members=(("middle",), ())), "strict")
    model = model.fit([])
    assert (model.sequential, model.wants_geometry) == (True, True)
    frame = predicted_scene.frame(0, 1)
    for _ in range(2):
        model.reset()
        found = model.predict([predicted_scene.image(0)], geometry=[frame])[0].labels
        np.testing.assert_array_equal(found, expected([0])[0] == 2)


# --- Inside a run -----------------------------------------------------------------------------------------------------


@pytest.fixture
def live(monkeypatch):
    """Opens a scene whose labels an average predicts; all scenes of one dataset share the model."""
    monkeypatch.setattr("semstab.predict.dataset.create", lambda name, **options: Average())

    def open_it(root, name="flight", **settings):
        config = resolve(live_config(root, **settings))
        return open_dataset("predicted", config.dataset.options).scene(name)

    return open_it


def live_config(root, **settings) -> Config:
    settings = {"dataset": dataset_of(root), "voxel_size": 0.25, "backends": ["numpy"], "check": None, **settings}
    return predicted_config([PredictorConfig(model="colour-clusters", name="average")], None, settings)


def test_whichever_frame_is_asked_for(scene, live):
    wanted = expected([0, 2, 4])
    for order in itertools.permutations([0, 2, 4]):
        opened = live(scene, frames={"stride": 2})
        for k in order:
            np.testing.assert_array_equal(opened.frame(k, "average").labels, wanted[k])


def test_frames_that_are_long_past_are_reached_again(scene, live):
    opened, wanted = live(scene), expected(range(6))
    for k in (5, 0, 3):
        np.testing.assert_array_equal(opened.frame(k, "average").labels, wanted[k])


def test_scenes_share_a_model_but_no_memory(tmp_path, monkeypatch, live):
    for name in ("flight", "other"):
        predicted_scene.write(tmp_path / name)
    dataset = open_dataset("predicted", resolve(live_config(tmp_path)).dataset.options)
    flight, other = dataset.scene("flight"), dataset.scene("other")
    wanted = expected(range(6))
    for k in range(6):
        for opened in (flight, other):
            np.testing.assert_array_equal(opened.frame(k, "average").labels, wanted[k])


def test_a_frame_that_it_is_not_shown_cannot_be_asked_for(scene, live):
    opened = live(scene, frames={"stride": 2})
    for asked in (lambda: opened.frame(3, "average"), lambda: opened.digest([0, 3], "average")):
        with pytest.raises(ConfigError, match="frame 3 is not among the 3 frames that a sequential model is shown"):
            asked()


def test_what_a_unit_depends_on_are_all_frames_before(scene, live):
    before = live(scene).digest([3], "average")
    assert live(scene).digest([3], "average") == before
    assert live(scene, frames={"stride": 3}).digest([3], "average") != before
    Image.fromarray(predicted_scene.image(5, seed=9)).save(scene / "color/005.png")
    assert live(scene).digest([3], "average") == before
    Image.fromarray(predicted_scene.image(0, seed=9)).save(scene / "color/000.png")
    assert live(scene).digest([3], "average") != before


def test_live_and_by_way_of_the_disk_are_the_same(scene, live):
    frames = {"stride": 2, "start": 1}
    (found,) = run(live_config(scene, frames=frames), report=False).runs
    predict(scene, Average(), FrameSelection(**frames).indices(6))
    (stored,) = run(
        Config(dataset=dataset_of(scene), frames=frames, voxel_size=0.25, backends=["numpy"], check=None), report=False
    ).runs
    assert found.map_summary == stored.map_summary
    assert found.flicker_percent == stored.flicker_percent


def test_a_run_says_what_it_was_shown(scene, live, tmp_path):
    config = live_config(scene, frames={"stride": 2})
    run(config, out=tmp_path / "run", report=False)
    import yaml

    said = yaml.safe_load((tmp_path / "run/config.yaml").read_text())
    assert said["dataset"]["options"]["frames"]["stride"] == 2
    said["frames"] = {**said["frames"], "stride": 3}
    again = Config.build({key: value for key, value in said.items() if key != "schema"})
    (found,) = run(again, out=tmp_path / "run", report=False, overwrite=True).runs
    assert found.unit.model == "average"
    assert json.loads((tmp_path / "run/summary.json").read_text())["runs"][0]["frames"] == 2
