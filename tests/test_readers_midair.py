"""Mid-Air: the drone's axes, half floats along the ray, rows of the records, several flights, and what is wrong."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from dataset_writers import COUNT, FORMATS, H, W, opened, save, source, write_labels, write_midair
from posed_scene import fails

from semstab.datasets import open_dataset
from semstab.datasets.midair import read_flight, read_half_floats
from semstab.errors import DataError, MissingDependencyError

h5py = pytest.importorskip("h5py")

FORM = FORMATS["midair"]


def write(folder, **flights):
    """Records of flights by name, positions (n, 3) and attitudes (n, 4), w x y z, and depth of ten metres."""
    with h5py.File(folder / "sensor_records.hdf5", "w") as records:
        for flight, (positions, attitudes) in flights.items():
            truth = records.create_group(f"{flight}/groundtruth")
            truth["position"], truth["attitude"] = np.array(positions, float), np.array(attitudes, float)
            for k in range(len(positions) // 4):
                save(folder / f"depth/{flight}/{k:06d}.PNG", np.full((H, W), 10, np.float16).view(np.uint16))
    return folder


def level(n: int):
    return [[k, 0, -5] for k in range(n)], [[1, 0, 0, 0]] * n


def test_the_camera_looks_along_the_drones_x_and_the_world_has_z_down(tmp_path) -> None:
    scene = opened(FORM, write(tmp_path, trajectory_0000=level(8)))
    np.testing.assert_allclose(scene.T_wc(1), [[0, 0, 1, 4], [1, 0, 0, 0], [0, 1, 0, -5], [0, 0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(scene.up, [0, 0, -1])
    np.testing.assert_allclose(scene.timestamps, [0, 0.04])


def test_an_attitude_leads_from_the_drone_to_the_world(tmp_path) -> None:
    """Turned by 90 degrees about z, which is down, the drone that looked north looks east."""
    half = np.sqrt(0.5)
    scene = opened(FORM, write(tmp_path, trajectory_0000=([[0, 0, 0]] * 4, [[half, 0, 0, half]] * 4)))
    np.testing.assert_allclose(scene.T_wc(0)[:3, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(scene.T_wc(0)[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-12)


def test_depth_is_along_the_ray_of_an_image_of_90_degrees(tmp_path) -> None:
    write(tmp_path, trajectory_0000=level(4))
    save(tmp_path / "depth/trajectory_0000/000000.PNG", np.full((1024, 1024), 10, np.float16).view(np.uint16))
    depth = open_dataset("midair", {"root": tmp_path}).scene(f"{tmp_path.name}-trajectory_0000").depth(0)
    assert depth[512, 512] == pytest.approx(10, rel=1e-5)
    assert depth[512, 0] == pytest.approx(10 / np.sqrt(1 + (511.5 / 512) ** 2), rel=1e-5)


def test_every_half_float_is_read_and_what_is_none_is_no_depth(tmp_path) -> None:
    bits = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    save(tmp_path / "a.PNG", bits)
    np.testing.assert_array_equal(read_half_floats(tmp_path / "a.PNG"), bits.view(np.float16).astype(np.float32))
    write(tmp_path, trajectory_0000=level(4))
    far = np.full((H, W), 1250, np.float16)
    far[0, :4] = 1249, np.inf, np.nan, -1
    save(tmp_path / "depth/trajectory_0000/000000.PNG", far.view(np.uint16))
    depth = opened(FORM, tmp_path).geometry(0).depth
    assert depth[0, 0] == 1249
    assert not (np.isfinite(depth) & (depth > 0)).ravel()[1:].any()


def test_each_flight_of_a_climate_is_a_scene_with_its_own_labels(tmp_path) -> None:
    folder = tmp_path / "Kite_training/sunny"
    frames = source(FORM.scale)
    for flight, order in (("trajectory_0000", frames), ("trajectory_0010", frames[::-1])):
        names = write_midair(folder, order, flight)
        write_labels(folder, names, order)
        write_labels(folder, names, order, "segmentation/{}.PNG")
    needed = {key: value() if callable(value) else value for key, value in FORM.options.items()}
    dataset = open_dataset("midair", {"root": tmp_path, "taxonomy": "midair"} | needed)
    assert dataset.scenes == ("Kite_training-sunny-trajectory_0000", "Kite_training-sunny-trajectory_0010")
    for name, order in zip(dataset.scenes, (frames, frames[::-1]), strict=True):
        scene = dataset.scene(name)
        assert (len(scene), scene.models, scene.ground_truth) == (COUNT, ("net",), True)
        for k, frame in enumerate(order):
            np.testing.assert_allclose(scene.T_wc(k), frame.T_wc, atol=1e-12)
            np.testing.assert_array_equal(scene.frame(k, "net").labels, frame.labels)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("position", np.zeros((3, 3)), "trajectory_0000 has 3 positions and 8 attitudes"),
        ("attitude", np.zeros((8, 3)), "attitude is no table of N x 4 numbers"),
        ("position", np.array([[b"a"] * 3] * 8), "position is no table of N x 3 numbers"),
        ("attitude", np.full((8, 4), 0.5) * 3, "the quaternion of pose 1 has length 3, not 1"),
        ("position", None, "has no trajectory_0000/groundtruth/position"),
    ],
)
def test_records_that_are_wrong_are_named(tmp_path, name, content, said) -> None:
    write(tmp_path, trajectory_0000=level(8))
    with h5py.File(tmp_path / "sensor_records.hdf5", "a") as records:
        del records[f"trajectory_0000/groundtruth/{name}"]
        if content is not None:
            records[f"trajectory_0000/groundtruth/{name}"] = content
    fails(DataError, f"sensor_records.hdf5: .*{said}", opened, FORM, tmp_path)


def test_links_to_other_files_are_not_followed(tmp_path) -> None:
    path = write(tmp_path, trajectory_0000=level(8)) / "sensor_records.hdf5"
    other = path.rename(tmp_path / "other.hdf5")
    with h5py.File(path, "w") as records:
        records["trajectory_0000"] = h5py.ExternalLink(str(other), "/trajectory_0000")
    fails(DataError, "has no trajectory_0000/groundtruth/position", read_flight, path, "trajectory_0000")


def test_images_without_a_row_or_a_number_are_named(tmp_path) -> None:
    folder = write(tmp_path, trajectory_0000=level(8))
    depth = folder / "depth/trajectory_0000/000001.PNG"
    depth.rename(depth.with_name("000002.PNG"))
    fails(DataError, "trajectory_0000 has 8 rows, but image 000002 goes with row 8", opened, FORM, folder)
    depth.with_name("000002.PNG").rename(depth.with_name("last.PNG"))
    fails(DataError, "'last' is no number of an image", opened, FORM, folder)


def test_what_is_no_hdf5_is_refused_in_one_line(tmp_path) -> None:
    folder = write(tmp_path, trajectory_0000=level(8))
    (folder / "sensor_records.hdf5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    fails(DataError, "sensor_records.hdf5: cannot be read", opened, FORM, folder)


def test_without_h5py_the_extra_is_named(tmp_path, monkeypatch) -> None:
    folder = write(tmp_path, trajectory_0000=level(8))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingDependencyError, match=r"h5py.*pip install 'semstab\[midair\]'"):
        read_flight(folder / "sensor_records.hdf5", "trajectory_0000")
