"""Clouds in ROS bags: every container, type of field and source of poses gives the scans that were recorded."""

from __future__ import annotations

import dataclasses
import sqlite3
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import bag_writer as bags
import numpy as np
import pytest
import scan_writers as sw
from bag_writer import BASE, CLOUDS, LIDAR, MAP, START, STEP
from command_line import bench
from dataset_writers import assert_same_voxels, numbers, source, write_lines
from posed_scene import fails
from scipy.spatial.transform import Rotation

from semstab.datasets import open_dataset, recognise
from semstab.datasets.bag.reading import OpenBag
from semstab.errors import ConfigError, DataError

pytest.importorskip("rosbags")

CLASSES = tuple("abcdef")


@pytest.fixture(scope="module")
def scans():
    return [sw.room(k, 1500) for k in range(sw.COUNT)]


def opened(path, **options):
    dataset = open_dataset("bag_scans", {"root": path, "classes": CLASSES} | options)
    return dataset.scene(dataset.scenes[0])


def write(tmp_path, scans, change=None, container="MCAP", name="run", **how):
    """What a robot records, each record through `change`, which gives records instead of it."""

    def entries(ros):
        recorded = bags.cloud_records(ros, scans, **how)
        return recorded if change is None else (new for record in recorded for new in change(ros, *record))

    return bags.write_bag(tmp_path / name, container, entries)


def with_clouds(change):
    """Records with each cloud changed: `change(ros, stamp, cloud)`."""
    return lambda ros, topic, t, message: [(topic, t, change(ros, t - 1, message) if topic == CLOUDS else message)]


def without(*topics):
    return lambda _, topic, t, message: [] if topic in topics else [(topic, t, message)]


def frames_of(scene, model="label"):
    return [scene.frame(k, model) for k in range(len(scene))]


def same(scene, scans, model="label"):
    for frame, scan in zip(frames_of(scene, model), scans, strict=True):
        np.testing.assert_array_equal(frame.points[0], scan.points)
        np.testing.assert_array_equal(frame.labels[0], scan.walls)
        np.testing.assert_allclose(frame.T_wc, scan.T, rtol=0, atol=1e-9)


# --- what is read


@pytest.mark.parametrize("container", bags.CONTAINERS)
@pytest.mark.parametrize("tf", [True, False], ids=["tf", "odometry"])
def test_each_container_gives_the_scans_that_were_recorded(container, tf, tmp_path, scans):
    scene = opened(write(tmp_path, scans, container=container, tf=tf))
    assert (scene.name, scene.models, scene.ground_truth, len(scene)) == ("run", ("label",), False, sw.COUNT)
    same(scene, scans)
    np.testing.assert_allclose(np.diff(scene.timestamps), STEP / 1e9, atol=1e-6)
    assert f"points   {CLOUDS} of {LIDAR}, classes: label" in scene.sources
    where = (
        f"{LIDAR} in {MAP} by odom, {BASE}" if tf else f"/odometry in odom, of {BASE}; {LIDAR} in it from /tf_static"
    )
    assert any(where in line and "around 4 of 4 scans" in line for line in scene.sources)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "layout", [{}, {"big": True}, {"height": 30, "pad": 7}], ids=["rows", "big endian", "organised"]
)
def test_fields_of_any_type_and_place_are_read(dtype, layout, tmp_path, scans):
    same(opened(write(tmp_path, scans, dtype=dtype, **layout)), scans)


def test_its_voxels_are_those_of_a_points_folder(tmp_path, scans):
    off_the_borders = sw.rigid((0, 0, 0), (0.0037, 0.0041, 0.0043))  # of voxels, on which the walls are
    scans = [dataclasses.replace(scan, T=off_the_borders @ scan.T) for scan in scans]
    for name, scan in zip(sw.write_points(tmp_path / "folder", scans), scans, strict=True):
        sw.predict_points(tmp_path / "folder", name, scan.walls)
    folder = sw.opened(sw.SCANS["points_folder, NPY"], tmp_path / "folder")
    assert_same_voxels(frames_of(opened(write(tmp_path, scans))), frames_of(folder, "net"))


@pytest.mark.parametrize("suffix", [".npy", ".label"])
def test_labels_may_be_beside_the_bag_by_the_stamp(suffix, tmp_path, scans):
    path = write(tmp_path, scans, container="ROS 1")
    assert path == tmp_path / "run.bag"
    folder = tmp_path / "run/labels/net"
    folder.mkdir(parents=True)
    names = [bags.clouds_of(4)[0], "1305031102.100000000", "1305031102.200000", bags.clouds_of(4)[3]]
    for name, scan in zip(names, scans, strict=True):
        if suffix == ".npy":
            np.save(folder / f"{name}.npy", scan.walls)
        else:
            (folder / f"{name}.label").write_bytes(scan.walls.astype("<u4").tobytes())
    scene = opened(path, label_source="gt")
    assert (scene.models, scene.ground_truth) == (("net",), True)
    same(scene, scans, "net")
    same(scene, scans, "gt")
    assert (opened(path, label_field="").models, opened(path).models) == (("net",), ("net", "label"))
    fails(ConfigError, "two label sources are called 'net'; rename one", opened, path, label_source="net")


def renamed(new, change=lambda values: values):
    """The records with the field `label` called otherwise, and of other values."""

    def cloud(ros, stamp, message):
        k = (stamp - START) // STEP
        columns = bags.columns_of(sw.room(k, 1500))
        values = columns.pop("label")
        return ros.cloud(stamp, {**columns, new: change(values)})

    return with_clouds(cloud)


@pytest.mark.parametrize("name", ["class", "semantic", "sem_class", "mine"])
def test_the_field_of_classes_is_found_by_its_name_or_given(name, tmp_path, scans):
    path = write(tmp_path, scans, renamed(name, lambda values: values.astype(np.float32)))
    if name == "mine":
        assert opened(path).models == ()
        fails(
            DataError,
            f"{CLOUDS}, .*the cloud has no field 'mina'; did you mean 'mine'",
            opened,
            path,
            label_field="mina",
        )
    same(opened(path, label_field=name if name == "mine" else None), scans, name)


def test_classes_that_are_no_whole_numbers_are_refused_and_nan_is_none(tmp_path, scans):
    def scores(values):
        return np.where(np.arange(1500) == 7, 0.25, values).astype(np.float32)

    scene = opened(write(tmp_path, scans, renamed("class", scores)))
    said = r"points.class/1305031102000000000.npy: the field 'class' holds 0.25, which is no class.*; set label_field"
    fails(DataError, said, scene.frame, 0, "class")

    def lost(values):
        return np.where(np.arange(1500) == 7, np.nan, values).astype(np.float64)

    frame = opened(write(tmp_path, scans, renamed("class", lost), name="nan")).frame(0, "class")
    assert (frame.labels[0, 7], np.count_nonzero(~frame.valid)) == (65535, 1)


def test_points_of_nan_are_not_valid(tmp_path, scans):
    def holes(ros, stamp, message):
        scan = scans[(stamp - START) // STEP]
        columns = bags.columns_of(scan)
        columns["y"] = np.where(np.arange(1500) % 3 == 0, np.nan, columns["y"]).astype(np.float32)
        return ros.cloud(stamp, columns, height=3)

    frame = opened(write(tmp_path, scans, with_clouds(holes))).frame(1, "label")
    np.testing.assert_array_equal(frame.valid[0], np.arange(1500) % 3 != 0)


# --- poses


def test_poses_are_interpolated_and_never_extrapolated(tmp_path, scans):
    def late(_, topic, t, message):
        return [] if topic == "/odometry" and t >= START + 3 * STEP else [(topic, t, message)]

    path = write(tmp_path, scans, late, tf=False)
    assert [opened(path).tracked(k) for k in range(4)] == [True, True, True, False]
    moved = opened(path, time_offset=0.05)
    assert [moved.tracked(k) for k in range(4)] == [True, True, True, False]
    fails(DataError, r"no scan lies between two poses of /odometry .*max_pose_gap", opened, path, time_offset=100)


def test_poses_of_the_sensor_or_with_extrinsics_need_no_tf(tmp_path, scans):
    def posed(ros, topic, t, message):
        if topic == "/odometry":
            yield "/pose", t, ros.posed(t, scans[min((t - START) // STEP, 3)].T)
        elif topic == CLOUDS:
            yield topic, t, message

    scene = opened(write(tmp_path, scans, posed, tf=False))
    same(scene, scans)
    assert any("/pose in map, of the sensor" in line for line in scene.sources)
    path = write(tmp_path, scans, without("/tf_static"), tf=False, name="bare")
    said = f"of the frame '{BASE}', from which no transform leads to the sensor's frame '{LIDAR}'; set extrinsics"
    fails(DataError, said, opened, path)
    same(opened(path, extrinsics=[0.2, 0, 0.9, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]), scans)


def test_frames_that_are_not_in_tf_are_named(tmp_path, scans):
    path = write(tmp_path, scans)
    fails(
        DataError,
        "no pose of the sensor: 'lidar', the frame of its clouds, is not in /tf, which has base_link, odom, os_",
        opened, path, sensor_frame="lidar",
    )  # fmt: skip
    fails(DataError, "option world_frame: 'earth' is not above", opened, path, world_frame="earth")

    def unframed(_ros, _stamp, message):
        message.header.frame_id = "none"
        return message

    path = write(tmp_path, scans, with_clouds(unframed), name="unframed")
    fails(DataError, "'none', the frame of its clouds, is not in /tf", opened, path)
    same(opened(path, sensor_frame=LIDAR), scans)


def test_poses_of_a_file_and_the_clock_of_the_bag(tmp_path, scans):
    def unstamped(ros, topic, t, message):
        if topic == CLOUDS:
            message.header.stamp = ros.stamp(0)
            yield topic, t - 1, message

    path = write(tmp_path, scans, unstamped)
    turns = Rotation.from_matrix([scan.T[:3, :3] for scan in scans]).as_quat()
    times = [f"{1305031102 + k / 10:.6f}" for k in range(4)]
    rows = [f"{time} {numbers(scan.T[:3, 3])} {numbers(q)}" for time, scan, q in zip(times, scans, turns, strict=True)]
    write_lines(tmp_path / "poses.txt", rows)
    given = {"trajectory": tmp_path / "poses.txt"}
    fails(DataError, f"all stamps in the headers of {CLOUDS} are 0; set stamps: bag", opened, path, **given)
    same(opened(path, stamps="bag", **given), scans)
    fails(DataError, "holds no poses; record these, too", opened, path, stamps="bag")


def test_of_two_topics_the_one_with_classes_is_read_or_the_one_that_is_named(tmp_path, scans):
    def twice(ros, topic, t, message):
        yield topic, t, message
        if topic == CLOUDS:
            columns = bags.columns_of(scans[(t - START) // STEP])
            del columns["label"]
            for late in (0, STEP // 4):
                yield "/a/raw", t + late, ros.cloud(t - 1 + late, columns)

    path = write(tmp_path, scans, twice)
    scene = opened(path)
    assert (len(scene), scene.sources[-1]) == (4, "others   /a/raw (set points)")
    same(scene, scans)
    other = opened(path, points="/a/raw")
    assert (len(other), other.models, other.sources[-1]) == (8, (), f"others   {CLOUDS} (set points)")


# --- what is missing or damaged


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        (
            (CLOUDS,),
            r"holds no clouds \(sensor_msgs/PointCloud2\); record .*its topics: /tf_static TFMessage \(1\), /tf",
        ),
        (("/tf", "/tf_static"), r"holds no poses; record .*its topics: /ouster/points PointCloud2 \(4\)"),
        (("/tf",), "no pose of the sensor: no transform moves between"),
    ],
)
def test_a_bag_without_a_part_says_which_topics_it_has(lost, said, tmp_path, scans):
    fails(DataError, said, opened, write(tmp_path, scans, without(*lost)))


def test_a_topic_that_is_named_must_be_there(tmp_path, scans):
    path = write(tmp_path, scans)
    fails(
        DataError,
        "option points: there is no topic '/ouster/point'; did you mean",
        opened,
        path,
        points="/ouster/point",
    )
    fails(
        DataError,
        "option points: /tf is of type tf2_msgs/TFMessage, not sensor_msgs/PointCloud2",
        opened,
        path,
        points="/tf",
    )


def damaged(change):
    def cloud(ros, stamp, message):
        if stamp == START + STEP:
            change(ros, message)
        return message

    return with_clouds(cloud)


def set_(**values):
    return lambda ros, message: [setattr(message, name, value) for name, value in values.items()]


def field_set(k, **values):
    return lambda ros, message: [setattr(message.fields[k], name, value) for name, value in values.items()]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda ros, m: setattr(m, "data", m.data[:-1]),
            r"1 rows of \d+ bytes, each of 1500 points of \d+ bytes with 'label'.* do not fit",
        ),
        (set_(row_step=10), "1 rows of 10 bytes"),
        (set_(width=2**32 - 1), "do not fit into"),
        (set_(height=2**32 - 1), "do not fit into"),
        (set_(point_step=0), "points of 0 bytes"),
        (field_set(4, offset=2**31), "with 'label' at 2147483648, do not fit"),
        (field_set(4, datatype=99), "field 'label' has datatype 99 and count 1; expected one number"),
        (field_set(4, count=3), "field 'label' has datatype 4 and count 3"),
        (field_set(4, name="other"), "the cloud has no field 'label'"),
        (field_set(1, name="other"), "the cloud has no field 'x'"),
        (field_set(1, datatype=6), "x, y, z are uint32, not FLOAT32 or FLOAT64"),
        (set_(fields=[]), "the cloud has no field 'label'; it has none at all"),
    ],
)
@pytest.mark.parametrize("container", ["ROS 1", "MCAP"])
def test_a_damaged_cloud_is_one_line(container, change, said, tmp_path, scans):
    scene = opened(write(tmp_path, scans, damaged(change), container))
    scene.frame(0, "label")
    fails(DataError, rf"run.*:{CLOUDS}.*/1305031102100000000.npy: .*{said}", scene.frame, 1, "label")


def test_clouds_that_the_bag_counts_but_has_not_are_one_line(tmp_path, scans):
    bag = write(tmp_path, scans, container="sqlite3")
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as table:
        table.execute("DELETE FROM messages WHERE topic_id IN (SELECT id FROM topics WHERE name = ?)", (CLOUDS,))
        table.commit()
    with pytest.raises(DataError, match=f"run, {CLOUDS}: holds no message that can be read; record the bag again"):
        opened(bag)


def test_clouds_without_a_point_are_left_out(tmp_path, scans, caplog):
    path = write(tmp_path, scans, damaged(set_(width=0, row_step=0, data=np.zeros(0, np.uint8))))
    assert len(opened(path)) == 3
    assert f"1 clouds of {CLOUDS} have no point; left out" in caplog.text
    empty = with_clouds(lambda r, s, m: (set_(width=0, row_step=0, data=np.zeros(0, np.uint8))(r, m), m)[1])
    fails(DataError, "holds no scan; expected", opened, write(tmp_path, scans, empty, name="empty"))


# --- recognition, the command line, memory


def test_a_bag_with_depth_is_of_images_and_one_with_clouds_of_scans(tmp_path, scans):
    path = write(tmp_path, scans, container="ROS 1")
    assert recognise(path)[0] == recognise(tmp_path)[0] == "bag_scans"
    both = bags.write_bag(
        tmp_path / "both/run", "MCAP", lambda ros: [*bags.records(ros, source(1000)), *bags.cloud_records(ros, scans)]
    )
    assert recognise(both)[0] == "bag"
    out = bench("check", path, "--set", "dataset.options.classes=[a, b, c, d, e, f]", cwd=tmp_path)
    assert f"points {CLOUDS} of {LIDAR}, classes: label" in " ".join(out.stdout.split())


def test_memory_does_not_grow_with_the_bag(tmp_path):
    scan = sw.room(0, 20_000)

    def peak(count):
        path = write(tmp_path, [scan] * count, container="sqlite3", name=f"of{count}")
        tracemalloc.start()
        try:
            scene = opened(path)
            for k in range(count):
                scene.frame(k, "label")
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(2)
    assert peak(24) < peak(6) + 20_000 * 27


@pytest.mark.parametrize("options", [{}, {"label_source": "gt"}], ids=["model", "truth"])
def test_a_cloud_with_classes_is_read_once(options, tmp_path, scans, monkeypatch):
    """For its points, its classes and its digest; other topics and threads have messages of their own."""
    scene = opened(write(tmp_path, scans), **options)
    taken, message = [], OpenBag.message
    monkeypatch.setattr(OpenBag, "message", lambda bag, topic, place: taken.append(place) or message(bag, topic, place))
    model = options.get("label_source", "label")
    with ThreadPoolExecutor(2) as pool:
        labels = pool.map(lambda k: scene.frame(k, model).labels[0], range(sw.COUNT))
        for found, scan in zip(labels, scans, strict=True):
            np.testing.assert_array_equal(found, scan.walls)
    assert len(taken) == len({*taken}) == sw.COUNT
    scene.digest(range(sw.COUNT), model)
    assert len(taken) == 2 * sw.COUNT
