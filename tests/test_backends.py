"""The backends that ship with the package keep the contract, and agree with the paper read once more by an oracle."""

import dataclasses
import math
import runpy
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracle import Oracle

from semstab import Frame, Intrinsics, backends
from semstab.backends.numpy_reference import NumpyReference
from semstab.core.files import read_json
from semstab.errors import ConfigError, DataError
from semstab.metrics import dominant, entropy, sbd, vss
from semstab.testing import EXACT, SUMS, BackendConformance, checks, random_frames, sight_line, voxels

K = 3


class TestNumpy(BackendConformance):
    def create(self, voxel_size, num_classes):
        return backends.create("numpy", voxel_size=voxel_size, num_classes=num_classes)


def open3d_map(voxel_size, num_classes, initial_bytes=0, **options):
    """A map that starts small: it is made faster, and has to grow."""
    with patch("semstab.backends.open3d_blocks.INITIAL_BYTES", initial_bytes):
        return backends.create("open3d", voxel_size=voxel_size, num_classes=num_classes, **options)


def numba_map(voxel_size, num_classes, **options):
    return backends.create("numba", voxel_size=voxel_size, num_classes=num_classes, **options)


class TestNumba(BackendConformance):
    """With the log of observations, and as a large map, whose table takes the memory of its hash.

    The oracle below compares a map without a log.
    """

    reach = 2**20

    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def large(cls):
        with patch("semstab.backends.numba_hash.LARGE", 1):
            yield

    def create(self, voxel_size, num_classes):
        return numba_map(voxel_size, num_classes, history=True)


class TestNumbaInSinglePrecision(BackendConformance):
    reach = 2**20
    tolerance = 5e-4

    def create(self, voxel_size, num_classes):
        return backends.create("numba", voxel_size=voxel_size, num_classes=num_classes, evidence="float32")


class TestOpen3DByRows(BackendConformance):
    """The rows of the touched voxels go to the host and back, as they do on a CUDA device."""

    reach = 2**20

    def create(self, voxel_size, num_classes):
        backend = open3d_map(voxel_size, num_classes, initial_bytes=2**24)
        backend.in_place = False
        return backend


class TestOpen3D(BackendConformance):
    """With room for 64 blocks to begin with, of an odd size: the map grows again and again."""

    reach = 2**20

    def create(self, voxel_size, num_classes):
        return open3d_map(voxel_size, num_classes, block_resolution=7)

    def test_a_map_with_room_for_another_ones_blocks_never_grows_and_is_the_same(self) -> None:
        hits = [(7.0 * i + 0.5, i % 3) for i in range(200)]
        growing, ready = (open3d_map(0.25, 3) for _ in range(2))
        growing.integrate(sight_line(0, hits))
        ready.reserve(growing.room())
        before = ready.grid.hashmap().capacity()
        ready.integrate(sight_line(0, hits))
        assert growing.room() == 200
        assert ready.grid.hashmap().capacity() == before >= 200
        assert ready.table().evidence[:].tolist() == growing.table().evidence[:].tolist()

    def test_a_first_frame_beyond_the_room(self) -> None:
        """The first frame alone needs 200 blocks; the second one sees the same voxels again."""
        hits = [(7.0 * i + 0.5, i % 3) for i in range(200)]
        table = self.fuse(sight_line(0, hits), sight_line(1, hits))
        assert table.op.tolist() == [2] * 200
        assert dominant(table).tolist() == [i % 3 for i in range(200)]


class TestOracle(BackendConformance):
    def create(self, voxel_size, num_classes):
        return Oracle(voxel_size, num_classes)

    def fuse_case(self, case):
        if case == "voxels_65536":
            pytest.skip("131,584 pixels take plain Python half a minute; the case's own formula is as independent")
        return super().fuse_case(case)


# --- The oracle: backends against the paper, on frames that hypothesis invents ----------------------------------------


@st.composite
def rotations(draw):
    """A rotation matrix from a quaternion of small integers."""
    w, x, y, z = draw(st.tuples(*[st.integers(-3, 3)] * 4).filter(any))
    n = w * w + x * x + y * y + z * z
    R = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.array(R) / n


depths = st.sampled_from([0.0, -1.0, math.nan, math.inf]) | st.floats(0.125, 4, width=32)
scores = st.sampled_from([0.0, math.nan, math.inf]) | st.floats(0, 1, width=16)


@st.composite
def frames(draw, index):
    shape = draw(st.tuples(st.integers(1, 4), st.integers(1, 4)))
    T_wc = np.eye(4)
    T_wc[:3, :3] = draw(rotations())
    T_wc[:3, 3] = draw(st.tuples(*[st.floats(-3, 3)] * 3))
    labels = hnp.arrays(draw(st.sampled_from([np.uint8, np.uint16])), shape, elements=st.integers(0, K - 1))
    soft = draw(st.booleans())
    given_labels = None if soft else draw(labels)
    if given_labels is not None:
        ignored = draw(hnp.arrays(bool, shape))
        given_labels[ignored] = np.iinfo(given_labels.dtype).max
    return Frame(
        index=index,
        depth=draw(hnp.arrays(np.float32, shape, elements=depths)),
        intrinsics=Intrinsics(*draw(st.tuples(*[st.floats(1, 4)] * 2, *[st.floats(-2, 4)] * 2))),
        T_wc=T_wc,
        labels=given_labels,
        scores=draw(hnp.arrays(np.float16, (*shape, K), elements=scores)) if soft else None,
    )


sequences = st.integers(1, 4).flatmap(lambda n: st.tuples(*(frames(index) for index in range(n))))


@pytest.mark.parametrize("make", [NumpyReference, open3d_map, numba_map])
@settings(checks, max_examples=60)
@given(sequence=sequences, voxel_size=st.sampled_from([0.2, 0.5, 1.7]))
def test_a_backend_is_what_the_paper_says(make, sequence, voxel_size):
    backend, oracle = make(voxel_size, K), Oracle(voxel_size, K)
    for frame in sequence:
        report, expected = backend.integrate(frame), oracle.integrate(frame)
        for count in ("frame", "points", "voxels", "new_voxels", "map_voxels"):
            assert getattr(report, count) == getattr(expected, count), count
        assert report.drift_sum == pytest.approx(expected.drift_sum, abs=1e-9)
    table, rows = backend.table(), oracle.rows()
    assert voxels(table) == rows
    for row, q in enumerate(rows):
        assert table.op[row] == oracle.op(q)
        assert table.pixels[row] == oracle.pixels(q)
        assert (table.first_frame[row], table.last_frame[row]) == (oracle.first_frame(q), oracle.last_frame(q))
        assert table.evidence[row] == pytest.approx(oracle.accumulated(q)[-1], abs=1e-9)
        assert table.drift_sum[row] == pytest.approx(oracle.drift(q), abs=1e-9)
        assert table.self_sum[row] == pytest.approx(oracle.self_sum(q), abs=1e-9)
        assert table.frame_entropy_sum[row] == pytest.approx(oracle.frame_entropy_sum(q), abs=1e-9)
        assert vss(table)[row] == pytest.approx(oracle.vss(q), abs=1e-9)
        assert sbd(table)[row] == pytest.approx(oracle.sbd(q), abs=1e-9, nan_ok=True)
        assert entropy(table)[row] == pytest.approx(oracle.entropy(q), abs=1e-9)


# --- The golden file: numbers stay what they were ---------------------------------------------------------------------

GOLDEN = runpy.run_path(str(Path(__file__).parent / "golden" / "regenerate.py"))


def leaves(value, path=""):
    """Every number, name and null of nested dictionaries and lists, by its path; null is NaN."""
    if isinstance(value, dict | list | tuple):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {k: v for key, item in items for k, v in leaves(item, f"{path}/{key}").items()}
    return {path: math.nan if value is None else value}


@pytest.mark.parametrize("name", ["numpy", "numba", "open3d"])
def test_the_map_is_the_golden_one(name):
    actual, expected = leaves(GOLDEN["golden"](name)), leaves(read_json(GOLDEN["FILE"]))
    assert actual.keys() == expected.keys()
    for path, value in expected.items():
        if isinstance(value, str):
            assert actual[path] == value, path
        else:
            assert actual[path] == pytest.approx(value, rel=0, abs=1e-12, nan_ok=True), path


# --- What is particular to one backend --------------------------------------------------------------------------------


def test_the_reference_keeps_the_history():
    reference = backends.create("numpy", voxel_size=1.0, num_classes=3)
    reference.integrate(sight_line(4, [(0.5, 0), (1.2, 1), (1.4, 2)]))
    reference.integrate(sight_line(2, [(1.5, 1)]))
    events = reference.events()
    assert events.voxel.tolist() == [0, 1, 1]
    assert events.frame.tolist() == [4, 4, 2]
    assert events.pixels.tolist() == [1, 2, 1]
    assert events.evidence.tolist() == [[1, 0, 0], [0, 0.5, 0.5], [0, 1, 0]]


@pytest.mark.parametrize("soft", [False, True])
def test_numba_keeps_the_same_history(soft):
    frames = [frame for frame in random_frames(seed=11, count=8) if (frame.scores is not None) == soft]
    assert len(frames) > 1
    reference, fast = backends.create("numpy", voxel_size=0.3, num_classes=4), numba_map(0.3, 4, history=True)
    for frame in frames:
        reference.integrate(frame)
        fast.integrate(frame)
    expected, actual = reference.events(), fast.events()
    for name in ("ix", "iy", "iz", "voxel", "frame", "pixels"):
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name), err_msg=name)
    np.testing.assert_allclose(actual.evidence, expected.evidence, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("open3d", {"block_resolution": 0}, "block_resolution"),
        ("open3d", {"block_resolution": 65}, "block_resolution"),
        ("open3d", {"device": "TPU:0"}, "device"),
        ("open3d", {"device": "CUDA:99"}, "CUDA:99"),
        ("numpy", {"device": "CPU:0"}, "'numpy' has no option 'device'; it takes none"),
        ("numba", {"threads": 0}, "threads = 0: use 1 to"),
        ("numba", {"evidence": "float16"}, "evidence = 'float16': use float64 or float32"),
    ],
)
def test_options_that_cannot_be_used_are_refused(name, options, message):
    assert backends.takes_option("open3d", "device")
    assert not backends.takes_option("numpy", "device")
    with pytest.raises(ConfigError, match=message):
        backends.create(name, voxel_size=1.0, num_classes=3, **options)
    with pytest.raises(ConfigError, match=message):
        backends.check_options(name, voxel_size=1.0, num_classes=3, **options)


@pytest.mark.parametrize("number", [0, 2])
def test_the_number_of_a_cuda_device_is_below_the_number_of_devices(number):
    o3c = pytest.importorskip("open3d").core
    with (
        patch.object(o3c.cuda, "device_count", return_value=number),
        pytest.raises(ConfigError, match=f"device 'CUDA:{number}': Open3D sees {number} CUDA devices here"),
    ):
        backends.check_options("open3d", voxel_size=1.0, num_classes=3, device=f"CUDA:{number}")


@pytest.mark.parametrize("name", ["numpy", "numba", "open3d", "open3d-projective"])
def test_options_are_checked_without_a_map(name):
    cls = backends.REGISTRY.load(name)
    with patch.object(cls, "__init__", autospec=True, side_effect=AssertionError("a map was made")):
        backends.check_options(name, voxel_size=1.0, num_classes=3)
        with pytest.raises(ConfigError, match="voxel_size = 0"):
            backends.check_options(name, voxel_size=0.0, num_classes=3)


@pytest.mark.parametrize("name", ["numba", "open3d"])
def test_the_numbers_do_not_depend_on_the_number_of_threads(name):
    import numba

    tables = []
    for threads in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(threads)
        backend = backends.create(name, voxel_size=0.25, num_classes=4)
        reports = [dataclasses.replace(backend.integrate(f), **NO_TIMES) for f in random_frames(seed=3, count=6)]
        tables.append((backend.table(), reports))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    (one, reports_one), (many, reports_many) = tables
    for column in (*EXACT, *SUMS):
        np.testing.assert_array_equal(getattr(one, column), getattr(many, column), err_msg=column)
    assert reports_one == reports_many


NO_TIMES = {"seconds": 0.0, "association_seconds": 0.0, "update_seconds": 0.0}


def test_points_beyond_the_reach_are_refused_with_their_extent():
    backend = backends.create("numba", voxel_size=0.001, num_classes=3)
    backend.integrate(sight_line(0, [(0.5, 0)]))
    with pytest.raises(DataError, match=r"frame 7 spans .* more than 2\^20 voxels of 0\.001 m .* use larger voxels"):
        backend.integrate(sight_line(7, [(0.5, 0), (5000.0, 1)]))
    assert len(backend.table()) == 1
