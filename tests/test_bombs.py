"""Small files that claim to be large are refused by their headers, in the memory and time that are promised."""

from __future__ import annotations

import bombs
import cv2
import numpy as np
import pytest
import tiny_scene
from bombs import MOST_MB, MOST_SECONDS, Taken
from image_files import refused
from posed_config import configure

import semstab
from semstab.comparison.opening import open_run
from semstab.comparison.small_summary import save_summary
from semstab.datasets.formats.image_sizes import FrameSize
from semstab.datasets.formats.images import read_color, read_depth, read_labels, read_mask, read_scores

SETUP = """
from pathlib import Path
from semstab.datasets.formats import decoders, images
from semstab.datasets.posed_folder import PosedFolder
import cv2, pyarrow.parquet
decoders.opencv()
"""


def within(taken: Taken) -> None:
    assert taken.message is not None
    assert "\n" not in taken.message
    assert taken.megabytes < MOST_MB
    assert taken.seconds < MOST_SECONDS


FILES = {
    "depth": ("read_depth", lambda file: bombs.png(file, 9000, 9000), ".png"),
    "packed depth": ("read_depth", lambda file: bombs.png(file, 8000, 8000, 8, 6), ".png"),
    "depth of floats": ("read_depth", lambda file: bombs.npz(file, "depth", (9000, 9000), "<f8"), ".npz"),
    "labels": ("read_labels", lambda file: bombs.npz(file, "labels", (10000, 10000)), ".npz"),
    "labels of a PNG": ("read_labels", lambda file: bombs.png(file, 9000, 9000, 8), ".png"),
    "labels in colours": ("read_labels", lambda file: bombs.png(file, 8000, 8000, 8, 2), ".png"),
    "long ids": ("read_labels", lambda file: bombs.npz(file, "labels", (9000, 9000), "<i8"), ".npz"),
    "labels of three axes": ("read_labels", lambda file: bombs.npz(file, "labels", (6, 9000, 9000)), ".npz"),
    "a mask": ("read_mask", lambda file: bombs.png(file, 9000, 9000, 8), ".png"),
    "confidence": ("read_confidence", lambda file: bombs.png(file, 9000, 9000, 8), ".png"),
    "colour": ("read_color", lambda file: bombs.png(file, 9000, 9000, 8, 2), ".png"),
}


@pytest.fixture(scope="module")
def refused_files(tmp_path_factory):
    folder, actions = tmp_path_factory.mktemp("files"), []
    for kind, (function, write, suffix) in FILES.items():
        file = write(folder / f"{kind}{suffix}")
        assert file.stat().st_size < 3_000_000
        actions.append(f"images.{function}(Path({str(file)!r}))")
    return dict(zip(FILES, bombs.read(SETUP, *actions), strict=True))


@pytest.mark.parametrize("kind", FILES)
def test_a_small_file_of_many_pixels_is_refused_by_its_header(refused_files, kind):
    taken = refused_files[kind]
    within(taken)
    assert taken.megabytes < 50
    assert "claims" in taken.message


def test_the_largest_depth_that_is_read_stays_in_bounds(tmp_path):
    file = bombs.png(tmp_path / "d.png", 8192, 8192)
    (taken,) = bombs.read(SETUP, f"images.read_depth(Path({str(file)!r}))")
    assert taken.message is None
    assert taken.megabytes < MOST_MB
    assert taken.seconds < MOST_SECONDS


def test_scores_of_other_classes_or_sizes_are_refused_before_they_are_unpacked(tmp_path):
    file = bombs.npz(tmp_path / "s.npz", "scores", (1000, 240, 320), "<f4")
    (taken,) = bombs.read(SETUP, f"images.read_scores(Path({str(file)!r}), 'KHW', (240, 320), classes=7)")
    within(taken)
    assert "1000 classes, but there are 7" in taken.message
    assert taken.megabytes < 50


@pytest.fixture
def scene(tmp_path):
    """A scene of 8 x 6 pixels, which its settings say, too."""
    return tiny_scene.write(tmp_path / "scene", models=("a",))


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("labels/a/0000", r"labels are 3000x3000 but depth is 8x6"),
        ("depth/0000", r"claims 3000x3000 pixels, but the image has 48"),
    ],
)
def test_a_file_of_another_size_than_its_frame_is_refused_first(scene, name, match, monkeypatch):
    file = next(scene.glob(f"{name}.*"))
    bombs.png(file, 3000, 3000, 16 if "depth" in name else 8)
    monkeypatch.setattr("semstab.datasets.formats.image_sizes.ORDINARY", 2**20)
    monkeypatch.setattr("semstab.datasets.formats.decoders.imdecode", _fails_on(file))
    action = frame_of(scene)
    with pytest.raises(semstab.SemstabError, match=match):
        action()


def test_labels_of_the_same_view_are_looked_up_unless_they_are_far_larger(scene, monkeypatch):
    file = next((scene / "labels/a").glob("0000.*"))
    bombs.png(file, 80, 60, 8)
    assert frame_of(scene)().labels.shape == (6, 8)
    bombs.png(file, 4000, 3000, 8)
    monkeypatch.setattr("semstab.datasets.formats.decoders.imdecode", _fails_on(file))
    action = frame_of(scene)
    with pytest.raises(semstab.DataError, match=r"claims 4000x3000 pixels, but depth is 8x6 .* to one size") as error:
        action()
    assert "\n" not in str(error.value)


def _fails_on(file):
    from semstab.datasets.formats import decoders

    decode = decoders.imdecode

    def decoded(path, data, mode):
        assert path != file, "it was decoded before it was refused"
        return decode(path, data, mode)

    return decoded


def frame_of(scene):
    from semstab.datasets import open_dataset

    opened = open_dataset("posed_folder", {"root": str(scene), "intrinsics_size": [8, 6]})
    return lambda: opened.scene(opened.scenes[0]).frame(0, "a")


def test_a_frame_with_a_large_image_may_have_large_maps(tmp_path):
    file = bombs.png(tmp_path / "l.png", 10000, 8000, 8)
    refused(read_labels, file, match="at most 67108864 are read")
    assert read_labels(file, allowed_sizes=FrameSize(lambda: 80_000_000)).shape == (8000, 10000)
    small = bombs.png(tmp_path / "s.png", 3000, 3000, 8)
    assert read_labels(small, allowed_sizes=FrameSize(lambda: 2_300_000)).shape == (3000, 3000)
    with pytest.raises(semstab.DataError, match="but the image has 2000000"):
        read_labels(small, allowed_sizes=FrameSize(lambda: 2_000_000))


def test_a_large_photograph_is_read(tmp_path, monkeypatch):
    image = np.random.default_rng(0).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    for suffix in (".png", ".jpg", ".tif"):
        cv2.imwrite(str(tmp_path / f"c{suffix}"), image)
    monkeypatch.setattr("semstab.datasets.formats.image_sizes.MAX_IMAGE_BYTES", 1000)
    for suffix in (".png", ".jpg", ".tif"):
        assert read_color(tmp_path / f"c{suffix}").shape == image.shape


@pytest.fixture(scope="module")
def summary(tmp_path_factory):
    folder = tmp_path_factory.mktemp("summary")
    tiny_scene.write(folder / "scene", models=("a",))
    semstab.run(configure(folder / "scene", check=None, statistics=True), out=folder / "run", report=False)
    save_summary(open_run(folder / "run"), folder / "small.semstab")
    return folder / "small.semstab"


LOAD = (
    "from semstab.comparison.small_summary import load_summary; import pyarrow.parquet, semstab.statistics.cluster_sums"
)


@pytest.mark.parametrize("make", [bombs.semstab, bombs.semstab_of_text])
def test_a_small_summary_of_many_numbers_is_refused(tmp_path, summary, make):
    size = 2**22 if make is bombs.semstab else 60_000_000
    file = make(tmp_path / "small.semstab", summary, size)
    assert file.stat().st_size < 300_000
    (taken,) = bombs.read(LOAD, f"load_summary({str(file)!r})")
    within(taken)
    assert taken.megabytes < 200


def test_a_parquet_file_of_many_rows_is_refused(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = tmp_path / "voxels.parquet"
    zeros = pa.array(np.zeros(2**20, np.int64))
    table = pa.table({name: pa.chunked_array([zeros] * 64) for name in "abcd"})
    pq.write_table(table, file, row_group_size=2**26)
    assert file.stat().st_size < 2_000_000
    (taken,) = bombs.read(
        "from pathlib import Path; from semstab.data import parquet; import pyarrow.parquet",
        f"parquet.columns(Path({str(file)!r}), ['a', 'b', 'c', 'd'])",
    )
    within(taken)
    assert "unpack to" in taken.message


def test_scores_of_another_size_than_the_depth_have_the_bytes_of_scores(tmp_path):
    file = bombs.npz(tmp_path / "s.npz", "scores", (100, 960, 1280), "<f4")
    (taken,) = bombs.read(SETUP, f"images.read_scores(Path({str(file)!r}), 'KHW', (240, 320), classes=100)")
    within(taken)
    assert taken.megabytes < 50
    assert "but depth is 320x240" in taken.message
    small = bombs.npz(tmp_path / "t.npz", "scores", (3, 12, 16), "<f4")
    assert read_scores(small, "KHW", (6, 8)).shape == (12, 16, 3)


def test_the_most_wide_ids_that_are_read_stay_in_bounds(tmp_path):
    file = bombs.npz(tmp_path / "l.npz", "labels", (5500, 6000), "<i8")
    for taken in bombs.read(
        SETUP, *(f"images.read_labels(Path({str(file)!r}), void={v})" for v in [(), (-1,), (0, -1)])
    ):
        assert taken.message is None
        assert taken.megabytes < MOST_MB
        assert taken.seconds < MOST_SECONDS


def test_readers_that_know_no_frame_are_bounded_too(tmp_path):
    for read, kind in ((read_depth, 16), (read_mask, 8)):
        refused(read, bombs.png(tmp_path / "x.png", 9000, 9000, kind), match="claims 9000x9000")
    refused(
        read_scores, bombs.npz(tmp_path / "s.npz", "scores", (5000, 4, 4), "<f4"), "KHW", (4, 4),
        match="5000 classes, but there are at most 4096",
    )  # fmt: skip
