"""Runs side by side: nothing where nothing changed; a planted fault with its area, class and frames."""

from __future__ import annotations

import dataclasses
import math
import shutil
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from command_line import bench
from posed_config import configure
from posed_writer import write_posed
from rich.console import Console
from simulated_events import log_of

import semstab
from semstab import Frame, Intrinsics
from semstab.compare_runs import load_comparison, markdown
from semstab.comparison.differences import corrected, over_scenes
from semstab.comparison.locations import worse_areas
from semstab.comparison.opening import open_runs
from semstab.comparison.pairing import Common, pair
from semstab.comparison.voxels import Region
from semstab.core.files import read_sealed, write_sealed
from semstab.data.contrast import Against, Contrast, RunComparison, SceneComparison
from semstab.data.georeference import Georeference
from semstab.data.statistics import Interval
from semstab.errors import ConfigError, DataError
from semstab.report.comparison.screen import print_comparison
from semstab.report.comparison.sentences import sentences

FAULTY = (2, 5, 8)
CLASSES = ["wall", "door", "window", "floor"]


def write_scene(folder: Path, sources: dict[str, set[int]], name: str = "wall") -> Path:
    """A wall that nine frames see from one place to the next; in those of a source its doors are called windows."""
    size, focal, depth = (48, 64), 64.0, np.full((48, 64), 2.03, np.float32)
    views: dict[str, list[Frame]] = {key: [] for key in ("gt", *sources)}
    for i in range(9):
        columns = (np.arange(64) + i * 0.25 * focal / 2.03).astype(int)
        truth = np.tile((columns // 12 % 3).astype(np.uint8), (48, 1))
        pose = np.eye(4)
        pose[:3, 3] = [0.25 * i + 0.003, 0.003, 0.0]
        wrong = np.kron(np.random.default_rng(i).random((12, 16)) < 0.1, np.ones((4, 4), bool))
        for key, frames in views.items():
            labels = truth if key == "gt" else np.where(wrong, (truth + 1) % 3, truth)
            labels = np.where((labels == 1) & (i in sources.get(key, ())), 2, labels).astype(np.uint8)
            frames.append(Frame(i, depth, Intrinsics(focal, focal, size[1] / 2, size[0] / 2), pose, labels=labels))
    write_posed(folder / name, [f"{i:04d}" for i in range(9)], views, classes=CLASSES, up_axis="-y")
    return folder / name


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Runs: old with the label source net; new with net, whose doors are windows in FAULTY, and same, as net was."""
    base = tmp_path_factory.mktemp("compare")
    write_scene(base / "a", {"net": set()})
    write_scene(base / "b", {"net": set(FAULTY), "same": set()})
    for name, scene, more in (
        ("old", base / "a", {}), ("new", base / "b", {}), ("coarse", base / "a", {"voxel_size": 0.25}),
    ):  # fmt: skip
        settings = {"check": None, "voxel_size": 0.125, "statistics": True, "backends": ["numba"], **more}
        semstab.run(configure(scene, **settings), out=base / name, report=False)
    return base


@pytest.fixture(scope="module")
def fault(runs) -> RunComparison:
    return semstab.compare(runs / "old", f"{runs}/new:net", out=runs / "compared")


def rows(against: Against, of: str = "") -> dict[str, Contrast]:
    return {row.measure: row for row in (*against.contrasts, *against.by_class) if row.of == of}


def test_a_run_and_itself_do_not_differ_and_numbers_are_those_of_the_runs(runs, fault):
    (against,) = semstab.compare(runs / "old", f"{runs}/new:same").overall
    assert {row.difference.value for row in (*against.contrasts, *against.by_class)} == {0.0}
    assert {row.change for row in (*against.contrasts, *against.by_class)} == {""}
    assert all(row.difference.low == row.difference.high == 0 for row in against.contrasts)
    record = semstab.load_result(runs / "old").record(model="net")
    found = rows(fault.overall[0])
    judged, right = record.statistics.headline, record.statistics.correctness
    assert found["psa_op2"].base == pytest.approx(judged.psa_op2.value, abs=1e-9)
    assert found["alpha"].base == pytest.approx(judged.alpha.value, abs=1e-9)
    assert found["accuracy_op2"].base == pytest.approx(judged.accuracy_op2.value, abs=1e-9)
    assert found["voxel_alpha_op2"].base == pytest.approx(record.statistics.agreement.voxel_alpha_op2.value, abs=1e-9)
    assert found["compensated_flicker_percent"].base == pytest.approx(record.image_space.compensated_flicker_percent)
    assert found["wrong_of_consistent_op3"].base == pytest.approx(
        right.quadrants.wrong_of_consistent_op3.value, abs=1e-9
    )
    assert {"sbd_excess_op2", "miou_op2", "ece_op2", "entropy_op3", "sbd_op3", "margin_op3"} <= found.keys()


def test_a_planted_fault_is_found_with_its_class_its_place_and_its_frames(fault):
    (against,) = fault.scenes[0].against
    assert fault.scenes[0].basis == "observations"
    found = rows(against)
    assert found["alpha"].difference.value < -0.05
    assert found["accuracy_op2"].other < found["accuracy_op2"].base
    assert found["coverage_op2"].difference.value == 0
    assert rows(against, "door")["alpha"].difference.value < rows(against, "wall")["alpha"].difference.value
    assert against.areas
    assert {(area.of, area.confused_with) for area in against.areas} == {("door", "window")}
    assert {frame.frame for area in against.areas for frame in area.frames} <= set(FAULTY)
    assert {FAULTY[0], FAULTY[1]} <= {frame.frame for frame in against.top_frames} <= set(FAULTY)
    assert against.worse > 10 * against.better


def test_what_is_written_comes_back_and_every_file_is_there(runs, fault):
    folder = runs / "compared"
    again = load_comparison(folder)
    assert [row.measure for row in again.overall[0].contrasts] == [row.measure for row in fault.overall[0].contrasts]
    assert again.scenes[0].against[0].areas == fault.scenes[0].against[0].areas
    for name in ("comparison.md", "report.html", "recording.rrd", "tables/comparison.csv",
                 "figures/comparison_map__wall__new.png"):  # fmt: skip
        assert (folder / name).stat().st_size > 0
    page = (folder / "report.html").read_text()
    assert "new against old" in page
    assert page.count("<figure") > 3
    assert "http" not in page.replace("http://www.w3.org", "").replace("https://www.w3.org", "")


def test_a_location_is_worse_from_one_of_ten_observations_on_that_turned():
    """Four voxels each: one of ten turns, one of eleven turns, both the other way round, and nothing changes."""
    steady, ten, eleven = np.zeros(11, int), np.array([0] * 9 + [1, -1]), np.array([0] * 10 + [1])
    before = [steady - (np.arange(11) == 10), steady, ten, eleven, steady]
    after = [ten, eleven, before[0], steady, steady]
    index = np.array([[0, 4 * group + k // 2, k % 2] for group in range(5) for k in range(4)])
    maps = {
        name: log_of(np.repeat(labels, 4, axis=0), index=index).table()
        for name, labels in (("base", before), ("other", after))
    }
    common = Common("observations", (), (), regions=lambda: iter([Region(maps)]), shown=0.0)
    found = worse_areas(common, 1)
    assert (found.changes.compared, found.changes.worse, found.changes.better) == (20, 4, 4)
    (area,) = found.areas
    assert (area.voxels, area.loss, area.improved_alike) == (4, pytest.approx(0.2), 1)
    assert found.changes.shown.change.tolist() == [-0.2] * 4 + [0.2] * 4
    assert found.changes.area.tolist() == [1] * 4 + [0] * 4


def test_the_columns_go_along_in_an_export(runs, fault, tmp_path):
    import pyarrow.parquet as pq

    against = fault.scenes[0].against[0]
    assert against.columns is not None
    columns = pq.read_table(runs / "compared" / against.columns)
    assert columns.num_rows == against.compared
    assert (columns["change"].to_numpy() <= -0.2).sum() == against.worse
    listed = [area.number for area in against.areas if area.what == "agreement"]
    assert set(listed) <= set(columns["area"].to_numpy().tolist())
    file = runs / "compared" / against.columns
    semstab.export(runs / "old", tmp_path / "map.parquet", measures=["change", "area"], join=file)
    exported = pq.read_table(tmp_path / "map.parquet")
    assert (exported["area"].to_numpy() > 0).sum() == (columns["area"].to_numpy() > 0).sum()
    assert exported["change"].null_count == exported.num_rows - against.compared
    with pytest.raises(DataError, match=r"voxels of 0\.125 m"):
        semstab.export(runs / "coarse", tmp_path / "map.csv", measures=["change"], join=file)


def test_runs_of_other_voxel_sizes_and_frames_of_reference_are_hardly_compared(runs):
    (scene,) = semstab.compare(runs / "old", runs / "coarse").scenes
    assert scene.basis == "cubes"
    assert set(rows(scene.against[0])) == {"alpha", "compensated_flicker_percent", "accuracy_op2", "miou_op2"}
    assert not scene.against[0].areas
    assert (scene.against[0].compared, scene.against[0].worse, scene.against[0].better) == (0, 0, 0)
    assert "voxels of 0.125 m and 0.25 m" in scene.notes[0]
    entries = [run.scenes["wall"] for run in open_runs([runs / "old", f"{runs}/new:net"])]
    here = Georeference("PROJCRS", (0.0, 0.0, 0.0))
    moved = dataclasses.replace(here, offset=(100.0, 0.0, 0.0))
    for pairs in ((here, moved), (None, here)):
        placed = [
            dataclasses.replace(entry, georeference=reference) for entry, reference in zip(entries, pairs, strict=True)
        ]
        found = pair(placed, ["old", "new"])
        assert found.basis == "flights"
        assert "nothing can be paired" in found.notes[0]


def contrast(value: float, error: float, measure: str = "psa_op2") -> Contrast:
    p = math.erfc(abs(value) / error / math.sqrt(2))
    interval = Interval(value, value - 2 * error, value + 2 * error, degrees=1e6, p_value=p)
    return Contrast(measure, "", 0.5, 0.5 + value, interval, math.nan, "")


def test_without_places_seen_twice_there_is_neither_map_nor_recording(runs, tmp_path):
    scene = {"name": "posed_folder", "options": {"root": str(runs / "b")}}
    semstab.run(
        {"dataset": scene, "frames": "0:1", "voxel_size": 0.125, "statistics": True, "check": None},
        out=tmp_path / "once",
        report=False,
    )
    semstab.compare(f"{tmp_path}/once:net", f"{tmp_path}/once:same", out=tmp_path / "compared")
    assert {path.name for path in (tmp_path / "compared").iterdir()} == {
        "columns", "comparison.json", "comparison.md", "report.html", "tables",
    }  # fmt: skip


def test_contrasts_of_scenes_are_averaged_and_corrected_together():
    (mean,) = over_scenes([[contrast(0.1, 0.1)], [contrast(0.3, 0.1)]])
    assert (mean.base, mean.other, mean.difference.value) == pytest.approx((0.5, 0.7, 0.2))
    assert mean.difference.high == pytest.approx(0.2 + 0.2 / math.sqrt(2))
    ((one, two, three),) = corrected(
        [[contrast(-0.3, 0.1), contrast(0.3, 0.1, "sbd_excess_op2"), contrast(0.2, 0.1, "vss_op3")]]
    )
    assert (one.change, two.change, three.change) == ("worse", "worse", "better")
    assert one.p_holm == pytest.approx(3 * one.difference.p_value)
    many = corrected([[contrast(0.2, 0.1)] * 4])[0]
    assert {row.change for row in many} == {""}


def test_a_terminal_of_80_columns_and_markdown_hold_it(fault):
    text = StringIO()
    print_comparison(fault, Console(file=text, width=80))
    assert max(map(len, text.getvalue().splitlines())) <= 80
    for word in ("Over all classes", "Alpha", "door", "window", "frames"):
        assert word in text.getvalue()
    page = markdown(fault)
    assert page.startswith("## new against old\n")
    assert "| Measure | old | new |" in page


def test_of_several_scenes_the_screen_has_differences_over_all_verbose_those_of_each(fault):
    (scene,) = fault.scenes
    both = (dataclasses.replace(scene, scene="one"), dataclasses.replace(scene, scene="two"))
    several = dataclasses.replace(fault, scenes=both)
    brief, full = StringIO(), StringIO()
    print_comparison(several, Console(file=brief, width=80))
    print_comparison(several, Console(file=full, width=80), verbose=True)
    assert sum(line.startswith(" Alpha  ") for line in brief.getvalue().splitlines()) == 1
    assert "the largest is" not in brief.getvalue()
    assert "in one (4 areas whose frames agree less; 1 area that is wrong now), two (4 areas" in " ".join(
        brief.getvalue().split()
    )
    assert sum(line.startswith(" Alpha  ") for line in full.getvalue().splitlines()) == 3
    assert full.getvalue().count("the largest is") == sum(
        any(area.what == what for area in scene.against[0].areas) for _ in both for what in ("agreement", "truth")
    )
    assert " 0." not in brief.getvalue().split("Differences")[1]


def renamed(scene: SceneComparison, overall: tuple[Against, ...]) -> SceneComparison:
    """Return a scene with the contrasts and names of what stands over all scenes."""
    changed = (
        dataclasses.replace(a, other=o.other, contrasts=o.contrasts)
        for a, o in zip(scene.against, overall, strict=True)
    )
    return dataclasses.replace(scene, against=tuple(changed))


def test_long_names_of_runs_stand_in_the_title_and_what_is_written_is_not_offered(fault):
    first, other = "espnetv2_voc scale=2.0", "espnetv2_voc scale=1.0"
    runs = tuple(dataclasses.replace(run, name=name) for run, name in zip(fault.runs, (first, other), strict=True))
    overall = tuple(dataclasses.replace(against, other=other) for against in fault.overall)
    (scene,) = fault.scenes
    renamed_runs = dataclasses.replace(fault, base=first, runs=runs, overall=overall, scenes=(renamed(scene, overall),))
    text = StringIO()
    print_comparison(renamed_runs, Console(file=text, width=80), out=Path("versus"))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert f"Differences (base: {first}, other: {other})" in lines
    assert sum(line.startswith(" Alpha  ") for line in lines) == 1
    assert lines[-1] == "  more     -v: classes and areas"


def test_scenes_without_an_interval_do_not_count_beside_those_that_have_one():
    few = dataclasses.replace(contrast(0.5, 0.1), difference=Interval(0.5, math.nan, math.nan))
    (mean,) = over_scenes([[contrast(0.1, 0.1)], [few]])
    assert (mean.base, mean.other, mean.difference.value) == pytest.approx((0.5, 0.6, 0.1))
    (alone,) = over_scenes([[few], [few]])
    assert alone.difference.value == pytest.approx(0.5)


def test_bad_input_is_one_line_and_the_command_writes_markdown(runs, tmp_path):
    done = bench("compare", runs / "old", runs / "old", "--markdown", cwd=tmp_path, columns=80)
    assert done.stdout.startswith("## net (2) against net\n")
    done = bench("compare", runs / "old", runs / "new", cwd=tmp_path, code=2)
    assert done.stderr.count("\n") == 1
    assert "holds several label sources (net, same); name one" in done.stderr
    with pytest.raises(ConfigError, match="name two runs or more"):
        semstab.compare(runs / "old")
    broken = shutil.copytree(runs / "old", tmp_path / "broken")
    write_sealed(broken / "summary.json", read_sealed(broken / "summary.json") | {"runs": [3]})
    with pytest.raises(DataError, match=r"summary\.json"):
        semstab.compare(runs / "old", broken)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    with pytest.raises(ConfigError, match="holds no comparison"):
        semstab.compare(runs / "old", runs / "old", out=tmp_path / "full")
    (runs / "old" / "voxels").rename(runs / "old" / "gone")
    try:
        assert semstab.compare(runs / "old", runs / "old").scenes[0].basis == "cubes"
    finally:
        (runs / "old" / "gone").rename(runs / "old" / "voxels")


@pytest.mark.parametrize(
    ("change", "said"), [(-0.03, "new covers 3.0% fewer voxels than old."), (0.02, "2.0% more voxels"), (0.004, "")]
)
def test_coverage_is_a_count_and_neither_better_nor_worse(runs, change, said):
    comparison = semstab.compare(runs / "old", f"{runs}/new:net")
    (against,) = comparison.overall

    def covering(row: Contrast) -> Contrast:
        if row.measure != "coverage_op2":
            return row
        counted = Interval(change, change, change, p_value=0.0, degrees=math.inf)
        return dataclasses.replace(
            row, difference=counted, other=1 + change, change="worse" if change < 0 else "better"
        )

    rows = tuple(map(covering, against.contrasts))
    overall = (dataclasses.replace(against, contrasts=rows),)
    other = dataclasses.replace(comparison, overall=overall, scenes=(renamed(comparison.scenes[0], overall),))
    text = " ".join(sentences(other))
    assert said in text
    assert "in coverage" not in text
    screen = StringIO()
    print_comparison(other, Console(file=screen, width=80))
    lines = screen.getvalue().splitlines()
    line = lines[next(k for k, line in enumerate(lines) if line.startswith(" Coverage")) + 1]  # the name takes two
    assert line.split()[-1] == ("fewer" if change < 0 else "more")
    assert bool(said) == ("covers" in text)
