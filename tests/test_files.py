import math
import os
import stat
import zipfile

import numpy as np
import pytest

from semstab.core.files import (
    atomic_path,
    keep_only,
    read_arrays,
    read_json,
    write_arrays,
    write_json,
    write_stack,
    write_text,
)
from semstab.errors import DataError


def test_a_file_is_written_whole(tmp_path):
    write_text(tmp_path / "a" / "b.txt", "größer")
    assert (tmp_path / "a" / "b.txt").read_bytes() == "größer".encode()
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["b.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "map.parquet"
    path.write_text("old")

    def write_half():
        with atomic_path(path) as temporary:
            assert (temporary.parent, temporary.suffix) == (tmp_path, ".parquet")
            temporary.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["map.parquet"]


@pytest.mark.skipif(os.name != "posix", reason="permissions as POSIX has them")
def test_files_have_the_permissions_that_others_have(tmp_path):
    old = os.umask(0o027)
    try:
        write_text(tmp_path / "a.txt", "")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o640


def test_json_has_plain_numbers_at_full_precision(tmp_path):
    value = {"nan": math.nan, "inf": [math.inf, (-math.inf, 0.1 + 0.2)], "numpy": np.float64("nan"), "zero": 0.0}
    value |= {"scalars": [np.int32(3), np.float32(0.5), np.bool_(True)], "large": [1e-300, 2**53 + 1]}
    write_json(tmp_path / "a.json", value)
    assert read_json(tmp_path / "a.json") == {
        "nan": None, "inf": [None, [None, 0.1 + 0.2]], "numpy": None, "zero": 0.0,
        "scalars": [3, 0.5, True], "large": [1e-300, 2**53 + 1],
    }  # fmt: skip


@pytest.mark.parametrize("content", [None, b"{", b"", b"\xff\xfe", b"{'a': 1}"])
def test_json_that_cannot_be_read_is_one_line_with_the_path(tmp_path, content):
    path = tmp_path / "summary.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"^.*summary\.json: [^\n]*$"):
        read_json(path)


def test_results_of_an_earlier_start_are_removed_and_nothing_else(tmp_path) -> None:
    for name in ("now.csv", "before.csv", "mine.txt", "sub/before.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    keep_only([tmp_path / "now.csv"], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.txt", "now.csv", "sub"]
    assert (tmp_path / "sub/before.csv").exists()
    keep_only([], tmp_path / "nowhere")


def test_arrays_are_read_as_they_were_written_or_not_at_all(tmp_path):
    path, arrays = tmp_path / "a.npz", {"x": np.arange(6.0).reshape(2, 3), "n": 3}
    for packed in (True, False):
        write_arrays(path, arrays, packed=packed)
        again = read_arrays(path)
        assert again.keys() == arrays.keys()
        np.testing.assert_array_equal(again["x"], arrays["x"])
        assert int(again["n"]) == 3
    with np.load(path) as content:
        whole = dict(content)
    for change in (
        {"x": whole["x"] + 1},
        {"x": whole["x"].reshape(3, 2)},
        {"more": np.zeros(1)},
        {"digest": np.zeros(1)},
    ):
        np.savez(path, **whole | change)  # with checksums that are right
        assert read_arrays(path) is None
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", b"no array")
        archive.writestr("digest.npy", b"none either")
    assert read_arrays(path) is None
    path.write_bytes(b"PK")
    assert read_arrays(path) is None
    assert read_arrays(tmp_path / "nowhere.npz") is None


@pytest.mark.parametrize("compressed", [False, True])
def test_a_stack_of_layers_is_the_array_that_numpy_reads(tmp_path, monkeypatch, compressed):
    """Also one that is larger than a zip without 64-bit sizes can hold, here 100 bytes."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 100)
    layers = np.random.default_rng(0).random((3, 8, 9))
    write_stack(tmp_path / "a.npz", "scores", iter(layers), 3, np.dtype(np.float32), compressed)
    with np.load(tmp_path / "a.npz") as stored:
        assert stored["scores"].dtype == np.float32
        np.testing.assert_array_equal(stored["scores"], layers.astype(np.float32))
    (entry,) = zipfile.ZipFile(tmp_path / "a.npz").infolist()
    assert (entry.compress_type == zipfile.ZIP_DEFLATED) == compressed
    write_stack(tmp_path / "b.npz", "scores", iter(layers), 3, None, compressed)
    with np.load(tmp_path / "b.npz") as stored:
        np.testing.assert_array_equal(stored["scores"], layers)


def test_json_is_read_from_no_pipe(tmp_path):
    os.mkfifo(tmp_path / "a.json")
    with pytest.raises(DataError, match=r"a\.json: cannot be read"):
        read_json(tmp_path / "a.json")
