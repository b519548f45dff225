"""A few damaged files of each kind, the same every time; what an hour of `make fuzz` found comes by name."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import fuzz
import kinds
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from image_files import npy_bytes, npz_bytes

from semstab import VoxelTable
from semstab.configure import load_config, resolve
from semstab.core.files import parse_json
from semstab.data.georeference import wkt
from semstab.datasets import open_dataset
from semstab.datasets.files.surfaces import Surface, open_las
from semstab.datasets.formats.disk import natural
from semstab.datasets.formats.ply import Header
from semstab.engine.tiles import TileResult
from semstab.errors import ConfigError, DataError, summarize_error
from semstab.models.names import class_names
from semstab.models.segearth_ov import read_prompts
from semstab.report.figures.maps import Overview
from semstab.report.saved_run import read_series
from semstab.statistics import SpotObservations
from semstab.statistics.cluster_sums import ClusterSums

EACH = 8
"""Inputs of a kind."""


@pytest.fixture(scope="module")
def every(tmp_path_factory) -> list[kinds.Kind]:
    """Those that take no run; of runs' own files see tests/faults."""
    folder = tmp_path_factory.mktemp("fuzz")
    parts = (kinds.of_images, kinds.of_surfaces, kinds.of_settings, kinds.of_datasets)
    return [kind for part in parts for kind in part(folder / part.__name__)]


def test_damaged_files_are_read_or_refused_in_one_line(every) -> None:
    refused, faults = 0, []
    with fuzz.watched():
        for _, (kind, file, content) in zip(range(EACH * len(every)), fuzz.inputs(every, seed=23), strict=False):
            outcome = fuzz.attempt(kind, file, content)
            refused += outcome.refused
            faults += [f"{kind.name}: {outcome.fault}"] if outcome.fault else []
    assert faults == []
    assert refused > EACH * len(every) / 4


def test_what_is_unkind_is_seen(tmp_path) -> None:
    """The judge itself: tracebacks, names of exceptions, several lines, hanging."""

    def read(_: Path) -> None:
        exec(file.read_text())

    file = tmp_path / "code.py"
    kind = kinds.Kind("code", (file,), read)
    data_error = "from semstab.errors import DataError\nraise DataError"
    judged = {
        "pass": None,
        f"{data_error}('file.txt: line 3 is no pose')": None,
        f"{data_error}('file.txt: (EOFError)')": "an exception as message",
        "1 / 0": "Traceback",
        "while True: pass": "hangs",
    }
    file.write_text("pass")
    with fuzz.watched():
        for code, fault in judged.items():
            found = fuzz.attempt(kind, file, code.encode(), slow=0.2).fault
            assert found is None if fault is None else found is not None and fault in found, code
    assert fuzz.unkind("a\nb") is not None
    assert fuzz.unkind("a" * 401) is not None


def test_every_damage_is_that_of_its_seed(every) -> None:
    first, again = ([content for _, (*_, content) in zip(range(99), fuzz.inputs(every, 5), strict=False)] for _ in "ab")
    assert first == again
    assert len({bytes(content) for content in first}) > 90


@pytest.mark.parametrize(
    ("place", "form", "value"),
    [(0, "4s", b"LAS "), (94, "<H", 12), (96, "<I", 2**30), (100, "<I", 2**31), (104, "B", 0x9F), (243, "<I", 2**31)],
)
def test_a_las_header_that_claims_too_much_is_refused_before_it_is_believed(tmp_path, place, form, value) -> None:
    content = bytearray(kinds.small_las(tmp_path / "a.laz").read_bytes())
    struct.pack_into(form, content, place, value)
    (tmp_path / "a.laz").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.laz: "), open_las(tmp_path / "a.laz") as reader:
        list(reader.chunk_iterator(10))


def test_chunks_of_laz_that_cannot_be_are_refused(tmp_path) -> None:
    """Lazrs ends the process where its memory does not suffice for the table."""
    content = bytearray(kinds.small_las(tmp_path / "a.laz").read_bytes())
    (start,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, start)
    for place, form, value, match in ((table + 4, "<I", 2**31, "names 2147483648 chunks"), (start, "<q", 7, "not in")):
        damaged = content.copy()
        struct.pack_into(form, damaged, place, value)
        (tmp_path / "a.laz").write_bytes(damaged)
        with pytest.raises(DataError, match=match), open_las(tmp_path / "a.laz"):
            pass


def test_sizes_in_laz_are_held_against_the_file_before_memory_is_taken(tmp_path) -> None:
    """In the LASzip record: points of a chunk, bytes of an item; in the header: points."""
    path = kinds.small_las(tmp_path / "a.laz")
    content = path.read_bytes()
    record = content.index(b"laszip encoded") - 2 + 54
    for place, form, value, match in (
        (record + 12, "<I", 2**31 - 1, "chunks of 2,147,483,647 points"),
        (record + 36, "<H", 60_000, "do not hold"),
        (247, "<Q", 10**9, "do not hold the 1,000,000,000 points"),
    ):
        damaged = bytearray(content)
        struct.pack_into(form, damaged, place, value)
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=match), open_las(path):
            pass
    path.write_bytes(content)
    with open_las(path) as reader:
        assert len(reader.read()) == reader.header.point_count


@pytest.mark.parametrize(
    "lines",
    [
        "element vertex", "element vertex x", "element vertex -1\nproperty float x", "element", "",
        "element vertex 1\nproperty float x\nproperty float x", "element vertex 1\nproperty",
    ],
)  # fmt: skip
def test_a_ply_header_that_says_nothing_is_refused(tmp_path, lines) -> None:
    path = tmp_path / "a.ply"
    path.write_text(f"ply\nformat binary_little_endian 1.0\n{lines}\nend_header\n")
    with path.open("rb") as file, pytest.raises(DataError, match=r"a\.ply: "):
        Header.read(file, path)


def test_names_that_no_file_can_have(tmp_path) -> None:
    for name in ("a" * 5000, "../city", "a\0b"):
        (tmp_path / "run.yaml").write_text(yaml.safe_dump({"dataset": name}))
        with pytest.raises(ConfigError, match="dataset"):
            resolve(load_config(tmp_path / "run.yaml"))


def test_digits_without_end_are_sorted_and_half_characters_refused(tmp_path) -> None:
    assert sorted(["b2", "b" + "9" * 6000, "b10"], key=natural) == ["b2", "b10", "b" + "9" * 6000]
    (tmp_path / "prompts.yaml").write_text('classes: [a, b]\nbackground: "\\ud800"')
    with pytest.raises(ConfigError, match=r"prompts\.yaml: "):
        read_prompts(tmp_path / "prompts.yaml")
    (tmp_path / "run.yaml").write_text("0x1f: []\n")
    with pytest.raises(ConfigError, match=r"run\.yaml: a name or a text is no text"):
        load_config(tmp_path / "run.yaml")


def test_a_mesh_of_two_coordinates_is_refused(tmp_path) -> None:
    (tmp_path / "a.obj").write_text("v 1 2\nv 2 3\nv 3 1\nf 1 2 3\n")
    with pytest.raises(DataError, match=r"a\.obj: "):
        Surface(tmp_path / "a.obj").triangles.bounds  # noqa: B018


def test_a_mesh_with_a_number_beyond_all_is_refused(tmp_path) -> None:
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 {'9' * 25}\n")
    with pytest.raises(DataError, match=r"a\.obj: "):
        Surface(tmp_path / "a.obj").triangles.bounds  # noqa: B018


def test_a_saved_frame_with_a_damaged_header_is_refused(tmp_path) -> None:
    frame = {"frame": np.array(3), "labels": np.zeros((2, 3)), "palette": np.zeros((1, 3))}
    path = tmp_path / "s__m.npz"
    path.write_bytes(npz_bytes(**frame))
    assert (Overview.load(path).frame, Overview.load(path).color) == (3, None)
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in frame.items():
            archive.writestr(f"{name}.npy", npy_bytes(array).replace(b"'shape': (2,", b"'shape': ((("))
    with pytest.raises(DataError, match="not a saved frame"):
        Overview.load(path)


@pytest.mark.parametrize("text", [b"a,a\n1,2\n", b"\xff,b\n1,2\n"])
def test_a_series_whose_columns_have_no_names_is_refused(tmp_path, text) -> None:
    (tmp_path / "s.csv").write_bytes(text)
    with pytest.raises(DataError, match=r"s\.csv: cannot be read"):
        read_series(tmp_path / "s.csv")


def test_no_exceptions_name_is_told() -> None:
    assert summarize_error(OSError("Couldn't read: TProtocolException: Invalid data")) == "Couldn't read: Invalid data"
    assert "Error" not in summarize_error(EOFError())


def test_json_nested_too_deeply_is_refused_wherever_it_stands(tmp_path) -> None:
    deep = b"[" * 100_000
    pq.write_table(pa.table({"x": [1]}).replace_schema_metadata({"semstab": deep}), tmp_path / "a.parquet")
    for load in (VoxelTable.load, SpotObservations.load, ClusterSums.load):
        with pytest.raises(DataError, match=r"a\.parquet: "):
            load(tmp_path / "a.parquet")
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(deep)
    with pytest.raises(ConfigError, match="is no reference system"):
        wkt('{"a":' * 50_000, "crs")


def test_a_tile_whose_header_ends_early_is_computed_again(tmp_path) -> None:
    body = npy_bytes(np.zeros(3)).replace(b"'shape': (3,)", b"'shape': (((")
    with zipfile.ZipFile(tmp_path / "tile.npz", "w") as archive:
        archive.writestr("series.npy", body)
    assert TileResult.load(tmp_path / "tile.npz") is None


@pytest.mark.parametrize("content", [b"\xff\xfe\0x", b"", b"\n\n"])
def test_names_of_classes_that_are_no_text_are_refused(tmp_path, content) -> None:
    (tmp_path / "names.txt").write_bytes(content)
    with pytest.raises(ConfigError, match=r"classes .*names\.txt: "):
        class_names(str(tmp_path / "names.txt"))


def test_a_folder_whose_name_no_file_system_takes_is_not_there() -> None:
    with pytest.raises(DataError, match="there is no such folder"):
        open_dataset("posed_folder", {"root": "a" * 5000, "classes": ["a", "b"]})
