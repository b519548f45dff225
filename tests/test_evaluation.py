"""Statistics in runs and studies: from the command line to summary.json, tables, figures and the report."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import tiny_scene
import tiny_study
from command_line import bench
from posed_config import configure
from records import record, study, voxels

import semstab
from semstab import Events, VoxelTable
from semstab.api import run_study
from semstab.core.json_form import to_json
from semstab.engine import Observer, load_result
from semstab.engine.memory import MapMemory
from semstab.errors import ConfigError
from semstab.report import terminal
from semstab.report.comparison.own_models import own_models
from semstab.report.tables import tables
from semstab.report.tables import to_json as table_content
from semstab.report.terminal import common_beginning, print_summary
from semstab.statistics import MapSample, SpotObservations, analyse, describe

MODELS = ("a", "b", "gt")


# --- A run ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A run from the command line with all statistics: its folder, what it printed, its summary."""
    base = tmp_path_factory.mktemp("ran")
    tiny_scene.write(base / "wall", frames=6)
    chosen = [word for name in MODELS for word in ("-m", name)]
    printed = bench(
        "--data", "wall", "-b", "numpy", *chosen, "--voxel-size", "0.25", "--check", "none", "--rerun", "off",
        "--statistics", "--events", "--set", "strata=[1, 3]", "-v", "--out", "run", cwd=base, columns=80,
    ).stdout  # fmt: skip
    return base / "run", printed, json.loads((base / "run" / "summary.json").read_text())


def saved(run: Path, model: str) -> tuple[VoxelTable, Events, SpotObservations]:
    name = f"wall__{model}__numpy.parquet"
    spots = SpotObservations.load(run / "observations" / name)
    return VoxelTable.load(run / "voxels" / name), Events.load(run / "events" / name), spots


def test_a_runs_statistics_are_those_of_its_saved_maps_and_events(ran) -> None:
    run, _, summary = ran
    truth, *_ = saved(run, "gt")
    for entry in summary["runs"]:
        name = entry["model"]
        table, events, spots = saved(run, name)
        true = None if name == "gt" else truth
        expected = analyse(MapSample.draw(table, events, true, edges=(1, 3)), spots, name=name, edges=(1, 3))
        assert entry["statistics"] == json.loads(json.dumps(to_json(expected.summary)))
        columns = pq.read_table(run / "voxels" / f"wall__{name}__numpy.parquet")
        for column, values in expected.columns(table).items():
            np.testing.assert_array_equal(columns.column(column).to_numpy(), values)
    by_name = {entry["model"]: entry["statistics"] for entry in summary["runs"]}
    assert by_name["gt"]["agreement"]["psa_op2"]["value"] == 1.0
    assert by_name["a"]["agreement"]["psa_op2"]["value"] < 0.9
    assert by_name["a"]["correctness"]["accuracy_op2"]["value"] > 0.6
    assert by_name["gt"]["correctness"] is None
    assert by_name["a"]["geometry"]["geometry"]["value"] == 0.0


def test_all_that_was_found_is_printed_where_it_was_asked_for(ran) -> None:
    _, printed, summary = ran
    assert len(summary["runs"]) == 3
    for words in ("Agreement of the frames", "Consistent and right"):
        assert words in printed


def test_the_verdict_on_each_model_is_printed(ran) -> None:
    _, printed, summary = ran
    for entry in summary["runs"]:
        assert entry["statistics"]["verdict"]["level"] in printed
    screen = printed.partition("\n\nOverview")[0]
    assert max(len(line) for line in screen.splitlines()) <= 80
    assert len(screen.splitlines()) <= 28


def listed_classes(result) -> tuple[list[str], str]:
    """Return the classes that the screen lists, in order, and the lines after them."""
    after = "\n".join(terminal.screen(result)).partition("disagreement by class")[2].splitlines()[1:]
    rows = list(itertools.takewhile(lambda line: line.endswith(" %"), after))
    return [re.split(r"  +", row.strip())[0] for row in rows], "\n".join(after[len(rows) :])


def test_the_classes_with_most_of_the_disagreement_are_listed(tmp_path, monkeypatch) -> None:
    root = tiny_scene.write(tmp_path / "wall", ("a", "b"))
    one = semstab.run(configure(root, models=["a"]), out=tmp_path / "one", report=False)
    classes = one.record().statistics.spots.classes
    largest = sorted((row for row in classes if row.disagreement >= 0.01), key=lambda row: -row.disagreement)
    assert listed_classes(one)[0] == [row.name for row in largest]
    covering = max(one.record().map_summary.classes, key=lambda row: row.share)
    monkeypatch.setattr("semstab.report.terminal.disagreement.MAJORITY", covering.share)
    assert covering.name in listed_classes(one)[0]
    both, after = listed_classes(semstab.run(configure(root), out=tmp_path / "both", report=False))
    assert f"a: {covering.name}" not in both
    assert after.splitlines()[0] == f"    not listed: {covering.name} (half of the map or more)"


def test_without_asking_there_is_what_the_map_alone_tells(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall", ("a",))
    result = semstab.run(configure(root, events=True, truth=False), out=tmp_path / "run", report=False)
    (entry,) = result.runs
    table = VoxelTable.load(tmp_path / "run" / "voxels" / f"{entry.unit.slug}.parquet")
    spots = SpotObservations.load(tmp_path / "run" / "observations" / f"{entry.unit.slug}.parquet")
    assert to_json(entry.statistics) == to_json(describe(table, spots=spots, name="a"))
    assert entry.statistics.drift.flips is None
    again = semstab.run(configure(root, events=True, truth=False), out=tmp_path / "run", report=False)  # kept
    assert to_json(again.runs[0].statistics) == to_json(entry.statistics)


class Interrupting(Observer):
    """Ctrl-C when the second model is to be fused."""

    def frame_fused(self, task, frame, rows) -> None:
        if task.model == "b":
            raise KeyboardInterrupt


def test_a_run_that_was_interrupted_ends_with_the_same_statistics(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall")
    config = configure(root, statistics=True)
    whole = semstab.run(config, report=False)
    with pytest.raises(KeyboardInterrupt):
        semstab.run(config, out=tmp_path / "run", observers=[Interrupting()], report=False)
    resumed = semstab.run(config, out=tmp_path / "run", report=False)
    assert [to_json(entry.statistics) for entry in resumed.runs] == [to_json(entry.statistics) for entry in whole.runs]
    assert whole.runs[0].statistics.correctness.accuracy_op2.value > 0.5  # the truth was fused again


def test_the_first_backend_that_keeps_a_log_has_all_statistics(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall", ("a",))
    result = semstab.run(configure(root, backends=["open3d"], check="numpy", statistics=True), report=False)
    open3d, numpy = result.runs
    assert open3d.statistics.drift.flips is None
    assert open3d.statistics.correctness is not None
    assert numpy.statistics.drift.flips is not None
    assert numpy.statistics.agreement.voxel_alpha_op2.value == pytest.approx(
        open3d.statistics.agreement.voxel_alpha_op2.value
    )
    assert numpy.statistics.headline.alpha.value == open3d.statistics.headline.alpha.value
    plain = semstab.run(configure(root, backends=["open3d"], check="numpy"), report=False)
    assert [entry.statistics is not None for entry in plain.runs] == [True, False]


def test_frames_without_ground_truth_are_left_out_of_the_truth(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall", ("a",), frames=4)
    (root / "labels/gt/0002.png").unlink()
    (entry,) = semstab.run(configure(root, statistics=True), report=False).runs
    assert entry.statistics.correctness.accuracy_op2.value > 0.5


def test_no_ground_truth_no_judgement(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall", ("a",))
    for path in (root / "labels/gt").iterdir():
        path.unlink()
    (root / "labels/gt").rmdir()
    (entry,) = semstab.run(configure(root, statistics=True), report=False).runs
    assert entry.statistics.correctness is entry.statistics.geometry is None
    assert entry.statistics.drift.flips is not None


def test_models_of_different_classes_are_not_compared(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall")
    (root / "labels/b/label_space.yaml").write_text("name: other\nclasses: [wall, door, window, sky]\n")
    result = semstab.run(configure(root, statistics=True), out=tmp_path / "run", report=False)
    assert own_models(result) == []


def test_the_log_counts_as_memory(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall", ("a",), frames=30)
    without, expected = (MapMemory("numba", 3, logged=logged).whole(222, 30 * 48) for logged in (False, True))
    held = 30 * 48 * (3 * 8 + 40)  # the log alone, as `Events` has it
    assert expected - without > held
    with pytest.raises(ConfigError, match="no statistics; or set memory_gb"):
        semstab.run(
            configure(root, backends=["numba"], check=None, statistics=True, memory_gb=1e-6, tile_size="off"),
            report=False,
        )


def test_summaries_of_several_scenes_say_which_one_a_verdict_is_of(tmp_path, capsys) -> None:
    from rich.console import Console

    for scene in ("x", "y"):
        tiny_scene.write(tmp_path / "walls" / scene, ("a",))
    print_summary(semstab.run(configure(tmp_path / "walls"), report=False), Console(width=80))
    lines = capsys.readouterr().out.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("  by scene"))
    assert [" ".join(line.split()[:4]) for line in lines[start + 1 : start + 3]] == [
        f"{scene} no verdict {alpha}"
        for scene, alpha in zip("xy", (line.split()[3] for line in lines[start + 1 : start + 3]), strict=True)
    ]


# --- A study ----------------------------------------------------------------------------------------------------------


def rows_of(found, name):
    made = own_models(found) if name.startswith("comparison") else tables(found)
    (table,) = (table for table in made if table.name == name)
    return table_content(table)["rows"]


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    """A study with all statistics, and its folder."""
    base = tmp_path_factory.mktemp("studied")
    root = tiny_study.write(base / "wall", frames=8)
    noise = {"depth_noise": {"values": [0, 0.05], "repeats": 2}}
    settings = {"models": list(MODELS), "backends": ["numpy"], "statistics": True, "frames": {}, "sweeps": noise}
    run_study(tiny_study.configure(root, **settings), base / "out", report=False)
    return load_result(base / "out"), base / "out"


def test_the_tables_of_a_study_have_the_numbers_of_its_units(studied) -> None:
    found, _ = studied
    base = {record.unit.model: record.statistics for record in found.select()}
    for row in rows_of(found, "temporal_agreement"):
        statistics = base[row["model"]]
        assert row["psa_op2"] == pytest.approx(dataclasses.asdict(statistics.agreement.psa_op2), nan_ok=True)
        assert row["flip_rate"] == statistics.drift.flips.rate.value
    for row in rows_of(found, "drift"):
        assert row["voxels"] == base[row["model"]].drift.voxels
        assert row["sbd_op2"] - row["sbd_null_op2"] == pytest.approx(row["sbd_excess_op2"]["value"])
    for row in rows_of(found, "ceiling"):
        assert row["disagreement"]["value"] == pytest.approx(row["geometry"]["value"] + row["model"]["value"])
    quadrants = rows_of(found, "quadrants")
    assert [row["model"] for row in quadrants] == ["a", "b"]
    for row in quadrants:
        parts = [row[f"{name}_percent"]["value"] for name in
                 ("consistent_right", "consistent_wrong", "inconsistent_right", "inconsistent_wrong")]  # fmt: skip
        assert sum(parts) == pytest.approx(100)
    strata = [row for row in rows_of(found, "correctness") if row["model"] == "a"]
    assert strata[0]["voxels"] == sum(row["voxels"] for row in strata[1:-1])
    right = next(record.statistics.correctness for record in found.select(model="a"))
    assert (strata[-1]["persistence"], strata[-1]["miou"]) == ("OP>=2", pytest.approx(right.miou_op2.value))
    (difference,) = (
        row for row in rows_of(found, "comparison_all") if row["measure"] == "accuracy_op2" and not row["class"]
    )
    assert difference["difference"]["value"] == pytest.approx(difference["other"] - difference["base"])
    assert {row["verdict"] for row in rows_of(found, "verdicts")} == {"no verdict"}


def test_agreement_stands_beside_the_sweep(studied) -> None:
    found, _ = studied
    rows = [row for row in rows_of(found, "sensitivity_depth_noise") if row["model"] == "a"]
    (still,), noisy = (found.select("depth_noise", model="a", value=value) for value in (0, 0.05))
    assert rows[0]["psa_op2"] == still.statistics.agreement.psa_op2.value
    alphas = [record.statistics.headline.alpha.value for record in noisy]
    assert rows[1]["alpha"]["mean"] == pytest.approx(np.mean(alphas))
    assert rows[1]["alpha"]["sd"] == pytest.approx(np.std(alphas, ddof=1))


def test_columns_without_a_number_are_left_out() -> None:
    table = voxels((5, 1, [1, 0, 0]), (5, 2, [1, 1, 0]))
    plain = record(table)
    judged = dataclasses.replace(plain, statistics=(describe(table)))
    (row,) = rows_of(study(judged), "temporal_agreement")
    assert "flip_rate" not in row
    assert row["repeated_voxels"] == 5
    assert not {"ceiling", "correctness", "quadrants"} & {found.name for found in tables(study(judged))}


def test_the_mean_of_several_scenes_counts_each_once() -> None:
    maps = {"x": voxels((5, 2, [2, 0, 0]), (5, 2, [1, 1, 0])), "y": voxels((90, 2, [2, 0, 0]))}
    records = [record(table, scene=scene) for scene, table in maps.items()]
    judged = [dataclasses.replace(r, statistics=(describe(maps[r.unit.scene]))) for r in records]
    *_, total = rows_of(study(*judged), "uncertainty")
    entropies = [record.statistics.uncertainty.entropy_op2.value for record in judged]
    assert total["scene"] == "Mean"
    assert total["entropy_op2"] == pytest.approx(np.mean(entropies))


@pytest.mark.parametrize(
    ("names", "begin"),
    [
        (["espnetv2_voc scale=0.5", "espnetv2_voc scale=2.0"], "espnetv2_voc "),
        (["sim-steady", "sim-flicker"], ""),
        (["a long name of one model"], ""),
        (["segformer_b0", "segformer_b0_ade20k_finetuned"], "segformer_"),
        (["segformer_b0 ", "segformer_b0 more and more"], ""),
    ],
)
def test_long_names_are_written_without_what_all_begin_with(names, begin) -> None:
    assert common_beginning(names) == begin
