import dataclasses
import json
import math
import re
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semstab import Events, VoxelTable, backends
from semstab.data.voxel_keys import in_order
from semstab.errors import DataError
from semstab.metrics import entropy, vss
from semstab.testing import EXACT, SEQUENCES, SUMS, as_frames, assert_same_map, checks, sight_line, voxels


def reference(frames, voxel_size=1.0, K=3):
    backend = backends.create("numpy", voxel_size=voxel_size, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return backend


TABLE = reference(as_frames([[(0.5, 0), (1.2, 1), (1.4, 2)], [(1.5, 1), (3.5, 2)]])).table()
EVENTS = reference(as_frames([[(0.5, 0), (1.2, 1), (1.4, 2)], [(1.5, 1), (3.5, 2)]])).events()


def fields(table):
    return {field.name: getattr(table, field.name) for field in dataclasses.fields(table)}


# --- The table --------------------------------------------------------------------------------------------------------


def test_a_table_knows_its_size():
    assert (len(TABLE), TABLE.K, TABLE.index.tolist()) == (3, 3, [[0, 0, 0], [0, 0, 1], [0, 0, 3]])


def test_centres_lie_in_the_middle_of_voxels():
    table = reference([sight_line(0, [(0.1, 0)], start=(-0.1, 0.3, 0))], voxel_size=0.25).table()
    assert table.centers.tolist() == [[-0.125, 0.375, 0.125]]


def test_columns_are_read_only_and_of_their_types():
    types = dict.fromkeys(EXACT, "int32") | {"pixels": "int64"} | dict.fromkeys(SUMS, "float64")
    for name, dtype in types.items():
        column = getattr(TABLE, name)
        assert (name, column.dtype) == (name, dtype)
        with pytest.raises((ValueError, TypeError), match=r"read-only|not support item assignment"):
            column[0] = 0


def test_the_callers_columns_stay_writable():
    op = np.ones(3, np.int32)
    dataclasses.replace(TABLE, op=op)
    op[0] = 2


@pytest.mark.parametrize("name", [*EXACT[1:], *SUMS])
def test_columns_must_be_of_one_length(name):
    with pytest.raises(DataError, match=rf"column '{name}' has 2 rows, expected 3"):
        dataclasses.replace(TABLE, **{name: getattr(TABLE, name)[:2]})


@pytest.mark.parametrize("index", [[2, 1, 3], [0, 0, 1], [1, 3, 2]])
@pytest.mark.parametrize("axis", ["ix", "iy", "iz"])
def test_rows_must_be_sorted_and_distinct(axis, index):
    same = {name: np.zeros(3, np.int32) for name in ("ix", "iy", "iz")}
    with pytest.raises(DataError, match="distinct and sorted"):
        dataclasses.replace(TABLE, **same | {axis: np.array(index)})


def test_the_first_differing_axis_decides_the_order():
    ix, iy, iz = [-1, -1, 0], [5, 6, -9], [2, -(2**31), 2**31 - 1]
    assert len(dataclasses.replace(TABLE, ix=ix, iy=iy, iz=iz)) == 3


def test_classes_name_the_columns_of_evidence():
    assert dataclasses.replace(TABLE, classes=("a", "b", "c")).classes == ("a", "b", "c")
    with pytest.raises(DataError, match=r"evidence of shape \(3, 3\) for 2 classes"):
        dataclasses.replace(TABLE, classes=("a", "b"))
    with pytest.raises(DataError, match=r"evidence of shape \(3,\)"):
        dataclasses.replace(TABLE, evidence=np.ones(3))


# --- The log of observations ------------------------------------------------------------------------------------------


@checks
@given(SEQUENCES)
def test_the_log_sums_to_what_an_incremental_backend_has(sequence):
    frames = as_frames(sequence)
    with patch("semstab.backends.open3d_blocks.INITIAL_BYTES", 0):  # a small map is made faster
        incremental = backends.create("open3d", voxel_size=1.0, num_classes=3)
    for frame in frames:
        incremental.integrate(frame)
    assert_same_map(reference(frames).events().table(), incremental.table(), 1e-12)


def test_beliefs_are_normalised_sums_of_the_observations_so_far():
    events = reference(as_frames([[(0.5, 0), (1.5, 2)], [(0.5, 1)], [(0.5, 1)]])).events()
    assert events.voxel.tolist() == [0, 0, 0, 1]
    expected = [[1, 0, 0], [1 / 2, 1 / 2, 0], [1 / 3, 2 / 3, 0], [0, 0, 1]]
    assert events.beliefs() == pytest.approx(np.array(expected))
    assert (events.drift() > 0).tolist() == [False, True, True, False]


def test_rows_of_the_log_are_grouped_by_voxel():
    for voxel in ([1, 0, 1, 2], [0, 0, 2, 2], [1, 1, 2, 3]):
        with pytest.raises(DataError, match="grouped by voxel"):
            dataclasses.replace(EVENTS, voxel=np.array(voxel))
    with pytest.raises(DataError, match="column 'frame' has 3 rows, expected 4"):
        dataclasses.replace(EVENTS, frame=EVENTS.frame[:3])


def test_a_log_of_nothing_has_an_empty_table():
    events = reference([]).events()
    assert (len(events), len(events.table()), events.table().K) == (0, 0, 3)


# --- Files ------------------------------------------------------------------------------------------------------------

int32 = st.integers(-(2**31), 2**31 - 1)


@st.composite
def tables(draw):
    """Any table: every column holds what its type can hold."""
    index = sorted(draw(st.sets(st.tuples(int32, int32, int32), max_size=6)))
    n, K = len(index), draw(st.integers(2, 5))
    columns = dict(zip(("ix", "iy", "iz"), np.array(index, np.int32).reshape(n, 3).T, strict=True))
    columns |= {name: draw(hnp.arrays(np.int32, n, elements=int32)) for name in ("op", "first_frame", "last_frame")}
    columns |= {name: draw(hnp.arrays(np.float64, n)) for name in SUMS[1:]}
    columns |= {"pixels": draw(hnp.arrays(np.int64, n)), "evidence": draw(hnp.arrays(np.float64, (n, K)))}
    names = tuple(draw(st.lists(st.text(min_size=1), min_size=K, max_size=K)))
    return VoxelTable(
        **columns,
        voxel_size=draw(st.floats(1e-3, 1e3)),
        classes=draw(st.sampled_from([(), names])),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("voxels")


@checks
@given(table=tables())
def test_a_table_comes_back_from_its_file(folder, table):
    table.save(folder / "map.parquet")
    loaded = VoxelTable.load(folder / "map.parquet")
    for name, value in fields(table).items():
        np.testing.assert_array_equal(getattr(loaded, name), value, err_msg=name, strict=name in EXACT + SUMS)


@checks
@given(sequence=SEQUENCES)
def test_a_log_comes_back_from_its_file(folder, sequence):
    events = reference(as_frames(sequence)).events()
    events.save(folder / "events.parquet")
    loaded = Events.load(folder / "events.parquet")
    for name, value in fields(events).items():
        np.testing.assert_array_equal(getattr(loaded, name), value, err_msg=name)


def test_other_programs_read_the_table(tmp_path):
    TABLE.save(tmp_path / "map.parquet", extra={"vss": vss(TABLE), "entropy": entropy(TABLE)})
    content = pq.read_table(tmp_path / "map.parquet")
    assert set(content.column_names) == {*EXACT, *SUMS, "vss", "entropy"}
    assert content["iz"].to_pylist() == [0, 1, 3]
    assert content["evidence"].to_pylist() == TABLE.evidence.tolist()
    assert content["vss"].to_pylist() == vss(TABLE).tolist()
    assert_same_map(VoxelTable.load(tmp_path / "map.parquet"), TABLE, 0)


def test_the_log_in_a_file_says_which_voxel_each_row_is(tmp_path):
    EVENTS.save(tmp_path / "events.parquet")
    content = pq.read_table(tmp_path / "events.parquet")
    assert content["iz"].to_pylist() == [0, 1, 1, 3]
    assert voxels(Events.load(tmp_path / "events.parquet").table()) == voxels(TABLE)


def test_undefined_extra_values_stay_undefined(tmp_path):
    TABLE.save(tmp_path / "map.parquet", extra={"sbd": np.array([math.nan, 0.5, 1])})
    assert math.isnan(pq.read_table(tmp_path / "map.parquet")["sbd"][0].as_py())


@pytest.mark.parametrize("kind", [VoxelTable, Events])
@pytest.mark.parametrize("content", [None, b"", b"not a table", "truncated", "a folder"])
def test_a_damaged_file_is_one_line_with_its_path(tmp_path, kind, content):
    path = tmp_path / "map.parquet"
    if content == "a folder":
        path.mkdir()
    elif content == "truncated":
        TABLE.save(path)
        path.write_bytes(path.read_bytes()[:-100])
    elif content is not None:
        path.write_bytes(content)
    assert_refused(kind, path)


def test_a_table_is_no_log_and_a_log_no_table(tmp_path):
    TABLE.save(tmp_path / "table.parquet")
    EVENTS.save(tmp_path / "events.parquet")
    assert_refused(Events, tmp_path / "table.parquet")
    assert_refused(VoxelTable, tmp_path / "events.parquet")


def rewritten(path, about=None, **columns):
    """The file of a table with other columns, or with other metadata."""
    TABLE.save(path)
    content = pq.read_table(path)
    for name, values in columns.items():
        content = content.set_column(content.column_names.index(name), name, pa.array(values))
    metadata = content.schema.metadata if about is None else about
    pq.write_table(content.replace_schema_metadata(metadata), path)
    return path


@pytest.mark.parametrize(
    "about",
    [
        {},
        {"semstab": "{"},
        {"semstab": "{}"},
        {"semstab": "[]"},
        {"semstab": json.dumps({"schema": 1})},
        {"semstab": json.dumps({"schema": 2, "kind": "VoxelTable", "voxel_size": 1, "classes": []})},
    ],
)
def test_a_parquet_file_of_another_program_is_refused(tmp_path, about):
    assert_refused(VoxelTable, rewritten(tmp_path / "map.parquet", about))


@pytest.mark.parametrize(
    "columns",
    [
        {"iz": [3, 1, 0]},
        {"iz": ["a", "b", "c"]},
        {"op": [1, None, 2]},
        {"evidence": [1.0, 1.0, 1.0]},
        {"evidence": [[1.0], [1.0, 2.0], [1.0]]},
    ],
    ids=["unsorted", "text", "null", "flat evidence", "ragged evidence"],
)
def test_columns_that_make_no_table_are_refused(tmp_path, columns):
    assert_refused(VoxelTable, rewritten(tmp_path / "map.parquet", **columns))


def assert_refused(kind, path):
    with pytest.raises(DataError, match=rf"^{re.escape(str(path))}: [^\n]*$"):
        kind.load(path)


@pytest.mark.parametrize("table", [TABLE, EVENTS])
def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch, table):
    path = tmp_path / "map.parquet"
    table.save(path)
    old = path.read_bytes()

    def write_half(writer, content):
        writer.where.write_bytes(old[:20])
        raise OSError("no space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", write_half)
    with pytest.raises(OSError, match="no space left"):
        table.save(path)
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["map.parquet"]


@pytest.mark.parametrize("span", [50, 2**31 - 1], ids=["packed", "too far apart for keys"])
def test_voxels_are_sorted_by_their_columns_however_far_apart_they_are(span):
    index = np.random.default_rng(3).integers(-span, span, (500, 3))
    index[::3, 0] = index[0, 0]
    expected = np.array(sorted(index.tolist()))
    np.testing.assert_array_equal(index[in_order(index)], expected)
    assert len(in_order(index[:0])) == 0
