"""A finished run in a notebook: data frames, Arrow, and what objects show of themselves."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
import tiny_scene
from posed_config import configure
from posed_scene import fails
from records import record, study, voxels

import semstab
from semstab.core.palette import KIND_COLORS
from semstab.data.statistics import StabilityVerdict
from semstab.errors import ConfigError, DataError, MissingDependencyError
from semstab.metrics import dominant, sbd, vss


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loaded")
    tiny_scene.write(folder / "scene")
    semstab.run(configure(folder / "scene", check=None, events=True), out=folder / "run", report=False)
    return semstab.load(folder / "run")


def test_the_summary_has_a_row_a_unit_and_a_unit_series_and_events(run):
    assert list(run.summary["model"]) == ["a", "b"]
    for (_, row), summary in zip(run.summary.iterrows(), run.result.runs, strict=True):
        assert row["vss_all"] == summary.map_summary.means.value["vss"]
        assert row["entropy_op3"] == summary.map_summary.recurrent.means.value["entropy"]
        assert row["voxels"] == summary.map_summary.voxels
    assert list(run.series(model="b")["frame"]) == [0, 1, 2]
    assert len(run.events(model="b")) == run.table(model="b").op.sum()
    fails(ConfigError, "2 units fit", run.table)


def test_the_summary_has_the_number_that_decides_with_its_interval_and_the_level(run):
    assert run.summary.equals(run.result.summary)
    for (_, row), unit_record in zip(run.summary.iterrows(), run.result.select(), strict=True):
        statistics = unit_record.statistics
        alpha = statistics.headline.alpha
        assert row["verdict"] == statistics.verdict.level
        np.testing.assert_equal(
            [row[name] for name in ("probability", "alpha", "alpha_low", "alpha_high", "confidence")],
            [statistics.verdict.probability, alpha.value, alpha.low, alpha.high, alpha.level],
        )
        assert row["compensated_flicker_percent"] == unit_record.image_space.compensated_flicker_percent


def test_the_row_of_a_unit_has_the_level_of_all_pixels_with_its_probability(run):
    summary = run.result.runs[0]
    for verdict, said in (
        (StabilityVerdict("stable", 0.9, ""), ("stable", 0.9)),
        (StabilityVerdict("stable", 0.9, "", "usable", 0.92, 0.7), ("usable", 0.7)),
    ):
        judged = dataclasses.replace(summary, statistics=dataclasses.replace(summary.statistics, verdict=verdict))
        assert (judged.row()["verdict"], judged.row()["probability"]) == said
    row = dataclasses.replace(summary, statistics=None).row()
    assert row["verdict"] == ""
    assert np.isnan([row[name] for name in ("probability", "alpha", "alpha_low", "agreeing")]).all()


def test_a_run_at_a_prompt_is_a_few_lines(run):
    first, *rest = repr(run).splitlines()
    assert first.startswith(f"{run.folder}: <Result '")
    verdicts = [unit_record.statistics.verdict for unit_record in run.result.select()]
    assert [line.split(", alpha")[0] for line in rest] == [
        f"  scene, {model}: {verdict}" for model, verdict in zip("ab", verdicts, strict=True)
    ]


def test_the_parts_of_a_run_at_a_prompt_are_one_line_each(run):
    of_model = run.result.record(model="a")
    verdict = str(of_model.statistics)
    stated = verdict.removeprefix("<MapStatistics 'a': ").removesuffix(">")
    assert stated.startswith(f"{of_model.statistics.verdict}, alpha ")
    assert repr(of_model) == f"<Record scene, a: {stated}; numpy>"
    assert repr(run.table(model="a")) == f"<VoxelTable: {of_model.map_summary.voxels:,} voxels of 0.25 m, 3 classes>"
    assert repr(run.events(model="a")).startswith("<Events: ")


def test_a_comparison_and_a_gate_at_a_prompt_are_a_few_lines(run):
    a, b = f"{run.folder}:a", f"{run.folder}:b"
    compared = semstab.compare(a, b)
    (line,) = repr(compared).splitlines()[1:]
    assert line.startswith("  b: ")
    assert repr(compared.scenes[0]).splitlines()[1:] == [f"  {compared.scenes[0].against[0].stated}"]
    assert repr(compared.overall[0]) == f"<Against {line.strip()}>"
    judged = semstab.gate(b, a, semstab.GateConfig(rules=("psa drop < 1",)))
    assert repr(judged).splitlines()[1:] == [f"  {judged.judgements[0].stated}"]
    assert repr(judged.judgements[0]) == f"<Judgement {judged.judgements[0].stated}>"


def test_a_column_of_the_stored_file_has_its_name_and_values_in_a_data_frame(run):
    file = run.result.record(model="a").voxels_file
    frame, stored = run.table(model="a").to_pandas(), pq.read_table(file)
    for name in set(stored.column_names) - {"evidence"}:  # which has a column a class in the frame
        np.testing.assert_array_equal(frame[name], stored.column(name).to_pandas(), err_msg=name)


def test_a_table_has_every_voxel_and_its_classes_by_name(run):
    table = run.table(model="a")
    frame = table.to_pandas()
    np.testing.assert_array_equal(frame[["x", "y", "z"]], table.centers)
    np.testing.assert_array_equal(frame["sbd"], sbd(table))
    assert list(frame["class"]) == [table.classes[k] for k in dominant(table)]
    np.testing.assert_array_equal(frame[["evidence_wall", "evidence_door", "evidence_window"]], table.evidence)
    arrow = table.to_arrow()
    np.testing.assert_array_equal(arrow.column("vss"), vss(table))
    assert arrow.column("sbd").null_count == np.count_nonzero(table.op < 2) > 0
    assert "evidence_0" in dataclasses.replace(table, classes=()).to_arrow().column_names


def test_what_a_notebook_shows(run):
    page = run._repr_html_()
    assert "<td>scene</td><td>a</td><td>numpy</td>" in page
    statistics = run.result.records[0].statistics
    assert f"{statistics.verdict}</td><td>{statistics.headline.alpha.text()}</td>" in page
    assert f'<td style="color: {KIND_COLORS["open"]}' in page  # no verdict
    assert page == run.result._repr_html_()
    table = run.table(model="a")
    assert f"{len(table)} voxels of 0.25 m, 3 classes" in table._repr_html_()
    assert f"<td>all</td><td>{len(table)}</td><td>{vss(table).mean():.3f}</td>" in table._repr_html_()
    assert table.image().shape[2] == 3
    page = study(record(voxels((1, 1, [1, 0, 0])), scene="<b>&"))._repr_html_()
    assert "&lt;b&gt;&amp;" in page
    assert "<td>-</td>" in page  # SBD of a voxel seen once


def test_what_is_missing_is_told(run, tmp_path, monkeypatch):
    fails(DataError, "summary.json: cannot be read", semstab.load, tmp_path)
    with_files = record(
        voxels((1, 1, [1, 0, 0])), voxels_file=tmp_path / "v/x.parquet", series=tmp_path / "s__m__numpy.csv"
    )
    bare = dataclasses.replace(run, result=study(with_files))
    fails(ConfigError, "with --events", bare.events)
    fails(DataError, "s__m__numpy.csv: cannot be read", bare.series)
    monkeypatch.setitem(sys.modules, "pandas", None)
    fails(MissingDependencyError, r"pip install 'semstab\[pandas\]'", run.table(model="a").to_pandas)
