"""Label maps and scores in a folder of their own, at another size, in every format; ground truth; taxonomies."""

from __future__ import annotations

import cv2
import dataset_writers as ds
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from posed_scene import fails
from scipy import ndimage

from semstab import Intrinsics
from semstab.datasets.files.labels import SceneEntry, find_sources
from semstab.datasets.files.options import FileOptions, Folders, FrameSource
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.geometry.lenses import fit
from semstab.datasets.scannet import read_class_table
from semstab.errors import ConfigError, DataError

FORM = ds.FORMATS["hololens"]
SCANNET = ds.FORMATS["scannet"]


@pytest.fixture
def scene(tmp_path):
    """A root with the scene 'room', without label maps: (root, names, frames)."""
    frames = ds.source(1000)
    names = FORM.write(tmp_path / "data" / "room", frames)
    return tmp_path / "data", names, frames


# --- where they are


@pytest.mark.parametrize(
    ("template", "file"),
    [
        (None, "room/net/{}.png"),
        ("{scene}/{model}/{name}.png", "room/net/{}.png"),
        ("{model}/{scene}_{name}", "net/room_{}.npy"),
        ("runs of {model} (2)/pred-{name}-ids.npz", "runs of net (2)/pred-{}-ids.npz"),
        ({"net": "a/{scene}/b/{name}"}, "a/room/b/{}.png"),
    ],
)
def test_a_folder_of_their_own_with_a_template(scene, tmp_path, template, file):
    root, names, frames = scene
    for name, frame in zip(names, frames, strict=True):
        path = tmp_path / "predictions" / file.format(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".npz":
            np.savez_compressed(path, labels=frame.labels)
        else:
            ds.save(path, frame.labels)
    found = ds.opened(FORM, root, labels_root=tmp_path / "predictions", labels=template)
    assert found.models == ("net",)
    ds.assert_same_voxels([found.frame(k, "net") for k in range(ds.COUNT)], frames)


@pytest.mark.parametrize(
    ("option", "template", "message"),
    [
        ("labels", "../predictions/{model}/{name}.png", "labels: '../predictions/.*leaves its folder.*labels_root"),
        ("labels", "a/{model}/../../{name}.png", "leaves its folder"),
        ("labels", "/etc/{model}/{name}", "leaves its folder"),
        ("labels", {"net": "../{name}.png"}, r"labels\.net: .*leaves its folder"),
        ("scores", "/{model}/{name}", "scores: .*leaves its folder"),
        ("ground_truth", "../gt/{name}.png", "ground_truth: .*leaves its folder"),
        (
            "labels",
            "{model}/{name.__class__}",
            r"unknown \{name.__class__\}; known: \{scene\}, \{model\}, \{name\}",
        ),
        ("labels", "{model}/{root}/{name}", r"unknown \{root\}"),
        ("labels", "labels/{name}.png", r"needs \{model\}"),
        ("labels", "labels/{model}/x.png", r"needs \{name\}"),
        ("labels", "labels/{model}/{name", "a brace is not closed|needs"),
        ("labels", "labels/{name}/{model}.png", "must be in the name of a folder"),
        ("labels", "{name}/{model}/x.png", "must be in the name of a folder, before the other"),
        ("labels", "", "needs"),
        ("labels", "{model}/{name}\n", "leaves its folder"),
    ],
)
def test_a_template_that_cannot_be_is_one_line(scene, option, template, message):
    root, _, _ = scene
    fails(ConfigError, message, ds.opened, FORM, root, **{option: template})


def test_a_name_from_a_file_cannot_lead_out_of_the_folder(tmp_path):
    place, camera = SceneEntry("s", tmp_path, "s"), Camera(Intrinsics(1, 1, 0, 0))
    (tmp_path / "labels/net").mkdir(parents=True)
    for name in ("../../../etc/passwd", "a\nb", "a\0b", "x" * 2000, "\ud800"):
        frames = [FrameSource(name, tmp_path, tmp_path, camera)]
        options = FileOptions(root=tmp_path)
        fails(DataError, "leaves|cannot be the path", find_sources, options, place, frames, Folders(), {})


def test_labels_and_scores_side_by_side(scene):
    root, names, frames = scene
    ds.write_labels(root / "room", names, frames)
    ds.write_labels(root / "room", names, frames, "labels/gt/{}.png")
    for name, frame in zip(names, frames, strict=True):
        (root / "room/scores/net").mkdir(parents=True, exist_ok=True)
        np.savez(
            root / f"room/scores/net/{name}.npz", scores=np.eye(8, dtype=np.float16)[frame.labels].transpose(2, 0, 1)
        )
    found = ds.opened(FORM, root)
    assert (found.models, found.ground_truth) == (("net", "net-scores"), True)
    soft, hard = found.frame(2, "net-scores"), found.frame(2, "net")
    np.testing.assert_array_equal(soft.predicted, hard.labels)
    assert soft.files["scores"].endswith(f"room/scores/net/{names[2]}.npz")
    np.testing.assert_array_equal(found.frame(2, "gt").labels, hard.labels)
    fails(ConfigError, "model 'nets' is not there; did you mean 'net'", found.frame, 0, "nets")
    by_folder = ds.opened(FORM, root, scores={"soft": "scores/net/{name}"}, labels={"hard": "labels/net/{name}"})
    assert by_folder.models == ("hard", "soft")


def test_two_sources_of_one_name_are_refused(scene):
    root, names, frames = scene
    ds.write_labels(root / "room", names, frames, "labels/net-scores/{}.png")
    ds.write_labels(root / "room", names, frames, "scores/net/{}.npy")
    fails(ConfigError, "two label sources are called 'net-scores'; rename one", ds.opened, FORM, root)


def test_a_folder_without_labels_of_the_scene_is_left_out_and_said(scene, caplog):
    root, names, frames = scene
    ds.write_labels(root / "room", names, frames)
    ds.write_labels(root / "room", ["other"], frames[:1], "labels/old/{}.png")
    assert ds.opened(FORM, root).models == ("net",)
    assert f"old: no file of any frame, such as {root}/room/labels/old/00003.png; left out" in caplog.text


def test_a_labels_root_that_is_wrong_is_said(scene, tmp_path, caplog):
    root, _, _ = scene
    fails(
        ConfigError, "nowhere: there is no such folder; correct labels_root", ds.opened, FORM, root,
        labels_root=tmp_path / "nowhere",
    )  # fmt: skip
    assert ds.opened(FORM, root, labels_root=tmp_path).models == ()
    assert f"room: no label maps in {tmp_path} fit the options labels and scores" in caplog.text
    assert f"expected {tmp_path}/room/MODEL/00003.png" in caplog.text
    said = {"labels_root": tmp_path, "labels": "{model}/{scene}_{name}", "scores": {"x": "soft/{name}.npy"}}
    assert ds.opened(FORM, root, **said).label_paths == (
        f"{tmp_path}/MODEL/room_00003.png",
        f"{tmp_path}/soft/00003.npy",
    )


# --- formats


# --- another size


@pytest.mark.parametrize("factor", [2, 3])
def test_labels_and_scores_at_a_finer_size_give_the_same_voxels(scene, factor):
    """Each pixel repeated: pixel areas must align, so that every depth pixel finds its own label again."""
    root, names, frames = scene
    for name, frame in zip(names, frames, strict=True):
        finer = frame.labels.repeat(factor, axis=0).repeat(factor, axis=1)
        ds.save(root / f"room/labels/net/{name}.png", finer)
        ds.save(root / f"room/scores/net/{name}.npy", np.eye(8, dtype=np.float16)[finer])
    found = ds.opened(FORM, root, scores_layout="HWK")
    ds.assert_same_voxels([found.frame(k, "net") for k in range(ds.COUNT)], frames)
    ds.assert_same_voxels([found.frame(k, "net-scores") for k in range(ds.COUNT)], frames)


def sized(shape) -> tuple[Intrinsics, Intrinsics]:
    """Intrinsics of an image of that (ds.H, ds.W) and of the depth image, which show the same field of view."""
    K = Intrinsics(40, 41, 23.2, 15.9)
    return K.resized((ds.W, ds.H), (shape[1], shape[0])), K


@given(shape=st.tuples(st.integers(1, 90), st.integers(1, 120)), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_ids_are_those_of_the_nearest_pixel(shape, seed):
    """Against whole numbers: the ds.source pixel that the target pixel's centre falls into, at a tie the later one."""
    labels = np.random.default_rng(seed).integers(0, 200, shape).astype(np.uint8)
    rows, columns = ((2 * np.arange(n) + 1) * size // (2 * n) for n, size in zip((ds.H, ds.W), shape, strict=True))
    np.testing.assert_array_equal(fit(labels, *sized(shape), (ds.H, ds.W)), labels[np.ix_(rows, columns)])


@given(shape=st.tuples(st.integers(1, 60), st.integers(1, 70)), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_scores_are_linear_between_pixel_centres(shape, seed):
    """Against scipy's interpolation of one class at a time, and OpenCV's resizing."""
    scores = np.random.default_rng(seed).random((*shape, 3)).astype(np.float32)
    found = fit(scores, *sized(shape), (ds.H, ds.W))
    v, u = ((np.arange(n) + 0.5) * size / n - 0.5 for n, size in zip((ds.H, ds.W), shape, strict=True))
    at = np.meshgrid(v, u, indexing="ij")
    expected = [ndimage.map_coordinates(scores[..., k], at, order=1, mode="nearest") for k in range(3)]
    np.testing.assert_allclose(found, np.stack(expected, axis=2), atol=1e-5)
    np.testing.assert_allclose(found, cv2.resize(scores, (ds.W, ds.H), interpolation=cv2.INTER_LINEAR), atol=2e-3)


def test_half_precision_scores_are_mixed_in_single_and_unusable_ones_stay_so():
    scores = np.full((2, 2, 2), 0.5, np.float16)
    scores[0, 0] = np.nan
    found = fit(scores, *sized((2, 2)), (ds.H, ds.W))
    assert found.dtype == np.float32
    assert np.isnan(found[0, 0]).all()
    assert np.isfinite(found[-1, -1]).all()


def test_labels_of_the_colour_camera_are_looked_up_with_its_intrinsics(tmp_path):
    """ScanNet: a class that depends on the direction of the ray is found again at each depth pixel."""
    frames = ds.source(1000)
    names = SCANNET.write(tmp_path, frames)
    color = Intrinsics(90.0, 97.0, 47.0, 25.0)  # of 96x60 images, another field of view
    np.savetxt(tmp_path / "intrinsic/intrinsic_color.txt", np.pad(color.matrix, ((0, 1), (0, 1))))

    def classes(K, shape):
        y, x = (np.arange(shape[0]) - K.cy) / K.fy, (np.arange(shape[1]) - K.cx) / K.fx
        return ((np.floor(x * 4)[None, :] + np.floor(y * 4)[:, None]) % 7).astype(np.uint8)

    for shape, K in (((60, 96), color), ((120, 192), color.resized((96, 60), (192, 120)))):
        for name in names:
            ds.save(tmp_path / f"labels/net/{name}.png", classes(K, shape))
        found = ds.opened(SCANNET, tmp_path, color_size=(96, 60)).frame(0, "net")
        labelled = found.labels != 255
        expected = classes(frames[0].intrinsics, (ds.H, ds.W))
        assert 0.5 < labelled.mean() < 1  # the colour camera sees less
        assert (found.labels == expected)[labelled].mean() > 0.9  # but for the borders of classes
        assert not found.valid[~labelled].any()
    plain = ds.opened(SCANNET, tmp_path, label_camera="depth")
    fails(DataError, "labels/net/0.png: labels are 192x120 but depth is 48x32, another view", plain.frame, 0, "net")


def test_scores_that_the_colour_camera_does_not_have_are_not_used():
    scores = np.full((4, 4, 2), 0.5)
    narrow, wide = Intrinsics(8, 8, 1.5, 1.5), Intrinsics(8, 8, 5.5, 5.5)
    found = fit(scores, narrow, wide, (12, 12))
    assert (found.sum(axis=2) > 0).sum() == 16
    assert (found[4:8, 4:8] == 0.5).all()
    ids = fit(np.zeros((4, 4), np.uint16), narrow, wide, (12, 12))
    assert (ids == 0).sum() == 16
    assert (ids[0] == 65535).all()


def test_depth_of_another_size_than_the_intrinsics_and_the_labels(scene):
    """A reader's camera for 96x64, depth 48x32, labels 96x64."""
    root, names, frames = scene
    K = frames[0].intrinsics.resized((ds.W, ds.H), (2 * ds.W, 2 * ds.H))
    np.savetxt(root / "room/K.txt", K.matrix)
    for name, frame in zip(names, frames, strict=True):
        ds.save(root / f"room/labels/net/{name}.png", frame.labels.repeat(2, axis=0).repeat(2, axis=1))
    found = ds.opened(FORM, root, intrinsics_size=(2 * ds.W, 2 * ds.H))
    ds.assert_same_voxels([found.frame(k, "net") for k in range(ds.COUNT)], frames)


# --- what the ids mean


def test_void_ids_and_taxonomies_go_by_label_source(tmp_path):
    names, frames = ds.write_labelled(SCANNET, tmp_path)
    ds.write_labels(tmp_path, names, frames, "label-filt/{}.png")
    (tmp_path / "gt.yaml").write_text("classes: [nothing, p, q, r, s, t, u, v, w]\n")
    found = ds.opened(SCANNET, tmp_path, label_camera="depth", taxonomies={"gt": str(tmp_path / "gt.yaml")})
    assert found.label_space("gt").classes[1] == "p"
    assert found.label_space("net").classes == tuple(ds.CLASSES)
    truth, net = found.frame(0, "gt"), found.frame(0, "net")
    np.testing.assert_array_equal(truth.labels, np.where(frames[0].labels == 0, 255, frames[0].labels))
    np.testing.assert_array_equal(net.labels, frames[0].labels)
    other = ds.opened(SCANNET, tmp_path, label_camera="depth", void_ids={"net": (2, 4)})
    assert set(np.unique(other.frame(0, "net").labels)) & {2, 4, 255} == {255}


def test_void_ids_of_scores_are_those_of_their_largest_class(scene):
    root, names, frames = scene
    for name, frame in zip(names, frames, strict=True):
        ds.save(root / f"room/labels/net/{name}.png", frame.labels)
        ds.save(root / f"room/scores/net/{name}.npy", np.eye(8, dtype=np.float16).T[frame.labels].transpose(2, 0, 1))
    found = ds.opened(FORM, root, void_ids={"net": (1, 2), "net-scores": (1, 2)})
    hard, soft = found.frame(0, "net"), found.frame(0, "net-scores")
    assert 0.05 < (hard.labels == 255).mean() < 1
    np.testing.assert_array_equal(soft.predicted == soft.ignore_id, hard.labels == 255)


def test_a_label_space_beside_the_maps_goes_before_that_of_all(scene):
    root, names, frames = scene
    ds.write_labels(root / "room", names, frames)
    ds.write_labels(root / "room", names, frames, "labels/other/{}.png")
    (root / "room/labels/other/label_space.yaml").write_text("classes: [a, b, c, d, e, f, g, h]\n")
    (root / "said.yaml").write_text("classes: [p, q, r, s, t, u, v, w]\n")
    found = ds.opened(FORM, root)
    assert found.label_space("net").classes == tuple(ds.CLASSES)
    assert found.label_space("other").classes[0] == "a"
    said = ds.opened(FORM, root, taxonomies={"other": str(root / "said.yaml")})
    assert said.label_space("other").classes[0] == "p"


def test_classes_that_are_not_known_are_asked_for(scene):
    root, names, frames = scene
    ds.write_labels(root / "room", names, frames)
    found = ds.opened(FORM, root, classes=None)
    fails(DataError, r"classes of 'net' are not known; set .*taxonomies: \{net: NAME\}", found.label_space, "net")
    with pytest.raises(ValueError, match="give classes or taxonomy, not both"):
        ds.opened(FORM, root, taxonomy="uavid8")


TABLE = 'id\traw_category\tnyu40id\tnyu40class\n1\twall\t1\twall\n1163\tobject\t\t\n22\t"ceiling\t22\tceiling\n'


def test_scannets_table_translates_ids(tmp_path):
    frames = ds.source(1000)
    names = SCANNET.write(tmp_path, frames)
    ids = np.full((ds.H, ds.W), 1163, np.uint16)
    ids[:9], ids[9:20], ids[20] = 1, 22, 0
    for name in names:
        ds.save(tmp_path / f"label-filt/{name}.png", ids)
    (tmp_path / "table.tsv").write_text(TABLE)
    options = {"label_camera": "depth", "class_table": tmp_path / "table.tsv", "taxonomies": {"gt": "nyu40"}}
    found = ds.opened(SCANNET, tmp_path, **options)
    labels = found.frame(0, "gt").labels
    assert (labels[:9] == 1).all()
    assert (labels[9:20] == 22).all()
    assert (labels[20:] == 65535).all()
    space = found.label_space("gt")
    assert [space.classes[space.ids.index(k)] for k in (1, 22)] == ["wall", "ceiling"]
    digest = found.digest([0], "gt")
    (tmp_path / "table.tsv").write_text(TABLE.replace("1\twall\t1", "1\twall\t2"))
    assert ds.opened(SCANNET, tmp_path, **options).digest([0], "gt") != digest
    ids[0, 0] = 77
    ds.save(tmp_path / "label-filt/0.png", ids)
    fails(DataError, r"label-filt/0\.png: the id 77 is not in the table of classes", found.frame, 0, "gt")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("id\tname\n1\twall\n", "no columns 'id' and 'nyu40id'"),
        ("id\tnyu40id\n1\tx\n", "line 2 has the id 'x'"),
        ("id\tnyu40id\n1\t1\n70000\t1\n", "line 3 has the id '70000'"),
        ("nyu40id\tid\n1\n", "line 2 has the id 'None'"),
        ("", "the file is empty"),
        ("id\tnyu40id\n\0\t1\n", "line 2 has the id '.x00'"),
    ],
)
def test_another_table_is_refused(tmp_path, text, match):
    path = tmp_path / "t.tsv"
    path.write_text(text)
    fails(DataError, f"t.tsv: .*{match}", read_class_table, path, "nyu40id")
