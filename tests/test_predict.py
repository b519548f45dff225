"""Models over sequences: what is left on disk, what is kept, what is refused; and predictions inside a run."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import json
import math
import re
from pathlib import Path

import numpy as np
import predicted_scene
import pytest
import yaml
from command_line import bench, error_of
from PIL import Image
from posed_config import configure, dataset_of

from semstab import LabelSpace
from semstab.api import run
from semstab.config import Config, DatasetConfig, FrameSelection
from semstab.configure import predicted_config
from semstab.core.files import FolderLock
from semstab.data.measures import ENTROPY
from semstab.data.results import slug
from semstab.datasets import open_dataset
from semstab.datasets.formats.images import read_labels
from semstab.datasets.scene import select_frames
from semstab.errors import ConfigError, DataError
from semstab.metrics import matched_region_flicker
from semstab.models import Model, Prediction, Streamed, create, options_model
from semstab.models.names import InTaxonomy
from semstab.models.validation import Checked
from semstab.pixels.warp import warp
from semstab.predict.command import ImageFiles, file_job, scene_jobs
from semstab.predict.folder import names_a_folder
from semstab.predict.predictor import PredictorConfig, load_predictor, parse_predictor, parse_predictors
from semstab.predict.sequence import PredictionObserver, SequenceOptions, predict_sequence
from semstab.report.terminal import screen

CLUSTERS = {"clusters": 4, "samples": 500, "fit_frames": 2}


@pytest.fixture
def scene(tmp_path):
    return predicted_scene.write(tmp_path / "flight")


def images_of(folder: Path, **options):
    dataset = open_dataset("posed_folder", {"root": str(folder), **options})
    return dataset.scene(dataset.scenes[0])


def clusters(**options):
    return create("colour-clusters", **{**CLUSTERS, **options})


def predict(folder: Path, model=None, indices=range(6), out=None, observers=(), **options):
    options = SequenceOptions(**{"name": "clusters", **options})
    return predict_sequence(images_of(folder), model or clusters(), indices, out or folder, options, observers)


def manifest(folder: Path) -> dict:
    return json.loads((folder / "predictions.json").read_text())


class Shifting(Model):
    """A model with known output: the label is the column modulo 3; scores say so; it counts what it sees."""

    label_space = LabelSpace("thirds", ("a", "b", "c"))
    gives_scores = True
    fit_frames = 0

    def __init__(self, setting=1, fails_at=None):
        self.setting = setting
        self.fails_at = fails_at
        self.seen = []

    def fit(self, images):
        return self

    def predict(self, images, *, scores=False):
        self.seen.append(len(images))
        if self.fails_at is not None and sum(self.seen) > self.fails_at:
            raise DataError("out of paint")
        labels = np.tile((np.arange(images[0].shape[1]) % 3).astype(np.uint8), (images[0].shape[0], 1))
        soft = np.eye(3, dtype=np.float32)[labels] if scores else None
        return [Prediction(labels, soft)] * len(images)

    def identity(self):
        return {"setting": self.setting}


# --- What is left on disk ---------------------------------------------------------------------------------------------


def test_labels_lie_where_a_run_reads_them(scene):
    report = predict(scene)
    assert (report.predicted, report.reused, report.sequence) == (6, 0, "flight")
    assert report.folders == (scene / "labels" / "clusters",)
    opened = open_dataset("posed_folder", {"root": scene}).scene("flight")
    assert opened.models == ("clusters",)
    assert opened.label_space("clusters").classes == ("cluster 0", "cluster 1", "cluster 2", "cluster 3")
    fitted = clusters().fit([predicted_scene.image(k) for k in range(2)])
    for k in range(6):
        expected = fitted.predict([predicted_scene.image(k)])[0].labels
        np.testing.assert_array_equal(opened.frame(k, "clusters").labels, expected)


def test_scores_lie_beside_them(scene):
    report = predict(scene, scores=True, indices=[3])
    assert report.folders == (scene / "labels" / "clusters", scene / "scores" / "clusters")
    opened = open_dataset("posed_folder", {"root": scene}).scene("flight")
    frame = opened.frame(3, "clusters-scores")
    assert frame.scores.dtype == np.float16
    assert opened.label_space("clusters-scores") == opened.label_space("clusters")
    fitted = clusters().fit([predicted_scene.image(k) for k in range(2)])
    (expected,) = fitted.predict([predicted_scene.image(3)], scores=True)
    np.testing.assert_allclose(frame.scores, expected.scores, atol=1e-3)
    np.testing.assert_array_equal(opened.frame(3, "clusters").labels, expected.labels)


def test_scores_in_full_precision(scene):
    predict(scene, Shifting(), scores=True, indices=[0], score_type="float32")
    with np.load(scene / "scores/clusters/000.npz") as file:
        assert file["scores"].dtype == np.float32
        assert file["scores"].shape == (3, 48, 80)


class Streaming(Shifting):
    """Says how many maps it has given; scores of a pixel are 3/6, 2/6, 1/6 from its label on."""

    streams = True
    shares = np.float32([3, 2, 1]) / 6

    def __init__(self):
        super().__init__()
        self.given = 0

    def soft(self, labels, k):
        return self.shares[(k - labels.astype(int)) % 3]

    def predict(self, images, *, scores=False):
        (prediction, *_) = super().predict(images)
        soft = np.dstack([self.soft(prediction.labels, k) for k in range(3)])
        return [Prediction(prediction.labels, soft if scores else None)] * len(images)

    def stream(self, image):
        (prediction,) = self.predict([image])

        def maps():
            for k in range(3):
                self.given += 1
                yield self.soft(prediction.labels, k)

        return Streamed(prediction.labels, maps)


@pytest.mark.parametrize("depth_scale", [1, 2])
@pytest.mark.parametrize("inside", [False, True])
def test_scores_that_are_many_go_to_disk_class_by_class(tmp_path, monkeypatch, depth_scale, inside):
    folder = predicted_scene.write(tmp_path / "flight", frames=1, depth_scale=depth_scale)
    space = LabelSpace("two", ("ab", "c"), members=(("a", "b"), ()))
    stored = []
    for size in (1 << 28, 0):
        monkeypatch.setattr("semstab.predict.sequence.SCORE_BYTES", size)
        inner = Streaming()
        model = InTaxonomy(Checked(inner, "mine"), space, "strict") if inside else Checked(inner, "mine")
        predict(folder, model, indices=[0], scores=True, name=f"x{size}", score_type="float32")
        with np.load(folder / f"scores/x{size}/000.npz") as file:
            stored.append(file["scores"])
        assert inner.given == (0 if size else 3)
    np.testing.assert_array_equal(stored[0], stored[1])
    assert stored[0].shape == (2 if inside else 3, 48 // depth_scale, 80 // depth_scale)
    np.testing.assert_allclose(stored[0].sum(0), 1, atol=1e-5)


@pytest.mark.parametrize(("count", "largest"), [(1, [3]), (2, [2, 3]), (3, [1, 2, 3])])
def test_only_the_largest_scores_are_kept(scene, count, largest):
    predict(scene, Streaming(), indices=[0], scores=True, top_k=count, score_type="float32")
    with np.load(scene / "scores/clusters/000.npz") as file:
        scores = np.sort(6 * file["scores"][:, 5, 7])
    np.testing.assert_allclose(scores, [0] * (3 - count) + largest, atol=1e-6)
    assert manifest(scene / "scores/clusters")["settings"]["top_k"] == count
    with pytest.raises(ConfigError, match=r"other settings \(top_k: "):
        predict(scene, Streaming(), indices=[0], scores=True, score_type="float32")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda k: np.zeros((3, 3), np.float32), r"gave scores of shape \(3, 3\) or below 0"),
        (lambda k: np.full((48, 80), k - 1, np.float32), "or below 0"),
        (lambda k: np.full((48, 80), 0.5, np.float32), "gave 3 maps of scores that do not sum to 1"),
    ],
)
def test_scores_class_by_class_are_looked_at_too(monkeypatch, wrong, message):
    inner = Streaming()
    monkeypatch.setattr(inner, "soft", lambda labels, k: wrong(k))
    found = Checked(inner, "mine").stream(predicted_scene.image(0))
    with pytest.raises(DataError, match=message):
        list(found.maps())


def test_the_manifest_says_what_the_maps_depend_on(scene):
    predict(scene, batch=2, command=["semstab-bench", "predict"])
    said = manifest(scene / "labels/clusters")
    assert said["settings"]["clusters"] == 4
    assert said["command"] == ["semstab-bench", "predict"]
    assert said["packages"]["numpy"] == np.__version__
    assert sorted(said["frames"]) == [f"{k:03d}" for k in range(6)]
    assert len({frame["image"] for frame in said["frames"].values()}) == 6


def test_the_first_frames_of_the_sequence_make_the_codebook_whatever_is_selected(scene, tmp_path):
    predict(scene, indices=[4, 5], out=tmp_path / "some")
    predict(scene, out=tmp_path / "all")
    a, b = (read_labels(tmp_path / out / "labels/clusters/005.png") for out in ("some", "all"))
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("batch", "sizes"), [(1, [1] * 6), (4, [4, 2]), (10, [6])])
def test_batches(scene, batch, sizes):
    model = Shifting()
    predict(scene, model, batch=batch)
    assert model.seen == sizes


def test_a_batch_has_images_of_one_size(tmp_path):
    for k, width in enumerate((8, 8, 9, 9, 9, 8)):
        Image.fromarray(np.zeros((6, width, 3), dtype=np.uint8)).save(tmp_path / f"{k}.png")
    model = Shifting()
    predict_sequence(ImageFiles(str(tmp_path / "*.png")), model, range(6), tmp_path, SequenceOptions("x", batch=4))
    assert model.seen == [2, 3, 1]
    assert read_labels(tmp_path / "labels/x/2.png").shape == (6, 9)


# --- Going on, and not mixing -----------------------------------------------------------------------------------------


def test_finished_frames_are_kept(scene):
    predict(scene, Shifting(), indices=range(4))
    model = Shifting()
    report = predict(scene, model)
    assert (report.predicted, report.reused, model.seen) == (2, 4, [1, 1])


def test_what_was_finished_before_an_error_is_kept(scene):
    with pytest.raises(DataError, match="out of paint"):
        predict(scene, Shifting(fails_at=3))
    assert sorted(manifest(scene / "labels/clusters")["frames"]) == ["000", "001", "002"]
    assert (predict(scene, Shifting()).predicted, len(list((scene / "labels/clusters").glob("*.png")))) == (3, 6)


def test_predictions_killed_at_their_birth_go_on(scene, monkeypatch):
    class KilledError(BaseException):
        pass

    def killed(*_):
        raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr("semstab.predict.folder.write_json", killed)
        with pytest.raises(KilledError):
            predict(scene, Shifting())
    (scene / "labels/clusters/.semstab-ab12cd34.png").write_bytes(b"half")
    assert predict(scene, Shifting()).predicted == 6
    assert not list(scene.rglob(".*"))


def test_predictions_belong_to_one_process(scene):
    held = FolderLock(scene / "labels/x")
    with pytest.raises(ConfigError, match="labels/x: another process works on it"):
        predict(scene, Shifting(), name="x")
    held.release()
    assert predict(scene, Shifting(), name="x").predicted == 6


def test_an_image_that_changed_is_predicted_again(scene):
    predict(scene, Shifting())
    Image.fromarray(predicted_scene.image(2, seed=9)).save(scene / "color/002.png")
    assert (predict(scene, Shifting()).predicted, predict(scene, Shifting()).predicted) == (1, 0)


def test_a_map_that_was_deleted_is_predicted_again(scene):
    predict(scene, Shifting())
    (scene / "labels/clusters/004.png").unlink()
    assert predict(scene, Shifting()).predicted == 1


def test_scores_that_are_wanted_later_are_predicted(scene):
    predict(scene, Shifting())
    report = predict(scene, Shifting(), scores=True)
    assert (report.predicted, report.reused) == (6, 0)


def test_other_settings_do_not_mix(scene):
    predict(scene, Shifting(setting=1), indices=[0, 1, 2])
    message = (
        r"labels/clusters: holds predictions with other settings \(setting: 1 there, 2 here\); choose another --name"
    )
    with pytest.raises(ConfigError, match=message):
        predict(scene, Shifting(setting=2), indices=[0])
    assert len(list((scene / "labels/clusters").glob("*.png"))) == 3
    predict(scene, Shifting(setting=2), indices=[0], overwrite=True)
    assert [file.name for file in (scene / "labels/clusters").glob("*.png")] == ["000.png"]


def test_another_codebook_is_another_setting(scene):
    predict(scene)
    Image.fromarray(predicted_scene.image(0, seed=9)).save(scene / "color/000.png")
    with pytest.raises(ConfigError, match=r"other settings \(codebook: "):
        predict(scene)


def test_maps_of_others_are_not_touched(scene):
    (scene / "labels/clusters").mkdir(parents=True)
    (scene / "labels/clusters/000.png").write_bytes(b"theirs")
    with pytest.raises(ConfigError, match="holds maps that were not predicted here; choose another --name"):
        predict(scene, overwrite=True)
    assert (scene / "labels/clusters/000.png").read_bytes() == b"theirs"


def test_a_damaged_manifest_is_said(scene):
    predict(scene)
    (scene / "labels/clusters/predictions.json").write_text("[]")
    with pytest.raises(DataError, match="is no manifest of predictions; delete the folder"):
        predict(scene)


def test_observers_see_every_frame(scene):
    class Counter(PredictionObserver):
        def __init__(self):
            self.said = []

        def sequence_started(self, name, frames):
            self.said.append((name, frames))

        def frame_done(self, image, seconds):
            self.said.append((image.name, math.isnan(seconds)))

    predict(scene, Shifting(), indices=[0, 2])
    counter = Counter()
    predict(scene, Shifting(), indices=range(3), observers=[counter])
    assert counter.said == [("flight", 3), ("000", True), ("001", False), ("002", True)]


# --- Images -----------------------------------------------------------------------------------------------------------


def test_image_files_come_in_natural_order(tmp_path):
    for name in ("b2.png", "b10.png", "a.jpg", "note.txt"):
        Image.fromarray(np.zeros((4, 5, 3), dtype=np.uint8)).save(
            tmp_path / name, format="PNG" if "png" in name else "JPEG"
        )
    files = ImageFiles(str(tmp_path / "*"))
    assert [files.image_name(k) for k in range(len(files))] == ["a", "b2", "b10"]
    assert files.image(0).shape == (4, 5, 3)


@pytest.mark.parametrize(
    ("names", "message"), [((), "no image of .png"), (("x/1.png", "y/1.png"), "has the same name")]
)
def test_image_files_that_cannot_be_used(tmp_path, names, message):
    for name in names:
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(DataError, match=message):
        ImageFiles(str(tmp_path / "**/*.png"))


def test_image_files_need_a_place_for_their_predictions(tmp_path):
    with pytest.raises(ConfigError, match="name it with --out"):
        file_job("*.png", FrameSelection(), None)


def test_predictions_of_a_larger_image_have_the_depths_pixels(tmp_path):
    folder = predicted_scene.write(tmp_path / "small", depth_scale=2)
    predict(folder, Shifting(), indices=[0], scores=True)
    labels = read_labels(folder / "labels/clusters/000.png")
    assert labels.shape == (24, 40)
    columns = np.arange(80) % 3
    assert all(labels[0, x] in (columns[2 * x], columns[2 * x + 1]) for x in range(40))
    with np.load(folder / "scores/clusters/000.npz") as file:
        scores = file["scores"]
    assert scores.shape == (3, 24, 40)
    halves = (np.eye(3)[columns[0::2]] + np.eye(3)[columns[1::2]]) / 2
    np.testing.assert_allclose(scores[:, 5], halves.T, atol=1e-3)


def test_an_image_of_another_view_is_refused(scene):
    Image.fromarray(np.zeros((48, 60, 3), dtype=np.uint8)).save(scene / "color/001.png")
    with pytest.raises(DataError, match=r"color/001.png: the image is 60x48 but depth is 80x48, another view"):
        predict(scene, Shifting(), indices=[1])


def test_frames_without_colour_are_named(scene):
    (scene / "color/003.png").unlink()
    with pytest.raises(DataError, match=r"1 missing: .*color/003.png; add them, or set incomplete: skip"):
        select_frames(images_of(scene), FrameSelection(), color=True)
    assert select_frames(images_of(scene, incomplete="skip"), FrameSelection(), color=True).indices == [0, 1, 2, 4, 5]


def test_label_maps_that_are_incomplete_do_not_matter(scene):
    predict(scene, Shifting(), indices=[0], name="other")
    assert len(images_of(scene)) == 6


def test_scenes_of_other_datasets(tmp_path):
    city = DatasetConfig(name="city", options={"width": 64, "height": 36, "frames": 2})
    with pytest.raises(ConfigError, match="scene0: has no folder of its own; name one for its predictions with --out"):
        scene_jobs(city, ["scene0"], FrameSelection(), None)
    jobs = scene_jobs(city, ["scene0", "scene1"], FrameSelection(), tmp_path)
    assert [job.out for job in jobs] == [tmp_path / "scene0", tmp_path / "scene1"]
    (job,) = scene_jobs(city, ["scene0"], FrameSelection(stop=1), tmp_path)
    assert (job.out, job.indices) == (tmp_path, [0])
    predict_sequence(job.sequence, Shifting(), job.indices, job.out, SequenceOptions("x"))
    assert read_labels(tmp_path / "labels/x/000000.png").shape == (36, 64)
    with pytest.raises(ConfigError, match="no scene 'scene9'; there is scene0"):
        scene_jobs(city, ["scene9"], FrameSelection(), tmp_path)
    with pytest.raises(ConfigError, match="leaves none of its 2"):
        scene_jobs(city, ["scene0"], FrameSelection(start=5), tmp_path)


def test_readers_of_other_formats_show_their_images_without_labels(tmp_path, scene):
    """The same flight as DeepVideoMVS writes it, with depth of half the size."""
    flight = tmp_path / "dvmvs" / "flight"
    for part in ("images", "depth"):
        (flight / part).mkdir(parents=True)
    small = predicted_scene.write(tmp_path / "small", depth_scale=2)
    poses = [np.loadtxt(file).ravel() for file in sorted((scene / "pose").iterdir())]
    np.savetxt(flight / "poses.txt", poses)
    np.savetxt(flight / "K.txt", np.loadtxt(small / "intrinsics.txt"))
    for k in range(6):
        (flight / f"images/{k:03d}.png").write_bytes((scene / f"color/{k:03d}.png").read_bytes())
        (flight / f"depth/{k:03d}.png").write_bytes((small / f"depth/{k:03d}.png").read_bytes())
    dataset = DatasetConfig(name="hololens", options={"root": str(tmp_path / "dvmvs")})
    (job,) = scene_jobs(dataset, None, FrameSelection(), None)
    predict_sequence(job.sequence, Shifting(), job.indices, job.out, SequenceOptions("thirds"))
    assert read_labels(flight / "labels/thirds/003.png").shape == (48, 80)
    opened = open_dataset("hololens", dataset.options)
    stored = opened.scene(opened.scenes[0])
    assert stored.label_space("thirds").classes == ("a", "b", "c")
    predict_sequence(job.sequence, Tiles(), job.indices, job.out, SequenceOptions("tiles"))
    stored = open_dataset("hololens", dataset.options).scene(opened.scenes[0])
    assert (stored.models, stored.regions) == (("thirds",), ("tiles",))
    assert stored.frame(3, "tiles").labels[0, :8].tolist() == [1] * 5 + [2] * 3
    with pytest.raises(ConfigError, match="'tiles' holds regions without classes"):
        stored.label_space("tiles")
    live = job.sequence.predicted(3, labels=Shifting().predict([predicted_scene.image(3)])[0].labels)
    np.testing.assert_array_equal(live.labels, stored.frame(3, "thirds").labels)
    assert live.labels.shape == (24, 40)


# --- Regions without classes ------------------------------------------------------------------------------------------


class Tiles(Shifting):
    """Regions of 16 columns that stay on the wall while the camera moves 2 pixels a frame."""

    label_space = None
    gives_scores = False

    def predict(self, images, *, scores=False):
        frames = {predicted_scene.image(k).tobytes(): k for k in range(6)}
        shifts = [2 * frames[image.tobytes()] for image in images]
        return [Prediction(np.tile(((np.arange(80) + s) // 16 + 1).astype(np.uint16), (48, 1))) for s in shifts]


def test_regions_are_not_labels_and_come_with_their_changes(scene):
    report = predict(scene, Tiles())
    assert report.folders == (scene / "regions" / "clusters",)
    assert not (scene / "labels").exists()
    regions = [read_labels(scene / f"regions/clusters/{k:03d}.png") for k in range(6)]
    assert regions[0].dtype == np.uint16
    plain = [matched_region_flicker(a, b) for a, b in itertools.pairwise(regions)]
    assert report.regions.plain == tuple(plain)
    assert report.regions.flicker_percent == pytest.approx(np.mean([change.flicker_percent for change in plain]))
    assert report.regions.flicker_percent > 5
    assert report.regions.compensated_flicker_percent == 0  # the regions stay on the wall
    rows = list(csv.DictReader((scene / "regions/clusters/changes.csv").read_text().splitlines()))
    assert len(rows) == 10
    assert (rows[0]["kind"], rows[0]["previous"], rows[0]["frame"]) == ("plain", "000", "001")
    assert float(rows[0]["flicker_percent"]) == pytest.approx(plain[0].flicker_percent)


def test_region_changes_with_camera_motion_taken_out(scene):
    predict(scene, Tiles(), indices=[0, 3])
    report = predict(scene, Tiles(), indices=[0, 3])
    assert report.reused == 2
    images = images_of(scene)
    a, b = (images.predicted(k, labels=read_labels(scene / f"regions/clusters/{k:03d}.png")) for k in (0, 3))
    brought, visible = warp(a.labels, a, b)
    assert report.regions.compensated == (matched_region_flicker(brought, b.labels, visible),)
    assert visible.mean() == pytest.approx(1 - 6 / 80)


def test_regions_are_read_by_name_and_never_fused(scene):
    predict(scene, Tiles(), name="tiles")
    predict(scene, Shifting(), name="thirds")
    opened = open_dataset("posed_folder", {"root": scene}).scene("flight")
    assert (opened.models, opened.regions) == (("thirds",), ("tiles",))
    np.testing.assert_array_equal(opened.frame(2, "tiles").labels, read_labels(scene / "regions/tiles/002.png"))
    with pytest.raises(ConfigError, match="'tiles' holds regions without classes, which cannot be fused"):
        opened.label_space("tiles")
    dataset = DatasetConfig(name="posed_folder", options={"root": str(scene)})
    (found,) = run(Config(dataset=dataset, voxel_size=0.25, check=None), report=False).runs
    assert found.unit.model == "thirds"
    predict(scene, Shifting(), name="tiles")
    with pytest.raises(DataError, match=r"regions/tiles: .*labels/tiles is called 'tiles' too; rename one"):
        open_dataset("posed_folder", {"root": scene}).scene("flight")


def test_regions_that_lack_frames_stop_nobody_else(scene):
    predict(scene, Tiles(), name="tiles", indices=[0, 1])
    predict(scene, Shifting(), name="thirds")
    opened = open_dataset("posed_folder", {"root": scene}).scene("flight")
    assert len(opened) == 6
    with pytest.raises(DataError, match=r"4 missing: .*regions/tiles/002.png.*choose frames that have them"):
        opened.frame(2, "tiles")


def test_a_study_measures_regions_by_name(scene):
    from semstab.engine.units import make_plan

    predict(scene, Tiles(), name="tiles")
    predict(scene, Shifting(), name="thirds")
    grid = make_plan(configure(scene, region_maps=["tiles"]))
    assert [cell.name.model for cell in grid.regions] == ["tiles"]
    assert {cell.name.model for cell in grid.units} == {"thirds"}


def test_regions_of_single_images_have_no_camera(scene, tmp_path):
    files = ImageFiles(str(scene / "color/*.png"))
    report = predict_sequence(files, Tiles(), range(3), tmp_path, SequenceOptions("tiles"))
    assert len(report.regions.plain) == 2
    assert report.regions.compensated == ()
    assert np.isnan(report.regions.compensated_flicker_percent)


# --- What is asked for ------------------------------------------------------------------------------------------------


def test_a_predictor_in_one_word():
    found = parse_predictor("segformer,checkpoint=models/b0,image_size=[512, 896],name=b0,scores=true,taxonomy=uavid3")
    assert (found.model, found.label_name, found.scores, found.taxonomy) == ("segformer", "b0", True, "uavid3")
    assert found.options == {"checkpoint": "models/b0", "image_size": [512, 896]}
    assert parse_predictor("colour-clusters").label_name == "colour-clusters"


@pytest.mark.parametrize(
    ("texts", "names"),
    [
        (["net.py:net,scale=2.0", "net.py:net,scale=0.5"], ["net scale=2.0", "net scale=0.5"]),
        (["net.py:net", "net.py:net,scale=0.5", "own.py:other"], ["net", "net scale=0.5", "other"]),
        (["a.py:net", "b.py:net"], ["net a", "net b"]),
        (["n.py:net,weights=one/w.pt,s=1", "n.py:net,weights=two/w.pt,s=1"], ["net weights=one-w.pt", "net weights=two-w.pt"]),  # noqa: E501
        (["n.py:net,weights=x/a.pt", "n.py:net,weights=x/b.pt"], ["net weights=a.pt", "net weights=b.pt"]),
        (["net.onnx,size=[32, 64]", "net.onnx,size=[64, 96]"], ["net size=32x64", "net size=64x96"]),
        (["n.py:net,s=1,scores=true", "n.py:net,s=1"], ["net-scores", "net"]),
        (["n.py:net,s=1,name=mine", "n.py:net,s=2"], ["mine", "net"]),
        (["n.py:net,s=1,filters=[ema:0.5]", "n.py:net,s=2,filters=[ema:0.5]"], ["net-ema-0.5 s=1", "net-ema-0.5 s=2"]),
    ],
)  # fmt: skip
def test_predictors_of_one_name_are_named_after_their_difference(texts, names):
    found = [one.source_name for one in parse_predictors(texts)]
    assert found == names
    assert all(names_a_folder(name) for name in found)
    assert len({slug("scene", name) for name in found}) == len(found)


@pytest.mark.parametrize("texts", [["n.py:net,s=1", "n.py:net,s=1"], ["n.py:net,name=a", "n.py:net,name=a"]])
def test_the_same_predictor_twice_is_said(texts):
    with pytest.raises(ConfigError, match=r"two models are called '(net|a)'; give one a name: name=NAME"):
        parse_predictors(texts)


@pytest.mark.parametrize(("text", "size"), [("256x832", (256, 832)), ("256", 256), ("[256, 832]", (256, 832))])
def test_a_size_is_height_and_width(text, size):
    options = parse_predictor(f"segformer,checkpoint=b0,image_size={text}").options
    assert options_model("segformer")(**options).image_size == size
    options = parse_predictor(f"net.onnx,size={text}").options
    assert options_model("net.onnx")(**options).size == size


def test_an_option_of_a_model_may_be_called_as_one_of_ours(scene, tmp_path):
    (tmp_path / "asks.py").write_text(
        "class Net:\n    classes = ['a', 'b']\n    def __init__(self, dataset, frames=0):\n"
        "        assert (dataset, frames) == ('pascal', 3)\n"
        "    def predict(self, image):\n        return image[..., 0] * 0\n"
    )
    options = ("--set", "dataset=pascal", "--set", "frames=3", "--set", "dataset.options.incomplete=skip")
    done = bench("predict", "-m", f"{tmp_path / 'asks.py'}:Net", "--data", str(scene), *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    said = json.loads((scene / "labels/Net/predictions.json").read_text())
    assert said["settings"]["options"] == {"dataset": "pascal", "frames": 3}


def test_time_in_the_network_stands_apart_from_reading(scene, tmp_path):
    (tmp_path / "slow.py").write_text(
        "import time\nclasses = ['a', 'b']\ndef slow(image):\n    time.sleep(.3)\n    return (image[..., 0] > 99) - 0\n"
    )
    config = live_config(scene, f"{tmp_path / 'slow.py'}:slow")
    result = run(config, out=tmp_path / "run", report=False)
    (summary,) = result.runs
    seconds, frames = result.manifest["seconds"], summary.frames
    assert 290 < summary.stages_ms["network"] < 1000
    assert seconds["network"] > 0.1 * frames
    assert seconds["network"] > 2 * seconds["read"]
    (line,) = [line for line in screen(result, seconds=9.0) if line.startswith("  speed of prediction: ")]
    assert re.fullmatch(r"  speed of prediction: slow [1-3](\.\d+)? frames/s", line), line


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segformer,model", "'model' has no '='"),
        ("segformer,name=a/b", "name: it names a folder"),
        ("segformer,name=gt", "name: it names a folder"),
        ("segformer,mapping=lenient", "mapping: lenient needs a taxonomy"),
        ("segformer,mapping=loose,taxonomy=uavid3", "mapping: "),
    ],
)
def test_predictors_that_cannot_be_used(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_predictor(text)


def test_scores_of_a_model_without_any_are_refused(monkeypatch):
    monkeypatch.setattr("semstab.predict.predictor.create", lambda name, **options: Tiles())
    with pytest.raises(ConfigError, match="'x' gives labels, no scores"):
        load_predictor(PredictorConfig(model="x", scores=True))


def test_every_option_of_a_predictor_is_filled_in(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights").mkdir()
    found = PredictorConfig(model="segformer", options={"checkpoint": "weights"}).resolved()
    assert found.options["checkpoint"] == str(tmp_path / "weights")
    assert found.options["dtype"] == "float32"
    with pytest.raises(ConfigError, match="unknown setting 'chekpoint'; did you mean 'checkpoint'"):
        PredictorConfig(model="segformer", options={"checkpoint": "x", "chekpoint": "x"}).resolved()


# --- Inside a run -----------------------------------------------------------------------------------------------------


def live_config(scene: Path, *predictors: str, **overrides) -> Config:
    settings = {"dataset": dataset_of(scene), "voxel_size": 0.25, "backends": ["numba"], "check": None, **overrides}
    return predicted_config([parse_predictor(text) for text in predictors], None, settings)


PREDICTOR = "colour-clusters,clusters=4,samples=500,fit_frames=2"


def test_model_to_voxels_is_the_same_as_by_way_of_the_disk(scene):
    (live,) = run(live_config(scene, PREDICTOR), report=False).runs
    before = sorted(path for path in scene.rglob("*"))
    predict(scene, clusters())
    dataset = DatasetConfig(name="posed_folder", options={"root": str(scene)})
    (stored,) = run(Config(dataset=dataset, voxel_size=0.25, check=None), report=False).runs
    assert live.unit.model == "colour-clusters"
    assert live.map_summary == stored.map_summary
    assert live.flicker_percent == stored.flicker_percent
    assert not [path for path in before if "labels" in path.parts]


def test_a_run_with_predictions_is_kept_and_reproduced(scene, tmp_path):
    config = live_config(scene, PREDICTOR)
    first = run(config, out=tmp_path / "run", report=False)
    again = Config.build(yaml.safe_load((tmp_path / "run/config.yaml").read_text()))
    assert run(again, out=tmp_path / "run", report=False).runs[0].map_summary == first.runs[0].map_summary
    before = {path.name for path in (tmp_path / "run/units").iterdir()}
    Image.fromarray(predicted_scene.image(5, seed=9)).save(scene / "color/005.png")
    run(config, out=tmp_path / "run", report=False)
    assert {path.name for path in (tmp_path / "run/units").iterdir()} > before


def test_labels_and_scores_of_several_models(scene):
    found = run(
        live_config(scene, PREDICTOR, f"{PREDICTOR},scores=true", f"{PREDICTOR},seed=3,name=other"), report=False
    )
    assert [unit.unit.model for unit in found.runs] == ["colour-clusters", "colour-clusters-scores", "other"]
    hard, soft, _ = (unit.map_summary for unit in found.runs)
    assert soft[ENTROPY] > hard[ENTROPY]


def test_the_ground_truth_stays_what_it_is(scene):
    (scene / "scene.yaml").write_text("classes: [left, right]\n")
    (scene / "labels/gt").mkdir(parents=True)
    for k in range(6):
        Image.fromarray(np.tile((np.arange(80) >= 40).astype(np.uint8), (48, 1))).save(scene / f"labels/gt/{k:03d}.png")
    predicted = open_dataset("predicted", live_config(scene, PREDICTOR).dataset.options).scene("flight")
    truth = open_dataset("posed_folder", {"root": scene}).scene("flight")
    np.testing.assert_array_equal(predicted.frame(2, "gt").labels, truth.frame(2, "gt").labels)
    assert predicted.label_space("gt") == truth.label_space("gt")
    assert predicted.digest([2], "gt") == truth.digest([2], "gt")
    assert (predicted.models, predicted.ground_truth, len(predicted)) == (("colour-clusters",), True, 6)


def test_the_digest_is_of_model_and_images(scene):
    def digest(*predictors):
        dataset = open_dataset("predicted", live_config(scene, *predictors).dataset.options)
        opened = dataset.scene("flight")
        return opened.digest([0, 1], opened.models[0])

    usual = digest(PREDICTOR)
    assert digest(PREDICTOR) == usual
    assert digest(f"{PREDICTOR},seed=3") != usual
    assert digest(f"{PREDICTOR},scores=true") != usual
    opened = open_dataset("predicted", live_config(scene, PREDICTOR).dataset.options).scene("flight")
    opened.frame(0, "colour-clusters")
    opened.frame(1, "colour-clusters", color=False)
    assert opened.digest([0, 1], "colour-clusters") == usual
    np.savetxt(scene / "pose/001.txt", np.eye(4))
    assert digest(PREDICTOR) != usual


def test_frames_have_colour_where_it_is_wanted(scene):
    opened = open_dataset("predicted", live_config(scene, PREDICTOR).dataset.options).scene("flight")
    np.testing.assert_array_equal(opened.frame(1, "colour-clusters").color, predicted_scene.image(1))
    assert opened.frame(1, "colour-clusters", color=False).color is None


def test_a_frame_that_is_asked_for_again_is_predicted_once(scene, monkeypatch):
    model = Shifting()
    monkeypatch.setattr("semstab.predict.dataset.create", lambda name, **options: model)
    opened = open_dataset("predicted", live_config(scene, PREDICTOR).dataset.options).scene("flight")
    for index in (0, 1, 0, 1):
        opened.frame(index, "colour-clusters")
    assert len(model.seen) == 2


def test_a_run_leaves_the_maps_that_it_read(scene, tmp_path):
    run(live_config(scene, PREDICTOR, f"{PREDICTOR},scores=true"), out=tmp_path / "run", report=False)
    predict(scene, clusters(), name="colour-clusters", scores=True)
    made = tmp_path / "run/predictions/flight"
    for k in range(6):
        labels, scores = f"labels/colour-clusters/{k:03d}.png", f"scores/colour-clusters/{k:03d}.npz"
        assert (made / labels).read_bytes() == (scene / labels).read_bytes()
        whole, half = (np.load(folder / scores)["scores"] for folder in (made, scene))
        assert (whole.dtype, half.dtype) == (np.float32, np.float16)
        np.testing.assert_array_equal(whole.astype(np.float16), half)
    dataset = {"name": "posed_folder", "options": {"root": str(scene), "labels_root": str(made.parent),
               "labels": "{scene}/labels/{model}/{name}", "scores": "{scene}/scores/{model}/{name}"}}  # fmt: skip
    (again,) = run({"dataset": dataset, "voxel_size": 0.25, "check": None, "models": ["colour-clusters"]}).runs
    first = run(live_config(scene, PREDICTOR), out=tmp_path / "run", report=False).runs[0]
    assert again.map_summary == first.map_summary


def test_maps_are_read_again_whatever_is_fused_from_them(scene, tmp_path, monkeypatch):
    model = Shifting()
    monkeypatch.setattr("semstab.predict.dataset.create", lambda name, **options: model)
    run(live_config(scene, PREDICTOR, frames={"stride": 2}), out=tmp_path / "run", report=False)
    assert len(model.seen) == 3
    run(live_config(scene, PREDICTOR, voxel_size=0.5), out=tmp_path / "run", report=False, overwrite=True)
    assert len(model.seen) == 6
    Image.fromarray(predicted_scene.image(5, seed=9)).save(scene / "color/005.png")
    (tmp_path / "run/predictions/flight/labels/colour-clusters/000.png").unlink()
    run(live_config(scene, PREDICTOR, voxel_size=0.2), out=tmp_path / "run", report=False, overwrite=True)
    assert len(model.seen) == 8


def test_a_model_that_fails_leaves_what_is_finished(scene, tmp_path):
    (tmp_path / "fails.py").write_text(
        "classes = ['a', 'b']\ncalls = []\ndef net(image):\n    calls.append(0)\n"
        "    if len(calls) == 4:\n        raise RuntimeError('out of luck')\n    return image[..., 0] // 128\n"
    )
    config = live_config(scene, f"{tmp_path / 'fails.py'}:net")
    with pytest.raises(DataError, match="out of luck"):
        run(config, out=tmp_path / "run", report=False)
    done = sorted((tmp_path / "run/predictions/flight/labels/net").glob("*.png"))
    assert [path.stem for path in done] == ["000", "001", "002"]
    run(config, out=tmp_path / "run", report=False)  # the other three, and no fourth call


@pytest.mark.parametrize("jobs", [1, 2])
def test_processes_share_what_one_of_them_predicts(scene, tmp_path, jobs):
    (tmp_path / "counts.py").write_text(
        "import os\nclasses = ['a', 'b']\ndef net(image):\n    with open(os.environ['COUNTS'], 'a') as file:\n"
        "        file.write('x')\n    return image[..., 0] // 128\n"
    )
    settings = ("--set", "sweeps.voxel_size=[0.2,0.25,0.5]", "--report", "off", "--rerun", "off")
    (tmp_path / "counted").touch()
    done = bench(
        "run", "--data", scene, "--predict", f"{tmp_path / 'counts.py'}:net", "--voxel-size", "0.25", "--jobs", jobs,
        *settings, "--out", tmp_path / "run", cwd=tmp_path, COUNTS=str(tmp_path / "counted"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "counted").read_text() == "x" * 6


def test_the_built_in_city_with_a_model():
    settings = {"dataset": {"name": "city", "options": {"width": 64, "height": 36, "frames": 2}}}
    config = predicted_config([parse_predictor(PREDICTOR)], None, {**settings, "scenes": ["scene0"], "check": None})
    (found,) = run(config, report=False).runs
    assert (found.unit.scene, found.unit.model, found.taxonomy) == ("scene0", "colour-clusters", "colour clusters")


@pytest.mark.parametrize(
    ("predictors", "message"),
    [
        ((PREDICTOR, PREDICTOR), "two models are called 'colour-clusters'; give one a name"),
        (("colour-clusters,clusters=1",), "clusters: input should be greater"),
        (("colourclusters",), "did you mean 'colour-clusters'"),
    ],
)
def test_runs_that_cannot_predict(scene, predictors, message):
    with pytest.raises(ConfigError, match=message):
        run(live_config(scene, *predictors), report=False)


def test_regions_cannot_be_fused(scene, monkeypatch):
    monkeypatch.setattr("semstab.predict.dataset.create", lambda name, **options: Tiles())
    with pytest.raises(ConfigError, match="finds regions without classes, which cannot be fused"):
        run(live_config(scene, PREDICTOR), report=False)


# --- label_space.yaml -------------------------------------------------------------------------------------------------


def test_each_model_of_a_posed_folder_can_have_classes_of_its_own(scene):
    (scene / "scene.yaml").write_text("classes: [left, right]\n")
    predict(scene, Shifting(), name="thirds")
    (scene / "labels/plain").mkdir()
    for k in range(6):
        Image.fromarray(np.zeros((48, 80), dtype=np.uint8)).save(scene / f"labels/plain/{k:03d}.png")
    opened = open_dataset("posed_folder", {"root": scene}).scene("flight")
    assert opened.label_space("thirds").classes == ("a", "b", "c")
    assert opened.label_space("plain").classes == ("left", "right")
    before = opened.digest([0], "thirds"), opened.digest([0], "plain")
    space = LabelSpace("thirds", ("a", "b", "other"))
    (scene / "labels/thirds/label_space.yaml").write_text(yaml.safe_dump(space.to_dict()))
    opened = open_dataset("posed_folder", {"root": scene}).scene("flight")
    assert opened.digest([0], "thirds") != before[0]
    assert opened.digest([0], "plain") == before[1]


def test_a_damaged_label_space_is_named(scene):
    predict(scene, Shifting(), name="thirds")
    (scene / "labels/thirds/label_space.yaml").write_text("classes: 3")
    with pytest.raises(ConfigError, match=r"labels/thirds/label_space.yaml: a taxonomy needs a list 'classes'"):
        open_dataset("posed_folder", {"root": scene}).scene("flight").label_space("thirds")


# --- The command line -------------------------------------------------------------------------------------------------


def test_predict_and_run_from_the_command_line(scene, tmp_path):
    options = ("--set", "clusters=3", "--name", "three", "--frames", ":4")
    result = bench("predict", "-m", "colour-clusters", "--data", scene, *options, cwd=tmp_path)
    assert "flight: 4 frames predicted" in result.stdout
    assert "frames/s (model" in result.stdout
    command = next(line for line in result.stdout.splitlines() if line.startswith("fuse them: "))
    words = command.removeprefix("fuse them: semstab-bench ").split()
    bench(*words, "--rerun", "off", "--voxel-size", "0.25", "-q", "--out", "run", cwd=tmp_path)
    runs = json.loads((tmp_path / "run/summary.json").read_text())["runs"]
    assert {(unit["model"], unit["K"], unit["frames"]) for unit in runs} == {("three", 3, 4)}


def test_run_with_a_model_from_the_command_line(scene, tmp_path):
    arguments = ("--predict", "colour-clusters,clusters=3", "--data", scene, "--voxel-size", "0.25", "--rerun", "off")
    result = bench(*arguments, "--out", "run", cwd=tmp_path)
    assert "equal" in result.stdout
    assert not (scene / "labels").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-m", "colour-clusters"), "--images GLOB, or --data FOLDER, or --dataset NAME"),
        (("-m", "colour-clusters", "--images", "*.png", "--data", "flight"), "--images GLOB, or --data FOLDER"),
        (("-m", "colour-clusters", "--images", "*.png", "--out", "x"), "*.png: no image of .png"),
        (("-m", "colour-clusters", "--data", "flight", "--checkpoint", "x"), "unknown setting 'checkpoint'"),
        (
            ("-m", "colour-clusters", "--data", "flight", "--image-size", "big"),
            "--image-size big: write the shorter side",
        ),
        (("-m", "colour-clusters", "--data", "flight", "--name", ".."), "name: it names a folder"),
        (("-m", "colour-clusters", "--data", "flight", "--option", "depth_skale=2"), "did you mean 'depth_scale'"),
        (
            ("-m", "segformer", "--data", "flight", "--checkpoint", "nowhere/at/all"),
            "nowhere/at/all: there is no such folder",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_2(scene, tmp_path, arguments, message):
    assert message in error_of("predict", *arguments, cwd=tmp_path)


def test_a_report_is_said_in_numbers():
    from rich.console import Console

    from semstab.predict.command import print_report
    from semstab.predict.sequence import SequenceReport

    report = SequenceReport("flight", (Path("labels/x"),), predicted=10, reused=2, model_seconds=2.0, seconds=4.0)
    console = Console(record=True, width=100, file=io.StringIO())
    print_report(report, console)
    print_report(dataclasses.replace(report, predicted=0), console)
    text = console.export_text()
    assert "flight: 10 frames predicted, 2 from an earlier start, 2.50 frames/s (model 200 ms a frame)" in text
    assert "flight: 0 frames predicted, 2 from an earlier start\n" in text
