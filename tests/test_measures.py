"""A measure is declared once: one that is registered here, at run time, is found in everything that a run writes."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from typing import get_type_hints

import numpy as np
import pyarrow.parquet as pq
import pytest
import rerun as rr
import tiny_study
from posed_config import configure
from rich.console import Console

import semstab
from semstab import VoxelTable
from semstab.api import run_study
from semstab.comparison.quantities import quantities
from semstab.data import records, results, statistics
from semstab.data.measures import RESERVED, VSS, Measure, MeasureMeans, measures, register, registered
from semstab.engine import load_result
from semstab.errors import ConfigError
from semstab.recording import Recording, color_modes
from semstab.recording.voxel_maps import defaults
from semstab.report import page
from semstab.report.comparison.own_models import own_models
from semstab.report.figures.distributions import draw_ecdf, draw_persistence, draw_sweep, histograms, informative
from semstab.report.figures.maps import draw_stability
from semstab.report.figures.topdown import FromAbove
from semstab.report.means import describe, levels
from semstab.report.tables import tables, to_csv
from semstab.report.terminal import columns, print_answer, print_summary, row_of
from semstab.statistics.cluster_sums import BY_CLASS, FUNCTIONALS


def second_largest(table):
    """The second largest belief (n,), where a voxel was seen three times or more."""
    belief = np.sort(table.evidence / table.evidence.sum(axis=1, keepdims=True), axis=1)[:, -2]
    return np.where(table.op >= 3, belief, np.nan)


RIVAL = Measure(
    key="rival", title="Rival", short="R2", unit="parts", better="lower", digits=(2, 5), of=second_largest,
    range=(0.0, 0.4), lowest_op=3, largest=0.5, chart=True, headline=True,
)  # fmt: skip


@pytest.fixture(scope="module")
def registered_rival():
    with registered(RIVAL):
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory, registered_rival):
    """A run of two backends with statistics and a recording: its result and folder."""
    base = tmp_path_factory.mktemp("rival")
    root, out = tiny_study.write(base / "data" / "wall"), base / "run"
    config = configure(root, backends=["numba"], check="numpy", statistics=True)
    return semstab.run(config, out=out, observers=[Recording(out / "recording.rrd")]), out


@pytest.fixture(scope="module")
def study(tmp_path_factory, registered_rival):
    """A study with a sweep and statistics: its result and folder."""
    base = tmp_path_factory.mktemp("rivals")
    config = tiny_study.configure(
        tiny_study.write(base / "data" / "wall"), statistics=True, sweeps={"voxel_size": [0.25, 0.5]}
    )
    return run_study(config, base / "study", report=False), base / "study"


def test_the_summary_has_its_means_and_reads_them_back(run, study) -> None:
    result, out = run
    summary = json.loads((out / "summary.json").read_text())
    entry, table = summary["runs"][0], VoxelTable.load(out / "voxels" / "wall__a__numba.parquet")
    values = second_largest(table)
    assert entry["rival_all"] == pytest.approx(np.nanmean(values))
    assert entry["recurrent"]["rival_voxels_op3"] == np.count_nonzero(table.op >= 3)
    assert entry["strata"][0]["rival"] is None
    assert result.runs[0].map_summary[RIVAL] == entry["rival_all"]
    assert all("rival" in row["differences"] for row in summary["agreement"])
    found, folder = study
    again = load_result(folder)
    assert [row.map_summary[RIVAL] for row in again.records] == [row.map_summary[RIVAL] for row in found.records]
    assert again.records[0].map_summary.recurrent.defined(RIVAL) > 0


def test_parquet_has_it_voxel_by_voxel(run) -> None:
    path = run[1] / "voxels" / "wall__b__numpy.parquet"
    values = pq.read_table(path, columns=["rival"]).column("rival").to_numpy()
    np.testing.assert_array_equal(values, second_largest(VoxelTable.load(path)))


def test_the_terminal_shows_it(run) -> None:
    result, _ = run
    text = io.StringIO()
    print_summary(result, Console(file=text, width=120), verbose=True)
    assert text.getvalue().count("Rival") >= 3  # scenes, persistence, classes


def test_the_report_draws_it_by_op_and_cards_and_rows_of_models_have_it(run, study) -> None:
    result, _ = run
    record = result.select()[0]
    assert [head for head, _ in columns()[5:-1]] == ["VSS", "SBD", "Rival"]
    assert ("Rival", "OP>=3") in columns()
    assert len(row_of(record)) == len(columns())
    titles = [chart["title"] for chart in page._by_op(result)]
    assert titles == [f"{title} by observation persistence" for title in ("VSS", "SBD", "Rival")]
    numbers = {name: note for name, _, note in page._numbers([record], [record.statistics], record.statistics)}
    few = "fewer than 1,000 voxels with OP ≥ 3"
    assert [numbers[f"{name} (OP>=3)"] for name in ("VSS", "SBD", "Rival")] == [few] * 3
    text = io.StringIO()
    print_answer(study[0], Console(file=text, width=120))
    said = " ".join(text.getvalue().split())
    assert "-: fewer than 1,000 voxels were seen in 3 frames or more, too few for VSS, SBD, Rival" in said
    assert [chart["title"] for chart in page._sweeps(study[0])] == ["alpha by voxel size", "VSS (OP>=3) by voxel size"]


def test_tables_and_the_comparison_have_it(study) -> None:
    made = [*tables(study[0]), *own_models(study[0])]
    found = {table.name: list(csv.DictReader(io.StringIO(to_csv(table)))) for table in made}
    base = {record.unit.model: record.map_summary for record in study[0].select()}
    for name in ("scenes", "persistence", "classes", "cross_model", "fusion", "sensitivity_voxel_size"):
        assert all({"rival", "rival_all"} & row.keys() for row in found[name]), name
    assert [float(row["rival_all"]) for row in found["scenes"]] == [round(t[RIVAL], 2) for t in base.values()]
    assert all(float(row["max_rival"]) < 1e-9 for row in found["agreement"])
    (difference,) = (row for row in found["comparison_all"] if row["measure"] == "rival_op3" and not row["class"])
    low, value, high = (float(difference[f"difference{part}"]) for part in ("_low", "", "_high"))
    assert low <= value <= high


def titles(figure) -> list[str]:
    return [axes.get_title(loc="left") or axes.get_ylabel() for axes in figure.axes]


def test_figures_show_it(study) -> None:
    result, _ = study
    table = result.select()[0].table()
    found = {"a": histograms(table)}
    swept = {"a": levels(result, "voxel_size", "a")}
    panels = (
        draw_ecdf(found, informative(found.values())),
        draw_persistence(found),
        draw_sweep(describe("voxel_size"), swept),
        draw_stability(FromAbove.from_table(table, (0, -1, 0))),
    )
    for figure in panels:
        assert any("rival" in title.lower() for title in titles(figure)), titles(figure)
    (bars,) = (axes for axes in panels[2].axes if axes.get_title(loc="left").endswith("Rival (parts)"))
    means = [level.mean(lambda p: p.every[RIVAL]) for level in swept["a"]]
    assert bars.containers[0].lines[0].get_ydata() == pytest.approx(means)


def test_the_recording_colours_by_it(run) -> None:
    look = color_modes()["rival"]
    assert look.title == "Rival (0 to 0.4 and more parts; black: OP < 3)"
    (archetype,) = defaults("rival")
    assert archetype.value_range.as_arrow_array().to_pylist() == [[0.0, 0.4]]  # type: ignore[union-attr]
    (store,) = rr.chunk.RrdReader(run[1] / "recording.rrd").recordings()
    columns = {
        name
        for chunk in rr.chunk.RrdReader(run[1] / "recording.rrd").stream(store=store)
        if "/map/a/" in chunk.entity_path
        for name in chunk.to_record_batch().schema.names
    }
    assert "rival:values" in columns


def test_it_is_gone_when_the_block_ends() -> None:
    before = measures()
    other = Measure(key="other", title="Other", better="higher", of=VSS.of, range=(0.0, 1.0))
    with registered(other):
        assert measures() == (*before, other)
        with pytest.raises(ConfigError, match="there is a measure 'other' already"):
            register(other)
    assert measures() == before


LATER = Measure(key="later", title="Later", better="lower", of=second_largest, range=(0.0, 1.0), lowest_op=2)


def test_one_that_was_declared_later_is_undefined_in_earlier_results(run, study) -> None:
    with registered(LATER):
        earlier = load_result(run[1])
        table = earlier.select()[0].map_summary
        assert np.isnan(table[LATER])
        assert np.isnan(table.recurrent[LATER])
        assert (table.recurrent.defined(LATER), table[RIVAL]) == (0, run[0].select()[0].map_summary[RIVAL])
        assert np.isnan(earlier.agreement[0].difference("later").max)
        texts = {made.name: to_csv(made) for made in (*tables(earlier), *tables(load_result(study[1])))}
        (row, *_) = csv.DictReader(io.StringIO(texts["agreement"]))
        assert (row["max_later"], row["verdict"]) == ("", "agree")
        print_summary(earlier, Console(file=(text := io.StringIO()), width=120), verbose=True)
        assert "voxels" in text.getvalue()


@pytest.mark.parametrize("key", ["share", "psa", "K", "voxels", "op", "alpha", "vss_voxels"])
def test_a_key_that_names_another_number_is_refused(key) -> None:
    other = Measure(key=key, title="Other", better="higher", of=VSS.of, range=(0.0, 1.0))
    with pytest.raises(ConfigError, match=f"'{key}' is the name of another number or field; choose another key"):
        register(other)


def test_reserved_keys_are_those_beside_a_measure_and_other_compared_numbers() -> None:
    def inline(cls):
        hints = get_type_hints(cls)
        return [hints[field.name] for field in dataclasses.fields(cls) if "inline" in field.metadata]

    def has_means(cls):
        return cls is MeasureMeans or any(map(has_means, inline(cls)))

    def fields(cls):
        names = set() if cls is MeasureMeans else {names.name for names in dataclasses.fields(cls)}
        return names.union(*map(fields, inline(cls)))

    kinds = {
        kind for module in (records, results, statistics) for kind in vars(module).values() if isinstance(kind, type)
    }
    beside = [kind for kind in kinds - {MeasureMeans} if dataclasses.is_dataclass(kind) and has_means(kind)]
    compared = {quantity.key for quantity in quantities()} | {*FUNCTIONALS, *BY_CLASS}
    keys = {measure.key for measure in measures()}
    assert set().union(*map(fields, beside), compared, {"op", "evidence", "label"}) - keys == RESERVED - keys
