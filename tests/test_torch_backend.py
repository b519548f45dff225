"""Backend `torch` keeps the contract in either precision, and tensors are fused as frames are."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="pip install 'semstab[torch]'")

HAS_CUDA = torch.cuda.is_available()

from semstab import backends  # noqa: E402
from semstab.backends import torch_map, torch_operations, torch_storage  # noqa: E402
from semstab.backends.shared.association import back_project  # noqa: E402
from semstab.backends.torch_map import TorchMap, TorchMaps  # noqa: E402
from semstab.backends.torch_storage import DepthView, MapGrid, TensorPrediction  # noqa: E402
from semstab.data.frames import Frame, Intrinsics  # noqa: E402
from semstab.errors import ConfigError, DataError  # noqa: E402
from semstab.testing import EXACT, SUMS, BackendConformance, assert_same_map, random_frames, sight_line, voxels  # noqa: E402

CPU = torch.device("cpu")
K = 4


def new_map(voxel_size=0.4, num_classes=K, device="CPU:0", **options):
    return TorchMap(voxel_size, num_classes, device=device, **options)


def fused(frames, **options):
    backend = new_map(**options)
    for frame in frames:
        backend.integrate(frame)
    return backend.table()


def assert_equal(a, b):
    """The same numbers to the last bit."""
    assert voxels(a) == voxels(b)
    for column in (*EXACT, *SUMS):
        np.testing.assert_array_equal(getattr(a, column), getattr(b, column), err_msg=column)


# --- The contract -----------------------------------------------------------------------------------------------------


class TestTorch(BackendConformance):
    reach = 2**20

    def create(self, voxel_size, num_classes):
        return new_map(voxel_size, num_classes)


class TestTorchInSinglePrecision(BackendConformance):
    reach = 2**20
    tolerance = 5e-4
    voxel_share = 1e-4

    def create(self, voxel_size, num_classes):
        return new_map(voxel_size, num_classes, precision="float32")


if HAS_CUDA:

    class TestTorchOnCuda(TestTorch):
        def create(self, voxel_size, num_classes):
            return new_map(voxel_size, num_classes, device="CUDA:0")

    class TestTorchInSinglePrecisionOnCuda(TestTorchInSinglePrecision):
        def create(self, voxel_size, num_classes):
            return new_map(voxel_size, num_classes, device="CUDA:0", precision="float32")


# --- Precision and determinism ----------------------------------------------------------------------------------------


def survey(seed, camera=(4.5e5, 5.5e6, 80.0), shape=(90, 160)):
    """A view from a UAV in UTM-sized coordinates over rough ground, 30 to 90 m away."""
    rng = np.random.default_rng(seed)
    H, W = shape
    pitch = math.radians(50)
    T_wc = np.eye(4)
    T_wc[:3, :3] = [[1, 0, 0], [0, -math.sin(pitch), math.cos(pitch)], [0, -math.cos(pitch), -math.sin(pitch)]]
    T_wc[:3, 3] = np.array(camera) + rng.normal(0, 5, 3)
    depth = rng.uniform(30, 90, shape).astype(np.float32)
    labels = rng.integers(0, K, shape).astype(np.uint8)
    return Frame(seed, depth, Intrinsics(fx=W, fy=W, cx=W / 2, cy=H / 2), T_wc, labels=labels)


def voxel_of_pixels(frame, dtype):
    """(H, W, 3) voxel indices from the map's origin, as the backend finds them."""
    origin = tuple(int(x) for x in np.floor(frame.T_wc[:3, 3] / 0.2))
    association = torch_operations.associate(DepthView(torch.tensor(frame.depth), frame), MapGrid(0.2, origin, dtype))
    key = association.keys[association.voxel.to(torch.int64)].numpy()
    return np.stack([key >> 42, (key >> 21) & (2**21 - 1), key & (2**21 - 1)], axis=-1) - 2**20 + origin


def test_double_precision_decides_as_the_reference_at_every_pixel():
    for seed in range(2):
        frame = survey(seed)
        expected = np.floor(back_project(frame) / 0.2).T.reshape(*frame.shape, 3)
        np.testing.assert_array_equal(voxel_of_pixels(frame, torch.float64), expected)


def test_single_precision_differs_only_next_to_a_voxel_face():
    """In UTM-sized coordinates as well, since it counts from the camera's voxel: by 1e-4 m at most."""
    differing = points = 0
    for seed in range(8):
        frame = survey(seed)
        x_w = back_project(frame).T.reshape(*frame.shape, 3)
        double, single = (voxel_of_pixels(frame, dtype) for dtype in (torch.float64, torch.float32))
        differs = double != single
        to_face = np.abs(x_w / 0.2 - np.round(x_w / 0.2)) * 0.2
        assert (np.abs(double - single) <= 1).all()
        assert to_face[differs].max(initial=0) < 1e-4
        differing += np.count_nonzero(differs.any(axis=-1))
        points += x_w[..., 0].size
    assert 0 < differing < 1e-4 * points


def test_the_numbers_do_not_depend_on_how_pixels_are_grouped(monkeypatch):
    """Integer sums have no order: one chunk, or chunks of a few pixels, give the same bits."""
    frames = [*random_frames(3, count=4), survey(0, camera=(0, 0, 80), shape=(20, 30))]
    whole = fused(frames)
    for size in (50, 333):
        monkeypatch.setattr(torch_operations, "chunk_of", lambda device, size=size: size)
        assert_equal(fused(frames), whole)


def test_sums_of_scores_are_as_fine_as_they_say():
    """10^5 pixels of share 1/3 in one voxel, in units of 2^-45 (17 bits count the pixels), each rounded to nearest."""
    association = torch_operations.Association(
        torch.zeros(1, dtype=torch.int64), torch.zeros((100, 1000), dtype=torch.int32)
    )
    values = torch.tensor([[1.0], [2.0]]).expand(2, 10**5)
    evidence = torch_operations.sum_scores(association, torch_storage.Scores(values, softmax=False), 2)
    assert evidence.scale == 2.0**45
    s_bar = evidence.sums[:, 0].to(torch.float64) / (evidence.scale * evidence.pixels)
    assert s_bar.tolist() == pytest.approx([1 / 3, 2 / 3], abs=2.0**-46)


# --- Tensors ----------------------------------------------------------------------------------------------------------


def as_tensors(frame):
    depth = torch.tensor(frame.depth)
    if frame.labels is not None:
        return depth, {"labels": torch.tensor(frame.labels)}
    return depth, {"scores": torch.tensor(frame.scores).permute(2, 0, 1).contiguous()}


def fuse_tensors(backend, frame, depth=None, **said):
    depth = torch.tensor(frame.depth) if depth is None else depth
    return backend.integrate_tensors(depth, frame.intrinsics, frame.T_wc, index=frame.index, **said)


def test_tensors_are_fused_as_frames_are():
    frames = random_frames(1, count=4)
    from_frames, from_tensors, from_arrays = (new_map() for _ in range(3))
    for frame in frames:
        depth, said = as_tensors(frame)
        expected = from_frames.integrate(frame)
        report = fuse_tensors(from_tensors, frame, depth, **said)
        fuse_tensors(from_arrays, frame, depth.numpy(), **{kind: image.numpy() for kind, image in said.items()})
        times = {"seconds": 0, "association_seconds": 0, "update_seconds": 0}
        assert dataclasses.replace(report, **times) == dataclasses.replace(expected, **times)
    assert_equal(from_tensors.table(), from_frames.table())
    assert_equal(from_arrays.table(), from_frames.table())


def test_types_and_layouts_of_labels_and_depth():
    """Half the pixels of a larger image, transposed in memory, with a batch dimension, in any integer type."""
    frame = random_frames(2, count=1)[0]
    expected = fused([frame])
    for dtype, ignore in ((torch.uint8, 255), (torch.uint16, 65535), (torch.int32, -100), (torch.int64, 255)):
        ids = torch.tensor(frame.labels.astype(np.int64))
        ids[ids == 255] = ignore
        large = torch.zeros((2 * ids.shape[1], ids.shape[0]), dtype=torch.float32)
        large[::2] = torch.tensor(frame.depth).T
        backend = new_map()
        fuse_tensors(backend, frame, large[::2].T[None], labels=ids.to(dtype)[None])
        assert_equal(backend.table(), expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_logits_are_scores_after_a_softmax(dtype):
    frame = random_frames(4, count=1)[0]
    logits = (3 * torch.randn((K, *frame.shape), generator=torch.Generator().manual_seed(0))).to(dtype)
    logits.requires_grad_(dtype == torch.float32)
    x = logits.detach().to(torch.float64).numpy()
    s = np.exp(x) / np.exp(x).sum(axis=0)
    expected = fused([dataclasses.replace(frame, labels=None, scores=s.transpose(1, 2, 0))])
    for image in (logits, logits.permute(1, 2, 0).contiguous().permute(2, 0, 1), logits[None]):
        backend = new_map()
        fuse_tensors(backend, frame, logits=image)
        assert_same_map(backend.table(), expected, 1e-9 if dtype == torch.float64 else 2e-6)


def test_logits_that_are_not_numbers():
    """A class at -inf has share 0; NaN, +inf, and -inf everywhere are no logits, and their pixels are not there."""
    inf, nan = math.inf, math.nan
    line = sight_line(0, [(0.5 + i, 0) for i in range(5)])
    logits = torch.tensor([(0.0, 0, -inf), (nan, 0, 0), (inf, 0, 0), (-inf, -inf, -inf), (800, 0, -800)]).T
    backend = new_map(1.0, 3)
    assert fuse_tensors(backend, line, logits=logits[:, None, :]).points == 2
    table = backend.table()
    assert voxels(table) == [(0, 0, 0), (0, 0, 4)]
    np.testing.assert_allclose(table.evidence, [[0.5, 0.5, 0], [1, 0, 0]], atol=1e-7)


def test_inference_mode_leaves_the_map_as_usable_outside():
    """A map that is made, fed or grown where a model runs is fed and read elsewhere."""
    frames = [column_of(10, index=0), column_of(6000, index=1), column_of(20, index=2)]
    backend = new_map(1.0, 3)
    with torch.inference_mode():
        inside = new_map(1.0, 3)
        logits = torch.nn.functional.one_hot(torch.tensor(frames[1].labels, dtype=torch.int64), 3) * 100.0
        for backend_map in (backend, inside):
            backend_map.integrate(frames[0])
            fuse_tensors(backend_map, frames[1], logits=logits.permute(2, 0, 1))
    for backend_map in (backend, inside):
        backend_map.integrate(frames[2])
        assert_same_map(backend_map.table(), fused(frames, voxel_size=1.0, num_classes=3), 1e-6)


def test_a_pose_may_be_a_tensor():
    frame = random_frames(6, count=1)[0]
    backend = new_map()
    depth, said = as_tensors(frame)
    backend.integrate_tensors(depth, frame.intrinsics, torch.tensor(frame.T_wc), index=0, **said)
    assert_equal(backend.table(), fused([frame]))


def line_tensors(**said):
    """What is wrong with a view of three pixels, fused into a map that has seen another one; and the map it leaves."""
    backend = new_map(1.0, 3)
    backend.integrate(sight_line(0, [(0.5, 0)]))
    before = backend.table()
    good = sight_line(7, [(0.5, 1), (1.5, 1), (2.5, 2)])
    depth = said.pop("depth", torch.tensor(good.depth))
    with pytest.raises(DataError) as error:
        backend.integrate_tensors(depth, good.intrinsics, said.pop("T_wc", good.T_wc), index=7, **said)
    assert_equal(backend.table(), before)
    assert "\n" not in str(error.value)
    return str(error.value)


LABELS = torch.zeros((1, 3), dtype=torch.uint8)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({}, "labels, scores or logits, one of them; got none"),
        ({"labels": LABELS, "logits": torch.zeros(3, 1, 3)}, r"got \['labels', 'logits'\]"),
        ({"labels": LABELS + 5}, "frame 7, labels: label id 5 is outside 0 to 2"),
        ({"labels": LABELS.to(torch.int64) + 2**32}, "label id 4294967296"),
        ({"labels": LABELS.float()}, r"labels must be integers \(H, W\), got float32"),
        ({"labels": LABELS.bool()}, "got bool"),
        ({"labels": LABELS[0]}, r"got uint8 of shape \(3,\)"),
        ({"logits": torch.zeros(3, 2, 6)}, "frame 7, logits: logits are 6x2 but depth is 3x1"),
        ({"logits": torch.zeros(4, 1, 3)}, "frame 7, logits: logits hold 4 classes, the map 3"),
        ({"logits": torch.zeros((3, 1, 3), dtype=torch.int32)}, r"logits must be float \(K, H, W\), got int32"),
        ({"scores": torch.full((3, 1, 3), -1.0)}, "frame 7, scores: scores are negative; give logits as logits"),
        ({"labels": LABELS, "depth": torch.ones(2, 1, 3)}, r"depth must be \(H, W\), got shape \(2, 1, 3\)"),
        ({"labels": LABELS, "depth": torch.ones((1, 3), dtype=torch.int16)}, "depth is int16; convert it to metres"),
        ({"labels": LABELS, "depth": torch.full((1, 3), 3e6)}, r"frame 7 spans .* more than 2\^20 voxels"),
        ({"labels": LABELS, "depth": torch.full((1, 3), 3e9)}, r"frame 7 spans .* beyond 2\^31 voxels"),
        ({"labels": LABELS, "T_wc": 2 * np.eye(4)}, "frame 7, pose"),
    ],
)
def test_a_wrong_tensor_is_said_in_one_line_and_leaves_no_trace(wrong, message):
    from re import search

    assert search(message, line_tensors(**wrong))


def test_a_first_camera_out_of_reach_is_refused():
    backend = new_map(1.0, 3)
    for z in (2.0**31 - 2, -(2.0**40)):
        with pytest.raises(DataError, match=r"frame 4 has its camera at .* beyond 2\^31 voxels of 1 m"):
            backend.integrate(sight_line(4, [(0.0, 0)], start=(0, 0, z)))
    assert backend.integrate(sight_line(5, [(0.5, 0)], start=(0, 0, 2.0**30))).map_voxels == 1


def test_an_ignored_pixel_may_be_out_of_reach():
    backend = new_map(1.0, 3)
    report = backend.integrate(sight_line(0, [(0.5, 0), (3e6, 255), (2.0**40, 255)]))
    assert (report.points, report.map_voxels) == (1, 1)


# --- Several models ------------------------------------------------------------------------------------------------


def test_maps_of_several_models_are_as_if_made_alone():
    """Each ignores other pixels, one has other classes, and one is silent at times."""
    frames = random_frames(8, count=5)
    rng = np.random.default_rng(0)
    torch_map = TorchMaps(0.4, {"a": K, "b": K, "c": 9}, device="CPU:0")
    alone = {"a": new_map(), "b": new_map(), "c": new_map(num_classes=9)}
    for frame in frames:
        labels = {
            "a": rng.choice([0, 1, 255], frame.shape).astype(np.uint8),
            "b": rng.choice([1, 3, 255, 255], frame.shape).astype(np.uint8),
            "c": rng.integers(0, 9, frame.shape).astype(np.uint8),
        }
        if frame.index == 3:
            del labels["c"]
        said = {name: TensorPrediction(labels=image) for name, image in labels.items()}
        reports = torch_map.integrate_tensors(frame.depth, frame.intrinsics, frame.T_wc, said, index=frame.index)
        assert list(reports) == list(labels)
        for name, report in reports.items():
            expected = alone[name].integrate(dataclasses.replace(frame, labels=labels[name], scores=None))
            for count in ("points", "voxels", "new_voxels", "map_voxels"):
                assert getattr(report, count) == getattr(expected, count), (name, count)
            assert report.map_vss_all == pytest.approx(expected.map_vss_all, abs=1e-12)
    for name, backend in alone.items():
        assert_equal(torch_map.table(name), backend.table())


def test_one_model_that_cannot_be_fused_leaves_all_maps_as_they_were():
    frame = random_frames(9, count=1)[0]
    torch_map = TorchMaps(0.4, {"good": K, "bad": 2}, device="CPU:0")
    view = (frame.depth, frame.intrinsics, frame.T_wc)
    said = {name: TensorPrediction(labels=frame.labels) for name in ("good", "bad")}
    with pytest.raises(DataError, match="frame 0, labels of 'bad': label id 3 is outside 0 to 1"):
        torch_map.integrate_tensors(*view, said, index=0)
    assert len(torch_map.table("good")) == len(torch_map.table("bad")) == 0
    with pytest.raises(ConfigError, match="no map of 'other'; there is good, bad"):
        torch_map.integrate_tensors(*view, {"other": said["good"]}, index=0)
    with pytest.raises(ConfigError, match="no map of 'other'"):
        torch_map.table("other")
    with pytest.raises(ConfigError, match="names no model"):
        TorchMaps(0.4, {})


# --- Memory -----------------------------------------------------------------------------------------------------------


def column_of(count, index=0, along="z"):
    """A sight line through that many voxels of 1 m."""
    return sight_line(index, [(i + 0.5, i % 3) for i in range(count)], along=along)


@pytest.fixture
def small(monkeypatch):
    """New maps have room for 8 voxels."""
    monkeypatch.setattr(torch_map, "FIRST_ROWS", 8)


@pytest.mark.usefixtures("small")
def test_a_map_stops_at_its_bound_and_goes_on_with_what_it_knows():
    backend = new_map(1.0, 3, memory_gb=2e-4)
    backend.integrate(column_of(100))
    with pytest.raises(DataError, match=r"frame 1: to hold 5,100 voxels the map would take .* memory_gb is 0\.0002;"):
        backend.integrate(column_of(5000, index=1, along="x"))
    assert len(backend.table()) == 100
    assert backend.integrate(column_of(100, index=2)).map_voxels == 100
    assert backend.maps.bytes <= 2e5


@pytest.mark.usefixtures("small")
def test_a_map_takes_what_the_bound_leaves():
    """To grow by half would be too much; to grow by what is needed is not."""
    for memory_gb, capacity in ((None, 1200), (1.4e-4, 1000)):
        backend = new_map(1.0, 3, memory_gb=memory_gb)
        backend.integrate(column_of(800))
        backend.integrate(column_of(200, index=1, along="x"))
        assert backend.maps.storage.columns[""].capacity == capacity
        assert len(backend.table()) == 1000


def test_reserved_room_is_made_at_once_within_the_bound():
    backend = new_map(1.0, 3, reserve=5000)
    before = backend.maps.bytes
    backend.integrate(column_of(4000))
    assert backend.maps.bytes == before
    with pytest.raises(DataError, match=r"reserve = 5000: to hold 5,000 voxels"):
        new_map(1.0, 3, reserve=5000, memory_gb=1e-4)


def test_a_device_that_is_full_says_so(monkeypatch):
    backend = new_map(1.0, 3, reserve=8)
    backend.integrate(column_of(8))

    def full(*arguments, **options):
        raise RuntimeError("out of memory\nand advice")

    monkeypatch.setattr(torch_storage.Columns, "grow", full)
    with pytest.raises(DataError, match=r"frame 1: the device cpu has no room for \d+ voxels \(out of memory") as error:
        backend.integrate(column_of(100, index=1))
    assert "\n" not in str(error.value)
    monkeypatch.undo()
    assert len(backend.table()) == 8
    assert backend.integrate(column_of(100, index=1)).map_voxels == 100


@pytest.mark.usefixtures("small")
def test_the_estimate_covers_what_a_map_takes():
    backend = new_map(1.0, 20)
    backend.integrate(column_of(3000))
    assert backend.maps.bytes <= backends.expected_bytes("torch", 3000, 3000, 20) <= 3 * backend.maps.bytes


# --- Options ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"precision": "float16"}, "precision = 'float16': use float64 or float32"),
        ({"memory_gb": 0.0}, "memory_gb = 0: it must be positive"),
        ({"reserve": -1}, "reserve = -1"),
        ({"device": "TPU:0"}, "device 'TPU:0'"),
        ({"device": "meta"}, "device 'meta'"),
        ({"device": "CUDA:99"}, "device 'CUDA:99': torch sees"),
    ],
)
def test_options_that_cannot_be_used_are_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        new_map(**options)


def test_a_device_that_is_no_name_is_one_line():
    with pytest.raises(ConfigError, match="device '1' is not one; use CPU:0 or CUDA:0"):
        backends.create("torch", voxel_size=0.2, num_classes=2, device=1)


def test_the_default_device_is_the_accelerator_where_there_is_one():
    backend = backends.create("torch", voxel_size=0.2, num_classes=2)
    assert backend.device.type == ("cuda" if HAS_CUDA else "cpu")
    assert backend.events() is None
