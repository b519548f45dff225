"""What people have, or have wrong: it is read, or one line names the cause; a row a situation."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import dataset_writers as ds
import numpy as np
import pytest
import room_scene
import yaml
from command_line import bench
from posed_scene import fails

from semstab.datasets import open_dataset
from semstab.datasets.formats.disk import read_intrinsics, read_pose
from semstab.errors import DataError

COLMAP, TRANSFORMS = ds.FORMATS["colmap, text"], ds.FORMATS["transforms_json, nerfstudio"]


def room(folder: Path, **settings) -> Path:
    return room_scene.write(folder / "scene", **settings)


def every(folder: Path, change: Callable[[Path], object]) -> None:
    for path in sorted(folder.iterdir()):
        change(path)


def halved(path: Path) -> None:
    np.save(path, np.load(path)[::2, ::2])


def image(path: Path, array: np.ndarray) -> None:
    assert cv2.imwrite(str(path), array)


# --- what is read


def read(folder: Path, name: str = "posed_folder", **options):
    dataset = open_dataset(name, {"root": folder, **options})
    return dataset.scene(dataset.scenes[0])


def as_npy(path: Path) -> None:
    np.save(path.with_suffix(".npy"), np.loadtxt(path))
    path.unlink()


def as_rows(path: Path) -> None:
    path.with_suffix(".json").write_text(json.dumps(np.loadtxt(path).tolist()))
    path.unlink()


def as_named_rows(path: Path) -> None:
    row = {"frame": path.stem, "transform": np.loadtxt(path)[:3].tolist()}
    path.with_suffix(".JSON").write_text(json.dumps(row))
    path.unlink()


def as_utf_16(path: Path) -> None:
    path.write_text(path.read_text(), encoding="utf-16")


def capital(path: Path) -> None:
    path.rename(path.with_suffix(path.suffix.upper()))


@pytest.mark.parametrize("change", [as_npy, as_rows, as_named_rows, as_utf_16, capital])
def test_poses_of_other_kinds(tmp_path, change):
    folder = room(tmp_path)
    expected = [read(folder).frame(k, "net") for k in range(3)]
    every(folder / "pose", change)
    for k, frame in enumerate(expected):
        found = read(folder).frame(k, "net")
        np.testing.assert_allclose(found.T_wc, frame.T_wc, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["depth", "labels/net", "color"])
def test_suffixes_in_capitals(tmp_path, kind):
    folder = tmp_path / "scene"
    names = ds.write_posed_folder(folder, ds.source(1000))
    ds.write_labels(folder, names, ds.source(1000))
    (folder / "scene.yaml").write_text(f"classes: {ds.CLASSES}")
    expected = read(folder).frame(1, "net")
    every(folder / kind, capital)
    found = read(folder).frame(1, "net")
    for part in ("depth", "labels", "color"):
        np.testing.assert_array_equal(getattr(found, part), getattr(expected, part))


CAMERA = room_scene.CAMERA
OPEN3D = {"width": 96, "height": 72, "intrinsic_matrix": CAMERA.matrix.T.ravel().tolist()}
NUMBERS = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy")}


@pytest.mark.parametrize("content", [OPEN3D, NUMBERS, {"K": CAMERA.matrix.tolist()}])
def test_intrinsics_in_json(tmp_path, content):
    folder = room(tmp_path)
    (folder / "intrinsics.txt").unlink()
    (folder / "intrinsics.json").write_text(json.dumps(content))
    assert read(folder).frame(0, "net").intrinsics == CAMERA
    (folder / "intrinsics.json").write_text("{}")
    fails(DataError, "intrinsics.json: holds no camera; write width, height and intrinsic_matrix", read, folder)


@pytest.mark.parametrize("order", ["<", ">"])
def test_depth_of_pfm(tmp_path, order):
    folder = room(tmp_path)
    expected = read(folder).depth(2)

    def as_pfm(path: Path) -> None:
        depth = np.load(path)
        header = f"Pf\n{depth.shape[1]} {depth.shape[0]}\n{'-' if order == '<' else ''}1.0\n"
        path.with_suffix(".pfm").write_bytes(header.encode() + depth[::-1].astype(f"{order}f4").tobytes())
        path.unlink()

    every(folder / "depth", as_pfm)
    np.testing.assert_array_equal(read(folder).depth(2), expected)
    file = folder / "depth/001.pfm"
    stored = file.read_bytes()
    body = np.frombuffer(stored, f"{order}f4", 96 * 72, len(stored) - 4 * 96 * 72).copy()
    body[5] = np.nan  # a pixel without depth is no channel that differs
    file.write_bytes(stored[: -body.nbytes] + body.tobytes())
    assert np.isnan(read(folder).depth(1)[-1, 5])
    colours = np.repeat(body, 3).tobytes()
    file.write_bytes(stored[: -body.nbytes].replace(b"Pf", b"PF") + colours)
    assert np.isnan(read(folder).depth(1)[-1, 5])
    file.write_bytes(stored[: -body.nbytes].replace(b"96 72", b"20000 20000") + body.tobytes())
    fails(DataError, "001.pfm: claims 20000x20000 pixels", read(folder).depth, 1)
    file = folder / "depth/000.pfm"
    file.write_bytes(file.read_bytes()[:-1])
    fails(DataError, "000.pfm: truncated: 96x72 pixels need 27648 bytes", read(folder).depth, 0)


def test_void_ids_below_zero(tmp_path):
    folder = room(tmp_path)

    def signed(path: Path) -> None:
        ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.int64)
        np.save(path.with_suffix(".npy"), np.where(ids == 2, -1, ids))
        path.unlink()

    every(folder / "labels/net", signed)
    hint = r"label ids from -1 to 4; if -1 is 'ignore', set void_ids: \{MODEL: \[-1\]\}"
    fails(DataError, hint, read(folder).frame, 0, "net")
    frame = read(folder, void_ids={"net": [-1]}).frame(0, "net")
    assert frame.labels.dtype == np.uint8
    assert sorted(np.unique(frame.labels)) == [0, 1, 3, 4, 255]


def test_labels_of_another_size_than_depth_are_looked_up(tmp_path):
    folder = room(tmp_path, intrinsics_size=[96, 72])
    every(folder / "depth", halved)
    frame = read(folder).frame(0, "net")
    assert frame.shape == (36, 48)
    np.testing.assert_allclose(frame.intrinsics.fx, CAMERA.fx / 2)
    assert set(np.unique(frame.labels)) <= set(range(5))


def times(k: int) -> float:
    return 1403636579.75 + 0.05 * k


def tum(frames) -> list[str]:
    return [
        f"{times(k)!r} {ds.numbers([*f.T_wc[:3, 3], *ds.quaternion(f.T_wc[:3, :3])])}" for k, f in enumerate(frames)
    ]


def kitti(frames) -> list[str]:
    return [ds.numbers(f.T_wc[:3]) for f in frames]


def euroc(frames) -> list[str]:
    rows = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"]
    for k, f in enumerate(frames):
        x, y, z, w = ds.quaternion(f.T_wc[:3, :3])
        rows.append(",".join([f"{round(times(k) * 1e9)}", *(repr(float(v)) for v in (*f.T_wc[:3, 3], w, x, y, z))]))
    return rows


@pytest.mark.parametrize(
    ("form", "name"),
    [(tum, lambda k: f"{times(k):.6f}"), (euroc, lambda k: f"{round(times(k) * 1e9)}"), (kitti, lambda k: f"{k:03d}")],
)
def test_a_trajectory_for_a_posed_folder(tmp_path, form, name):
    folder = room(tmp_path)
    expected = [read(folder).frame(k, "net") for k in range(12)]
    for kind in ("depth", "labels/net", "labels/gt"):
        for k, path in enumerate(sorted((folder / kind).iterdir())):
            path.rename(path.with_name(name(k) + path.suffix))
    every(folder / "pose", Path.unlink)
    ds.write_lines(folder / "poses.csv", form(expected))
    scene = read(folder, trajectory="poses.csv")
    assert len(scene) == 12
    for k, frame in enumerate(expected):
        np.testing.assert_allclose(scene.frame(k, "net").T_wc, frame.T_wc, rtol=0, atol=1e-5)
    (folder / "scene.yaml").write_text((folder / "scene.yaml").read_text() + "trajectory: poses.csv\n")
    assert len(read(folder)) == 12


def test_a_trajectory_that_does_not_fit(tmp_path):
    folder = room(tmp_path)
    frames = [read(folder).frame(k, "net") for k in range(12)]
    for lines, said in (
        (
            tum(frames),
            r"no pose is within 0.02 s of a frame: poses are from 1403636579.75.* from 0.000000 to 11.000000",
        ),
        (kitti(frames)[:5], "has 5 poses, but there are 12 frames; they must be as many"),
        (["1 2 3"], "line 1 has 3 values; expected a row of TUM: seconds"),
    ):
        ds.write_lines(folder / "poses.txt", lines)
        fails(DataError, said, read, folder, trajectory="poses.txt")


def test_transforms_of_blender(tmp_path):
    """transforms_train.json, with an angle of view and without the images' size."""
    ds.write_transforms(tmp_path, ds.source(1000))
    expected = [ds.opened(TRANSFORMS, tmp_path).geometry(k) for k in range(ds.COUNT)]
    content = json.loads((tmp_path / "transforms.json").read_text())
    angle = 2 * np.arctan(content["w"] / (2 * content["fl_x"]))
    left = {key: value for key, value in content.items() if key not in ("w", "h", "fl_x", "fl_y")}
    (tmp_path / "transforms.json").unlink()
    (tmp_path / "transforms_train.json").write_text(json.dumps(left | {"camera_angle_x": angle}))
    for k, frame in enumerate(expected):
        found = ds.opened(TRANSFORMS, tmp_path).geometry(k)
        np.testing.assert_allclose(found.intrinsics.matrix, frame.intrinsics.matrix, rtol=1e-9)
        np.testing.assert_array_equal(found.depth, frame.depth)


def test_poses_that_nerfstudio_scaled(tmp_path):
    ds.write_transforms(tmp_path, ds.source(1000))
    expected = ds.opened(TRANSFORMS, tmp_path).T_wc(1)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for entry in content["frames"]:
        for row in entry["transform_matrix"][:3]:
            row[3] *= 0.3
    (tmp_path / "transforms.json").write_text(json.dumps(content | {"applied_scale": 0.3}))
    np.testing.assert_allclose(ds.opened(TRANSFORMS, tmp_path).T_wc(1), expected, atol=1e-12)


# --- models that COLMAP left beside each other


@pytest.fixture
def two_models(tmp_path) -> Path:
    frames = ds.source()
    ds.write_colmap(tmp_path, frames[:1], model="sparse/0")
    ds.write_labels(tmp_path, [f"cam 0/{k:04d}" for k in range(ds.COUNT)], frames)
    ds.write_colmap(tmp_path, frames, model="sparse/1")
    return tmp_path


def test_of_several_models_one_is_chosen(two_models):
    said = r"sparse: 2 models, which share no coordinates \(0: 1 image from cam 0/0000.png; 1: 4 images .*; choose one"
    fails(DataError, said, read, two_models, "colmap")
    for model, count in ((0, 1), ("1", 4), ("sparse/1", 4)):
        assert len(read(two_models, "colmap", model=model)) == count
    every_one = open_dataset("colmap", {"root": two_models, "model": "all"})
    name = two_models.name
    assert every_one.scenes == (f"{name}-0", f"{name}-1")
    assert [len(every_one.scene(scene)) for scene in every_one.scenes] == [1, 4]


# --- what is named


def two_sizes(folder: Path) -> None:
    for k in (4, 5):
        halved(folder / f"depth/{k:03d}.npy")


def factor(folder: Path) -> None:
    every(folder / "pose", lambda path: np.savetxt(path, 0.5 * np.loadtxt(path)))


def commas(folder: Path) -> None:
    every(folder / "pose", lambda path: path.write_text(path.read_text().replace(".", ",")))


def renamed(change: Callable[[Path], Path]) -> Callable[[Path], None]:
    return lambda folder: every(folder / "labels/net", lambda path: path.rename(change(path)))


def no_truth(folder: Path) -> None:
    every(folder / "labels/gt", Path.unlink)
    (folder / "labels/gt").rmdir()


def jpeg(folder: Path) -> None:
    no_truth(folder)
    every(folder / "labels/net", lambda path: (image(path.with_suffix(".jpg"), cv2.imread(str(path))), path.unlink()))


def suffixed(folder: Path) -> None:
    no_truth(folder)
    renamed(lambda path: path.with_name(f"{path.stem}_pred.png"))(folder)


def flat(folder: Path) -> None:
    no_truth(folder)
    renamed(lambda path: path.parents[1] / path.name)(folder)


def other_names(folder: Path) -> None:
    no_truth(folder)
    renamed(lambda path: path.with_name(f"x{int(path.stem) + 500}.png"))(folder)


def far_pixel(folder: Path) -> None:
    depth = np.load(folder / "depth/005.npy")
    depth[3, 4] = 1.7e7
    np.save(folder / "depth/005.npy", depth)


PALETTE = np.array([[200, 30, 40], [20, 180, 60], [0, 90, 220], [250, 240, 10], [130, 130, 240]], np.uint8)
COLOURS = {"name": "mine", "classes": [{"name": n, "color": c.tolist()} for n, c in zip("abcde", PALETTE, strict=True)]}


def recoloured(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Label maps as RGB images, of the colours of a taxonomy or not."""

    def recolour(folder: Path) -> None:
        (folder / "mine.yaml").write_text(yaml.safe_dump(COLOURS))
        (folder / "scene.yaml").write_text("taxonomy: mine.yaml")
        for path in (folder / "labels/net").iterdir():
            ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            image(path, np.ascontiguousarray(change(ids)[..., ::-1]))

    return recolour


def red(ids: np.ndarray) -> np.ndarray:
    return np.stack([ids, 0 * ids, 0 * ids], axis=-1)


def interpolated(ids: np.ndarray) -> np.ndarray:
    """Smooth borders of regions, as where an image was resized."""
    even = cv2.medianBlur(ids, 5)
    return cv2.resize(PALETTE[even[::2, ::2]], ids.shape[::-1], interpolation=cv2.INTER_LINEAR)


def millimetres(folder: Path, units: float = 1000) -> None:
    def longer(path: Path) -> None:
        T = np.loadtxt(path)
        T[:3, 3] *= units
        np.savetxt(path, T)

    every(folder / "pose", longer)


def centimetres(folder: Path) -> None:
    millimetres(folder, 100)


def flat_beside_the_truth(folder: Path) -> None:
    renamed(lambda path: path.parents[1] / path.name)(folder)


def inverse(folder: Path) -> None:
    every(folder / "depth", lambda path: np.save(path, 1 / np.load(path)))


CAUSES = {
    "channels alike": (
        recoloured(lambda ids: np.dstack([ids] * 3)),
        "its three channels are equal: are they ids[?] save",
    ),
    "ids in red": (recoloured(red), "only its red channel is not 0: are these ids, as CARLA's[?] save that channel"),
    "red and blue": (recoloured(lambda ids: PALETTE[ids][..., ::-1]), "with red and blue exchanged it is one: OpenCV"),
    "mixed colours": (recoloured(interpolated), "such colours are mixtures of neighbouring classes at borders; resize"),
    "other colours": (
        recoloured(lambda ids: 255 - PALETTE[ids]),
        "set taxonomy to the one whose colours the image has",
    ),
    "poses in millimetres": (millimetres, r"under metres_per_unit: 0.001 \(set it in .*; the poses are in millimetres"),
    "poses in centimetres": (centimetres, r"under metres_per_unit: 0.01 \(set it in .*; the poses are in centimetres"),
    "labels beside the truth": (flat_beside_the_truth, r"labels/000.png: .*; set labels: \{net: 'labels/\{name\}'\}"),
    "inverse depth": (inverse, r"with 0.* error under depth_kind: inverse \(set it in "),
    "labels in JPEG": (jpeg, r"labels/net/000.jpg is a JPEG, which changes class ids; write label maps as PNG"),
    "labels of other names": (
        suffixed,
        r"net/000_pred.png: is read as the label map of no frame.*set labels: 'labels/\{model\}/\{name\}_pred' \(--opt",
    ),
    "labels beside each other": (flat, r"labels/000.png: .*; set labels: \{net: 'labels/\{name\}'\} \(--option"),
    "labels of no frame": (other_names, r"net/x500.png: is of no frame \(these are called 000, 001, ...\).*call them"),
    "a pixel far away": (far_pixel, r"depth/005.npy: pixel \(4, 3\) has depth 17,000,000 m, .*; set max_depth"),
    "two sizes": (two_sizes, r"depth/004.npy: depth, and 1 more, is 48x36 where that of the others is 96x72"),
    "a matrix times a factor": (factor, "the pose is multiplied by 0.5 .*; divide it by its last element"),
    "decimal commas": (commas, r"000.txt: numbers have decimal commas \(.*\); write points: 0[.]"),
}


@pytest.mark.parametrize(("change", "said"), CAUSES.values(), ids=CAUSES)
def test_check_names_the_cause(tmp_path, change, said):
    folder = room(tmp_path)
    change(folder)
    done = bench("check", "--data", folder, cwd=tmp_path, code=2)
    assert re.search(said, done.stderr), done.stderr


def test_an_intrinsics_size_reads_two_sizes_of_one_view(tmp_path):
    folder = room(tmp_path)
    two_sizes(folder)
    scene = read(folder, intrinsics_size=[96, 72])
    assert [scene.frame(k, "net").shape for k in (3, 4)] == [(72, 96), (36, 48)]
    fails(DataError, "004.npy: depth, and 1 more, is 48x36", lambda: [read_all(read(folder))])


def read_all(scene):
    return [scene.depth(k) for k in range(len(scene))]


def test_numbers_of_one_matrix_keep_their_commas(tmp_path):
    """Commas between numbers, not in them, are as good as whitespace."""
    path = tmp_path / "k.txt"
    for text in ("500,0,48\n0,500,36\n0,0,1", "500, 0, 48, 0, 500, 36, 0, 0, 1", "500 0 48\n0 500 36\n0 0 1"):
        path.write_text(text)
        assert read_intrinsics(path).cx == 48
    path.write_text("1,5 0,0 0,0 2,5\n0 1 0 0,5\n0 0 1 3\n0 0 0 1")
    fails(DataError, r"decimal commas \(1,5\); write points: 1.5", read_pose, path)


@pytest.mark.parametrize("change", [jpeg, suffixed, flat])
def test_a_run_says_of_labels_what_check_says(tmp_path, change):
    folder = room(tmp_path)
    change(folder)
    said = [bench(*words, "--data", folder, cwd=tmp_path, code=2).stderr for words in (["check"], ["run"])]
    assert said[0].replace("error: scene: ", "error: ") == said[1]
    assert len(said[1].splitlines()) == 1


@pytest.mark.parametrize(
    ("change", "option"),
    [(suffixed, "labels='labels/{model}/{name}_pred'"), (flat, "labels={net: 'labels/{name}'}")],
)
def test_the_setting_that_is_named_reads_them(tmp_path, change, option):
    folder = room(tmp_path)
    change(folder)
    bench("check", "--data", folder, "--option", option, cwd=tmp_path)


@pytest.mark.parametrize(
    ("change", "settings"),
    [(millimetres, {"metres_per_unit": 0.001}), (inverse, {"depth_kind": "inverse"})],
)
def test_what_check_sets_reads_the_scene(tmp_path, change, settings):
    folder = room(tmp_path)
    expected = [read(folder).geometry(k) for k in (0, 5)]
    change(folder)
    for frame, k in zip(expected, (0, 5), strict=True):
        found = read(folder, **settings).geometry(k)
        np.testing.assert_allclose(found.depth, frame.depth, rtol=1e-6)
        np.testing.assert_allclose(found.T_wc, frame.T_wc, rtol=0, atol=1e-9)
    words = [word for key, value in settings.items() for word in ("--option", f"{key}={value}")]
    bench("check", "--data", folder, *words, cwd=tmp_path)
