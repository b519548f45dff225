"""ROS bags: every container, encoding and source of poses gives the frames that were recorded, or one line."""

from __future__ import annotations

import contextlib
import dataclasses
import sqlite3
import struct
from pathlib import Path

import bag_writer as bags
import cv2
import dataset_writers as ds
import numpy as np
import pytest
from bag_writer import COLOR, COLOR_INFO, DEPTH, DEPTH_INFO, MAP, OPTICAL, START, STEP
from command_line import bench, error_of
from scipy.spatial.transform import Rotation

from semstab.datasets import open_dataset
from semstab.errors import DataError, MissingDependencyError

pytest.importorskip("rosbags")

HALF = STEP // 2


@pytest.fixture(scope="module")
def frames():
    return ds.source(1000)


def changed(frames, change):
    """What a robot records, each (topic, time, message) through `change`, which gives records instead of it."""
    return lambda ros: (
        new for topic, time, message in bags.records(ros, frames) for new in change(ros, topic, time, message)
    )


def without(*topics):
    return lambda _, topic, time, message: [] if topic in topics else [(topic, time, message)]


def opened(path: Path, **options):
    dataset = open_dataset("bag", {"root": path, "classes": ds.CLASSES} | options)
    return dataset.scene(dataset.scenes[0])


def frames_of(scene, model=None):
    return [scene.frame(k, model) if model else scene.geometry(k, color=True) for k in range(len(scene))]


def labelled(scene, frames):
    """The bag's geometry with the labels of the source."""
    return [dataclasses.replace(f, labels=g.labels) for f, g in zip(frames_of(scene), frames, strict=True)]


def write(tmp_path, frames, change, container="MCAP", name="run"):
    return bags.write_bag(tmp_path / name, container, changed(frames, change))


# --- containers


@pytest.mark.parametrize("container", bags.CONTAINERS)
def test_each_container_gives_the_voxels_of_its_source(container, tmp_path, frames):
    path = bags.write_bag(tmp_path / "run", container, lambda ros: bags.records(ros, frames))
    ds.write_labels(tmp_path / "run", bags.names_of(len(frames)), frames)
    scene = opened(path)
    assert (scene.name, scene.models, len(scene)) == ("run", ("net",), len(frames))
    found = frames_of(scene, "net")
    ds.assert_same_voxels(found, frames)
    for ours, theirs in zip(found, frames, strict=True):
        np.testing.assert_array_equal(ours.color, theirs.color)
        np.testing.assert_allclose(ours.T_wc, theirs.T_wc, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.diff(scene.timestamps), STEP / 1e9, atol=1e-6)
    assert open_dataset("bag", {"root": tmp_path}).scenes == ("run",)


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_a_file_of_a_rosbag2_alone_is_a_bag(suffix, tmp_path, frames):
    container = "sqlite3" if suffix == ".db3" else "MCAP"
    folder = bags.write_bag(tmp_path / "run", container, lambda ros: bags.records(ros, frames))
    (file,) = folder.glob(f"*{suffix}")
    ds.assert_same_voxels(labelled(opened(file), frames), frames)


def test_messages_of_one_bag_time_are_told_apart(tmp_path, frames):
    path = write(tmp_path, frames, lambda _, topic, __, message: [(topic, START, message)])
    ds.assert_same_voxels(labelled(opened(path), frames), frames)


# --- stamps


@pytest.mark.parametrize("container", bags.CONTAINERS)
def test_messages_that_were_recorded_late_are_sorted_by_their_header(container, tmp_path, frames):
    def late(_, topic, time, message):
        return [(topic, START + 10 * STEP if topic == DEPTH and time == START + 1 else time, message)]

    def recorded(ros):
        return sorted(changed(frames, late)(ros), key=lambda record: record[1])

    scene = opened(bags.write_bag(tmp_path / "run", container, recorded))
    ds.assert_same_voxels(labelled(scene, frames), frames)
    assert any(f"order    {DEPTH}: 1 messages come after a later stamp" in line for line in scene.sources)


def test_bag_time_replaces_headers_without_stamps(tmp_path, frames):
    def unstamped(ros, topic, time, message):
        for transform in getattr(message, "transforms", [message]):
            transform.header.stamp = ros.stamp(0)
        return [(topic, time, message)]

    path = write(tmp_path, frames, unstamped)
    with pytest.raises(DataError, match=f"all stamps in the headers of {DEPTH} are 0; set stamps: bag"):
        opened(path)
    ds.assert_same_voxels(labelled(opened(path, stamps="bag"), frames), frames)


def test_images_without_a_partner_are_left_out_and_counted(tmp_path, frames, caplog):
    path = write(
        tmp_path, frames,
        lambda _, topic, t, m: [] if topic == COLOR and t == START + STEP + 3 else [(topic, t, m)],
    )  # fmt: skip
    scene = opened(path)
    assert [scene.frame_name(k) for k in range(len(scene))] == [bags.names_of(4)[k] for k in (0, 2, 3)]
    assert "1 depth images have no colour image within 0.02 s (max_difference); left out" in caplog.text
    with pytest.raises(DataError, match=r"no image of .* is within 0.001 s of one of .*; set max_difference"):
        opened(path, max_difference=0.001)


# --- poses


def test_poses_between_two_stamps_are_interpolated_and_never_beyond_them(tmp_path, frames):
    first, last = START - HALF, START + 3 * STEP - HALF
    turn = Rotation.from_euler("y", 40, degrees=True).as_matrix()
    ends = {first: np.eye(4), last: np.eye(4)}
    ends[last][:3, :3], ends[last][:3, 3] = turn, (6, 0, 3)

    def rare(ros, topic, time, message):
        if topic == DEPTH and time == START + 1:
            yield from (("/tf", at, ros.transforms((at, MAP, OPTICAL, T))) for at, T in ends.items())
        if topic not in ("/tf", "/tf_static"):
            yield topic, time, message

    path = write(tmp_path, frames, rare)
    scene = opened(path)
    share = (START - first) / (last - first)
    expected = Rotation.from_euler("y", 40 * share, degrees=True).as_matrix()
    np.testing.assert_allclose(scene.T_wc(0)[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(scene.T_wc(0)[:3, 3], np.array([6, 0, 3]) * share, atol=1e-12)
    assert [scene.tracked(k) for k in range(4)] == [True, True, True, False]
    with pytest.raises(DataError, match=r"no frame lies between two poses .* at most 0.1 s apart; set max_pose_gap"):
        opened(path, max_pose_gap=0.1)


def test_the_world_is_the_map_or_the_frame_that_is_named(tmp_path, frames):
    path = write(tmp_path, frames, without())
    assert any(f"{OPTICAL} in map by odom, base_link, camera_link" in line for line in opened(path).sources)
    in_odom = opened(path, world_frame="odom").T_wc(2)
    np.testing.assert_allclose(bags.ODOM_IN_MAP @ in_odom, frames[2].T_wc, atol=1e-12)
    with pytest.raises(DataError, match=rf"world_frame: 'earth' is not above '{OPTICAL}' in /tf.*camera_link, base"):
        opened(path, world_frame="earth")
    names = "base_link, camera_color_optical_frame, camera_link, odom"
    hint = rf"camera_frame: one of {OPTICAL}, or record /tf_static"
    with pytest.raises(
        DataError, match=rf"'lidar', the frame of its images, is not in /tf, which has {names} \({hint}"
    ):
        opened(path, camera_frame="lidar")


def split(frames, tmp_path, container, gap=0, first="run"):
    """A recording in two files whose metadata.yaml is lost; what is static is in the first alone."""
    half, folder = START + 2 * STEP - HALF, tmp_path / "lost"
    folder.mkdir()
    for k in (0, 1):

        def part(ros, topic, time, message, k=k):
            return [(topic, time + k * gap, message)] if (time >= half) == bool(k) else []

        written = write(tmp_path, frames, part, container, f"part{k}")
        file = written if written.is_file() else next(path for path in written.iterdir() if path.suffix != ".yaml")
        file.rename(folder / f"{first}_{k}{file.suffix}")
    return folder


@pytest.mark.parametrize("container", bags.CONTAINERS)
def test_a_split_recording_without_metadata_is_one_bag(tmp_path, frames, container):
    folder = split(frames, tmp_path, container)
    dataset = open_dataset("bag", {"root": folder.parent, "classes": ds.CLASSES})
    assert "lost" in dataset.scenes
    scene = opened(folder)
    assert (scene.name, len(scene)) == ("lost", 4)
    ds.assert_same_voxels(labelled(scene, frames), frames)


def test_recordings_with_time_between_them_are_bags_each(tmp_path, frames):
    folder = split(frames, tmp_path, "MCAP", gap=10**11)
    assert open_dataset("bag", {"root": folder}).scenes == ("run_0", "run_1")


def test_the_frame_of_a_body_is_not_offered_as_that_of_the_camera(tmp_path, frames):
    folder = split(frames, tmp_path, "MCAP")
    with pytest.raises(DataError, match=r"is not in /tf, which has .*base_link.* \(record /tf_static, too, or give"):
        opened(folder / "run_1.mcap")


@pytest.mark.parametrize("folder", [True, False])
def test_a_truncated_mcap_is_mended_by_mcap_recover_wherever_it_lies(tmp_path, frames, folder):
    path = write(tmp_path, frames, without())
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-3000])
    with pytest.raises(DataError, match=r"not a whole bag .* or 'mcap recover'"):
        opened(path if folder else file)


def posed_by(make, frames):
    """Without /tf; a message of poses at each stamp instead."""

    def change(ros, topic, time, message):
        if topic == "/tf":
            at = message.transforms[0].header.stamp
            ns = at.sec * 10**9 + at.nanosec
            k = (ns - START) // STEP
            yield "/poses", time, make(ros, ns, frames[k].T_wc)
        else:
            yield topic, time, message

    return change


def test_odometry_of_the_base_leads_to_the_camera_by_static_transforms(tmp_path, frames):
    mounted = bags.LINK_IN_BASE @ bags.OPTICAL_IN_LINK

    def odometry(ros, ns, T):
        return ros.odometry(ns, T @ np.linalg.inv(mounted), bags.BASE)

    path = write(tmp_path, frames, posed_by(odometry, frames))
    ds.assert_same_voxels(labelled(opened(path), frames), frames)
    bare = write(
        tmp_path, frames,
        lambda *record: (stored for stored in posed_by(odometry, frames)(*record) if stored[0] != "/tf_static"),
        name="bare",
    )  # fmt: skip
    with pytest.raises(
        DataError, match=f"are of the frame 'base_link', from which no transform.*pose_frame: {OPTICAL}"
    ):
        opened(bare)
    offset = [*mounted[:3, 3].tolist(), *ds.quaternion(mounted[:3, :3]).tolist()]
    ds.assert_same_voxels(labelled(opened(bare, extrinsics=offset), frames), frames)
    np.testing.assert_allclose(
        opened(bare, pose_frame=OPTICAL).T_wc(1), frames[1].T_wc @ np.linalg.inv(mounted), atol=1e-12
    )


def test_pose_messages_and_a_tum_file_are_of_the_camera(tmp_path, frames):
    path = write(tmp_path, frames, posed_by(lambda ros, ns, T: ros.posed(ns, T), frames))
    scene = opened(path)
    assert any("poses    /poses in map, of the camera" in line for line in scene.sources)
    ds.assert_same_voxels(labelled(scene, frames), frames)
    none = write(tmp_path, frames, without("/tf", "/tf_static"), name="none")
    lines = [
        f"{(START + k * STEP) / 1e9:.6f} {ds.numbers([*f.T_wc[:3, 3], *ds.quaternion(f.T_wc[:3, :3])])}"
        for k, f in enumerate(frames)
    ]
    ds.write_lines(tmp_path / "poses.txt", lines)
    ds.assert_same_voxels(labelled(opened(none, trajectory=tmp_path / "poses.txt"), frames), frames)


# --- encodings


def bayer(rgb: np.ndarray) -> np.ndarray:
    """The mosaic of a sensor with red at (0, 0) and blue at (1, 1)."""
    mosaic = rgb[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = rgb[::2, ::2, 0], rgb[1::2, 1::2, 2]
    return mosaic


COLORS = {
    "bgr8": lambda rgb: rgb[..., ::-1],
    "rgba8": lambda rgb: np.dstack([rgb, rgb[..., 0]]),
    "bgra8": lambda rgb: np.dstack([rgb[..., ::-1], rgb[..., 0]]),
    "rgb16": lambda rgb: (rgb.astype("<u2") << 8) + 7,
}


@pytest.mark.parametrize("encoding", COLORS)
def test_colour_of_an_encoding_is_rgb(encoding, tmp_path, frames):
    def encoded(ros, topic, time, message):
        if topic == COLOR:
            rgb = message.data.reshape(ds.H, ds.W, 3)
            yield topic, time, ros.image(time - 3 + bags.LATER, COLORS[encoding](rgb), encoding, pad=5)
        else:
            yield topic, time, message

    scene = opened(write(tmp_path, frames, encoded))
    np.testing.assert_array_equal(scene.color(1), frames[1].color)


def test_a_mosaic_and_grey_become_rgb(tmp_path, frames):
    flat = np.broadcast_to(np.uint8([200, 120, 40]), (ds.H, ds.W, 3))
    for encoding, pixels, expected in (
        ("bayer_rggb8", bayer(flat), [200, 120, 40]), ("mono8", flat[..., 0], [200, 200, 200]),
    ):  # fmt: skip
        path = write(
            tmp_path, frames,
            lambda ros, topic, t, m, p=pixels, e=encoding: [
                (topic, t, ros.image(t - 3 + bags.LATER, p, e) if topic == COLOR else m)
            ],
            name=encoding,
        )  # fmt: skip
        color = opened(path).color(0)
        assert (color[4:-4, 4:-4] == expected).all()


@pytest.mark.parametrize("container", bags.CONTAINERS)
def test_compressed_images_are_read_as_raw_ones(container, tmp_path, frames):
    """Colour as PNG, depth as PNG after twelve bytes, where the transports of ROS put them."""

    def compressed(ros, topic, time, message):
        ns = time - 3 + bags.LATER
        if topic == COLOR:
            data = bags.png(message.data.reshape(ds.H, ds.W, 3))
            yield f"{topic}/compressed", time, ros.compressed(ns, data, "rgb8; png compressed bgr8")
        elif topic == DEPTH:
            data = struct.pack("<iff", 0, 0, 0) + bags.png(message.data.view("<u2").reshape(ds.H, ds.W))
            yield f"{topic}/compressedDepth", time, ros.compressed(time - 1, data, "16UC1; compressedDepth png")
        else:
            yield topic, time, message

    path = bags.write_bag(tmp_path / "run", container, changed(frames, compressed))
    found = labelled(opened(path), frames)
    ds.assert_same_voxels(found, frames)
    np.testing.assert_array_equal(found[2].color, frames[2].color)


def as_depth(encode):
    return lambda ros, topic, time, message: [
        (
            topic,
            time,
            encode(ros, time - 1, message.data.view("<u2").reshape(ds.H, ds.W)) if topic == DEPTH else message,
        )
    ]


def test_depth_in_metres_and_of_the_other_order_of_bytes(tmp_path, frames):
    def metres(ros, ns, mm):
        return ros.image(ns, np.where(mm == 0, np.nan, mm / np.float32(1000)).astype("<f4"), "32FC1", pad=8)

    def swapped(ros, ns, mm):
        return ros.image(ns, mm.astype(">u2"), "16UC1")

    for name, encode in (("metres", metres), ("swapped", swapped)):
        ds.assert_same_voxels(labelled(opened(write(tmp_path, frames, as_depth(encode), name=name)), frames), frames)


def test_compressed_depth_in_metres_is_inverse(tmp_path, frames):
    a, b = 1000.0, -3.5

    def inverse(ros, topic, time, message):
        if topic != DEPTH:
            yield topic, time, message
            return
        m = message.data.view("<u2").reshape(ds.H, ds.W) / 1000
        with np.errstate(divide="ignore"):
            v = np.where(m == 0, 0, a / m + b)
        data = struct.pack("<iff", 0, a, b) + bags.png(np.rint(np.where(m == 0, 0, v)).astype(np.uint16))
        yield f"{topic}/compressedDepth", time, ros.compressed(time - 1, data, "32FC1; compressedDepth png")

    depth = opened(write(tmp_path, frames, inverse)).depth(0)
    np.testing.assert_array_equal(depth == 0, frames[0].depth == 0)
    measured = depth > 0
    assert np.abs(1 / depth[measured] - 1 / frames[0].depth[measured]).max() <= 0.51 / a


# --- cameras


def ramp(shape) -> np.ndarray:
    H, W = shape
    v, u = np.mgrid[:H, :W]
    return np.dstack([u, v, u + v]).astype(np.uint8)


def test_a_lens_is_taken_out_of_colour_depth_and_labels(tmp_path, frames):
    """The images are those of a lens: each pixel holds where it is, so that it says where it was taken from."""
    D = [-0.4, 0.05, 0.001, -0.002, 0.01, 0.02, 0.0, 0.0]
    pixels = ramp((ds.H, ds.W))

    def distorting(ros, topic, time, message):
        if topic in (DEPTH_INFO, COLOR_INFO):
            message = ros.info(time, frames[0], D, "rational_polynomial")
        elif topic == COLOR:
            message = ros.image(time - 3 + bags.LATER, pixels, "rgb8")
            yield "/net/labels", time, ros.image(time - 3 + bags.LATER, pixels[..., 0] + np.uint8(100), "mono8")
        elif topic == DEPTH:
            message = ros.image(time - 1, pixels[..., 1].astype("<f4") + 1, "32FC1")
        yield topic, time, message

    path = write(tmp_path, frames, distorting)
    scene = opened(path, classes=[str(k) for k in range(200)])
    K = frames[0].intrinsics.matrix
    v, u = 8, 11
    ray = np.array([[(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0]])
    ((x, y),) = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, np.array(D))[0][0]
    assert abs(x - u) > 0.5
    frame = scene.frame(0, "net-labels")
    assert frame.depth[v, u] == round(y) + 1
    assert frame.labels[v, u] == round(x) + 100
    np.testing.assert_allclose(frame.color[v, u, :2], (x, y), atol=1)
    np.testing.assert_array_equal(scene.image(0), pixels)  # a model predicts on the image as it was sent
    plain = opened(path, rectified=True, classes=[str(k) for k in range(200)]).frame(0, "net-labels")
    np.testing.assert_array_equal(plain.labels, pixels[..., 0] + 100)


def test_rectified_images_take_the_projection_and_no_lens(tmp_path, frames):
    P = np.hstack([np.diag([50.0, 51.0, 1.0]), np.zeros((3, 1))])
    P[:2, 2] = 20, 15

    def rectified(ros, topic, time, message):
        if topic in (DEPTH_INFO, COLOR_INFO):
            message = ros.info(time, frames[0], [0.3, 0, 0, 0, 0], P=P)
        yield topic.replace("image_raw", "image_rect"), time, message

    scene = opened(write(tmp_path, frames, rectified))
    assert scene.intrinsics(0, (ds.H, ds.W)).fx == 50
    np.testing.assert_array_equal(scene.depth(0), frames[0].depth)


def test_unregistered_depth_is_looked_up_with_the_camera_of_colour_and_said(tmp_path, frames, caplog):
    """Colour sees half the field of view in as many pixels."""
    wide = frames[0].intrinsics
    tele = dataclasses.replace(wide, fx=2 * wide.fx, fy=2 * wide.fy)

    def other(ros, topic, time, message):
        if topic == COLOR_INFO:
            message = ros.info(time, dataclasses.replace(frames[0], intrinsics=tele))
        if topic in (COLOR, COLOR_INFO):
            message.header.frame_id = "tele_optical_frame"
        yield topic, time, message
        if topic == COLOR:
            yield "/labels", time, ros.image(time - 3 + bags.LATER, ramp((ds.H, ds.W))[..., 0], "mono8")

    scene = opened(write(tmp_path, frames, other), classes=[str(k) for k in range(200)])
    labels = scene.frame(0, "labels").labels
    u = np.arange(ds.W)
    expected = np.floor(2 * (u - wide.cx) + tele.cx + 0.5 + 1e-6)
    inside = (expected >= 0) & (expected < ds.W)
    np.testing.assert_array_equal(labels[ds.H // 2, inside], expected[inside])
    assert (labels[ds.H // 2, ~inside] == 255).all()
    assert "colour of 'tele_optical_frame': labels are looked up as if both saw from one point" in caplog.text


def test_a_camera_that_zooms_is_that_of_the_time(tmp_path, frames):
    def zooming(ros, topic, time, message):
        if topic in (DEPTH_INFO, COLOR_INFO) and time >= START + 2 * STEP:
            closer = dataclasses.replace(frames[0].intrinsics, fx=99.0)
            message = ros.info(time, dataclasses.replace(frames[0], intrinsics=closer))
        yield topic, time, message

    scene = opened(write(tmp_path, frames, zooming))
    fx = [scene.intrinsics(k, (ds.H, ds.W)).fx for k in range(4)]
    assert fx == [frames[0].intrinsics.fx] * 2 + [99.0] * 2


def test_a_lens_that_is_not_known_and_a_camera_that_is_not_calibrated_are_refused(tmp_path, frames):
    def odd(model, K=None):
        def change(ros, topic, time, message):
            if topic in (DEPTH_INFO, COLOR_INFO):
                message = ros.info(time, frames[0], [0.1, 0, 0, 0, 0], model)
                message.k = message.k if K is None else K
            yield topic, time, message

        return change

    with pytest.raises(DataError, match=r"camera_info: distortion 'modified_brown' with 5 coefficients is not read"):
        opened(write(tmp_path, frames, odd("modified_brown"), name="a"))
    with pytest.raises(DataError, match=r"the camera is not calibrated \(its K is 0\); set intrinsics"):
        opened(write(tmp_path, frames, odd("plumb_bob", np.zeros(9)), name="b"))


def test_images_that_were_not_taken_are_said(tmp_path, frames):
    def twice(ros, topic, time, message):
        yield topic, time, message
        if topic == COLOR:
            yield "/rear/image_raw", time, message

    scene = opened(write(tmp_path, frames, twice), color=COLOR, depth=DEPTH)
    assert [text for text in scene.sources if text.startswith("others")] == [
        "others   /rear/image_raw (set depth, color)"
    ]


# --- labels


@pytest.mark.parametrize(("dtype", "encoding"), [(np.uint8, "mono8"), (np.uint16, "mono16")])
def test_label_topics_are_sources_and_may_be_the_truth(dtype, encoding, tmp_path, frames):
    def with_labels(ros, topic, time, message):
        yield topic, time, message
        if topic == COLOR and time < START + 3 * STEP:
            k = (time - START) // STEP
            yield "/net/labels", time, ros.image(time - 3 + bags.LATER, frames[k].labels.astype(dtype), encoding)

    path = write(tmp_path, frames, with_labels)
    scene = opened(path)
    assert scene.models == ("net-labels",)
    found = scene.frame(1, "net-labels")
    np.testing.assert_array_equal(found.labels, frames[1].labels)
    assert scene.label_space("net-labels").classes == tuple(ds.CLASSES)
    assert [bool(scene.missing(k, ["net-labels"])) for k in range(4)] == [False, False, False, True]
    truth = opened(path, label_topics={"gt": "/net/labels"})
    assert (truth.models, truth.ground_truth) == ((), True)
    np.testing.assert_array_equal(truth.frame(1, "gt").labels, frames[1].labels)
    assert opened(path, label_topics={}).models == ()


@pytest.mark.parametrize("alias", [lambda name: name[:-3], lambda name: name.replace(".", "")])
def test_label_files_may_have_six_digits_or_whole_nanoseconds(alias, tmp_path, frames):
    path = write(tmp_path, frames, without())
    ds.write_labels(path, [alias(name) for name in bags.names_of(4)], frames)
    np.testing.assert_array_equal(opened(path).frame(3, "net").labels, frames[3].labels)


# --- what is missing or damaged


def test_camera_info_without_a_message_is_no_camera(tmp_path, frames):
    ds.write_rosbag2(tmp_path / "seq", frames)
    (file,) = (tmp_path / "seq").glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as base:
        base.execute("DELETE FROM messages WHERE topic_id IN (SELECT id FROM topics WHERE name LIKE '%camera_info')")
        base.commit()
    said = r"seq: no message of the camera info of /camera/aligned_depth_to_color/image_raw can be read; set intrinsics"
    with pytest.raises(DataError, match=said):
        opened(tmp_path / "seq")
    assert opened(tmp_path / "seq", intrinsics=[50, 50, 20, 15]).geometry(0).intrinsics.fx == 50


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        (
            (DEPTH,),
            r"holds no depth images \(16UC1, 32FC1 or compressedDepth\); record .*its topics: .*/tf_static TFMes",
        ),
        ((DEPTH_INFO, COLOR_INFO), r"holds no camera info; record .*its topics: .*color/image_raw Image \(4\)"),
        (("/tf", "/tf_static"), "holds no poses; record .*its topics: "),
        ((DEPTH, "/tf", "/tf_static"), r"holds no depth images \(.*\) and no poses"),
        (("/tf",), "no pose of the camera: no transform moves between"),
    ],
)
def test_a_bag_without_a_part_says_which_topics_it_has(lost, said, tmp_path, frames):
    path = write(tmp_path, frames, without(*lost))
    with pytest.raises(DataError, match=said) as caught:
        opened(path)
    assert str(path) in str(caught.value)


def test_a_bag_without_colour_has_the_names_of_its_depth(tmp_path, frames):
    scene = opened(write(tmp_path, frames, without(COLOR, COLOR_INFO)))
    assert (scene.frame_name(0), scene.color(0)) == ("1305031102.000000000", None)
    ds.assert_same_voxels(labelled(scene, frames), frames)


def test_topics_that_are_named_must_be_there(tmp_path, frames):
    path = write(tmp_path, frames, without())
    with pytest.raises(DataError, match=r"option depth: there is no topic '/camera/depth'; "):
        opened(path, depth="/camera/depth")
    with pytest.raises(DataError, match=rf"option color: {COLOR_INFO} is of type sensor_msgs/CameraInfo, not"):
        opened(path, color=COLOR_INFO)


@pytest.mark.parametrize("container", bags.CONTAINERS)
def test_a_truncated_bag_is_one_line(container, tmp_path, frames):
    path = bags.write_bag(tmp_path / "run", container, lambda ros: bags.records(ros, frames))
    file = path if path.is_file() else next(file for file in path.iterdir() if file.suffix != ".yaml")
    data = file.read_bytes()
    for share in (0.0, 0.02, 0.5, 0.95):
        file.write_bytes(data[: int(len(data) * share)])
        with pytest.raises(DataError, match=rf"{path}.*: not a whole bag \(.*\); record it to its end, or '") as caught:
            frames_of(opened(path))
        assert "\n" not in str(caught.value)


def test_a_topic_whose_name_is_no_text_is_damage(tmp_path, frames):
    folder = bags.write_bag(tmp_path / "run", "sqlite3", lambda ros: bags.records(ros, frames))
    (file,) = folder.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as base, base:
        base.execute("UPDATE topics SET name = x'0102' WHERE id = 1")
    with pytest.raises(DataError, match=rf"{file}: damaged: a topic is called b.*; record the bag again"):
        opened(file)


def test_an_image_that_is_shorter_than_it_says_is_named(tmp_path, frames):
    def cut(_, topic, time, message):
        if topic == DEPTH and time == START + STEP + 1:
            message.data = message.data[:-1]
        yield topic, time, message

    scene = opened(write(tmp_path, frames, cut))
    scene.depth(0)
    with pytest.raises(DataError, match=r"run:/camera/aligned_.*/1305031102.104000000.npy: 48x32 pixels 16UC1 in rows"):
        scene.depth(1)


def test_a_bag_and_a_file_that_is_none_are_named_on_the_command_line(tmp_path, frames):
    path = bags.write_bag(tmp_path / "run", "ROS 1", lambda ros: bags.records(ros, frames))
    out = bench("check", path, cwd=tmp_path)
    assert f"depth    {DEPTH} (16UC1), camera {DEPTH_INFO}" in " ".join(out.stdout.split()).replace(
        "depth /", "depth    /"
    )
    assert error_of("gone.bag", cwd=tmp_path).endswith("gone.bag: there is no such file")
    (tmp_path / "note.txt").write_text("no bag")
    assert "note.txt: a file, but no bag (.bag, .mcap, .db3)" in error_of("check", "note.txt", cwd=tmp_path)


def test_without_rosbags_the_extra_is_named(tmp_path, monkeypatch):
    import sys

    (tmp_path / "run.bag").write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(MissingDependencyError, match=r"bags need rosbags .*pip install 'semstab\[bags\]'"):
        opened(tmp_path / "run.bag")
