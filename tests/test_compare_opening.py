"""Opening what is compared: folders, a label source of them, small summaries; each error in one line."""

from __future__ import annotations

import dataclasses
import io
import json
import re
import shutil
import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tiny_scene
from posed_config import configure
from posed_scene import fails

import semstab
from semstab.comparison.entries import shared_scenes
from semstab.comparison.opening import open_run, open_runs
from semstab.comparison.small_summary import LARGEST, save_summary
from semstab.core.json_form import to_json
from semstab.core.sealed_zip import packed
from semstab.errors import ConfigError, DataError
from semstab.statistics.cluster_sums import value


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a wall with the label sources a and b."""
    base = tmp_path_factory.mktemp("opening")
    tiny_scene.write(base / "wall", frames=6)
    semstab.run(configure(base / "wall", check=None), out=base / "run", report=False)
    return base / "run"


def test_a_label_source_is_selected_behind_a_colon_and_names_are_the_shortest(run, tmp_path):
    found = open_run(f"{run}:b")
    assert (found.model, list(found.scenes), found.source) == ("b", ["wall"], run)
    entry = found.scenes["wall"]
    assert entry.classes == entry.with_voxels("").table().classes
    assert value(entry.sums, "psa") == pytest.approx(entry.record.statistics.agreement.psa_op2.value)
    assert list(entry.flicker) == [1, 2, 3, 4, 5]
    assert np.mean(list(entry.flicker.values())) == pytest.approx(entry.record.image_space.compensated_flicker_percent)
    shutil.copytree(run, tmp_path / "new")
    names = [opened.name for opened in open_runs([f"{run}:a", f"{run}:b"])]
    assert names == ["a", "b"]
    assert [opened.name for opened in open_runs([f"{run}:a", f"{tmp_path}/new:a"])] == ["run", "new"]
    three = open_runs([f"{run}:a", f"{tmp_path}/new:a", f"{run}:b"])
    assert [opened.name for opened in three] == ["run:a", "new:a", "run:b"]
    assert [opened.name for opened in open_runs([f"{run}:a", f"{run}:a"])] == ["a", "a (2)"]
    shutil.copytree(run, tmp_path / "a:b")
    assert open_run(f"{tmp_path}/a:b:a").source == tmp_path / "a:b"


@pytest.mark.parametrize(("path", "line"), [
    ("{run}", "holds several label sources (a, b); name one: {run}:a"), ("{run}:q", "no model 'q'; known: a, b"),
    ("{run}/nothing", "there is no such folder"), ("{run}/units", "summary.json: cannot be read"),
    ("{run}/config.yaml", "neither a run's folder nor a small summary"),
])  # fmt: skip
def test_what_cannot_be_opened_is_one_line(run, path, line):
    fails((ConfigError, DataError), re.escape(line.format(run=run)), open_run, path.format(run=run))


def test_an_earlier_layout_and_runs_of_other_scenes_and_classes_are_refused(run, tmp_path):
    shutil.copytree(run, tmp_path / "old")
    settings = tmp_path / "old/config.yaml"
    settings.write_text(settings.read_text().replace("layout 4", "layout 2"))
    fails(
        DataError, re.escape("holds results of an earlier version of semstab; run it again"), open_run,
        f"{tmp_path}/old:a",
    )  # fmt: skip
    one = open_run(f"{run}:a")
    other = dataclasses.replace(one, scenes={"street": one.scenes["wall"]})
    fails(DataError, re.escape("have no scene in common (wall; street)"), shared_scenes, [one, other])
    entry = dataclasses.replace(one.scenes["wall"])
    entry.__dict__["sums"] = dataclasses.replace(entry.sums, classes=("floor", *entry.classes[1:]))
    fails(
        DataError, re.escape(f"class 0 is {one.scenes['wall'].classes[0]} and floor"), shared_scenes,
        [one, dataclasses.replace(one, scenes={"wall": entry})],
    )  # fmt: skip


def test_a_small_summary_holds_all_but_voxels(run, tmp_path):
    one, file = open_run(f"{run}:a"), tmp_path / "kept.semstab"
    save_summary(one, file)
    small = open_run(file)
    assert (small.model, list(small.scenes)) == ("a", ["wall"])
    whole, back = one.scenes["wall"], small.scenes["wall"]
    assert to_json(back.record.statistics.agreement) == to_json(whole.record.statistics.agreement)
    assert to_json(back.record.image_space) == to_json(whole.record.image_space)
    assert (back.up, back.flicker) == (whole.up, whole.flicker)
    assert all(value(back.sums, key) == value(whole.sums, key) for key in ("psa", "alpha", "voxel_alpha", "vss"))
    fails(
        DataError, re.escape(f"{file}: it is a small summary, without the voxels that mIoU needs"), back.with_voxels,
        "mIoU",
    )  # fmt: skip


def test_a_small_summary_becomes_coarser_until_it_fits(run, tmp_path):
    one, file = open_run(f"{run}:a"), tmp_path / "kept.semstab"
    save_summary(one, file)
    most = file.stat().st_size - 500
    save_summary(one, file, most)
    assert file.stat().st_size <= most
    coarse, fine = open_run(file).scenes["wall"].sums, one.scenes["wall"].sums
    assert coarse.edge > fine.edge
    assert value(coarse, "alpha") == pytest.approx(value(fine, "alpha"))
    fails(DataError, re.escape("use fewer scenes"), save_summary, one, file, 100)
    sums = open_run(f"{run}:a").scenes["wall"].sums
    assert sums.cells > 8
    wide = sums.coarsened(2.0**62, 2**30 if sums.step else 0)
    assert wide.cells <= 8
    assert value(wide, "alpha") == pytest.approx(value(sums, "alpha"))


def test_a_damaged_small_summary_is_one_line(run, tmp_path):
    file = tmp_path / "kept.semstab"
    save_summary(open_run(f"{run}:a"), file)
    whole = file.read_bytes()
    for data in (whole[: len(whole) // 2], b"", whole[:200] + b"\0" * 200 + whole[400:]):
        file.write_bytes(data)
        fails(DataError, re.escape(str(file)), open_run, file)
    file.write_bytes(packed({"summary.json": json.dumps({"kind": "else"}).encode()}))
    fails(DataError, re.escape("of another kind or version"), open_run, file)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("summary.json", b" " * (LARGEST + 1))
    assert file.stat().st_size < 200_000
    fails(DataError, re.escape(f"{file}: it unpacks to more than 100 MB"), open_run, file)


@pytest.mark.parametrize("member", ["summary.json", "0.parquet", "sha256"])
def test_a_changed_small_summary_is_refused(run, tmp_path, member):
    """A digit that somebody changes, or a member that is of another file, is no damage that a zip archive tells."""
    file = tmp_path / "kept.semstab"
    save_summary(open_run(f"{run}:a"), file)
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members[member] = members[member].replace(b"1", b"2", 1)
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    fails(DataError, re.escape("it has changed since it was written; write it again"), open_run, file)


@pytest.mark.parametrize(("field", "number", "line"), [
    ("edge", 0.3, "sums of wall are damaged"), ("edge", 2.0**63, "sums of wall are damaged"),
    ("step", 2**31, "sums of wall are damaged"), ("step", 3, "sums of wall are damaged"),
    ("evidence_0", 1e300, "sums of wall are damaged"), ("evidence_0", float("inf"), "sums of wall are damaged"),
    ("ix", 2**40, "sums of wall are damaged"), ("flicker", 1e308, "percentages of flicker, or the frames"),
    ("frames", 2**31, "percentages of flicker, or the frames"),
])  # fmt: skip
def test_numbers_that_no_map_has_are_refused_before_they_overflow(run, tmp_path, field, number, line):
    file = tmp_path / "kept.semstab"
    save_summary(open_run(f"{run}:a"), file)
    with zipfile.ZipFile(file) as archive:
        content, sums = json.loads(archive.read("summary.json")), pq.read_table(io.BytesIO(archive.read("0.parquet")))
    about = json.loads(sums.schema.metadata[b"semstab"])
    if field in about:
        sums = sums.replace_schema_metadata({"semstab": json.dumps(about | {field: number})})
    elif field in sums.column_names:
        values = pa.array([number] * len(sums))
        sums = sums.set_column(sums.column_names.index(field), field, values)
    else:
        content["scenes"][0][field][0] = number
    pq.write_table(sums, tmp_path / "sums.parquet")
    sums_file = (tmp_path / "sums.parquet").read_bytes()
    file.write_bytes(packed({"summary.json": json.dumps(content).encode(), "0.parquet": sums_file}))
    fails(DataError, line, open_run, file)


def test_flicker_out_of_range_in_a_runs_series_is_refused(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    series = next((tmp_path / "run/frames").glob("wall__a*.csv"))
    rows = series.read_text().splitlines()
    at = rows[0].split(",").index("compensated_flicker_percent")
    values = rows[2].split(",")
    values[at] = "1e308"
    series.write_text("\n".join([*rows[:2], ",".join(values), *rows[3:]]))
    (tmp_path / "run/digests.json").unlink()
    fails(DataError, "out of range", lambda: open_run(f"{tmp_path}/run:a").scenes["wall"].flicker)
