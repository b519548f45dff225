"""The study of networks on streets: its statistics on made numbers, its errors, and the page's tables."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import streets
import streets_analysis as analysis

ROOT = Path(__file__).parents[1]
RESULTS, PAGE = ROOT / "results", ROOT / "docs" / "real-networks.md"


def made(accuracy, **columns):
    """Rows of networks of two families on streets, with columns (networks, streets)."""
    rows = []
    for n, of_network in enumerate(accuracy):
        for s, value in enumerate(of_network):
            more = {name: column[n][s] for name, column in columns.items()}
            rows.append(
                {"network": f"n{n}", "street": f"{s:02d}", "family": "ab"[n % 2], "of": "", "accuracy": value} | more
            )
    return rows


@pytest.fixture
def grid():
    rng = np.random.default_rng(0)
    accuracy = rng.uniform(0.3, 0.9, (6, 5))
    return analysis.StreetGrid(made(accuracy, alpha=accuracy**2, sbd=1 - accuracy, flip=-accuracy))


def test_a_measure_that_rises_with_accuracy_answers_every_question(grid):
    accuracy = grid.column("accuracy")
    for statistic in analysis.QUESTIONS.values():
        assert statistic(2 * accuracy - 1, accuracy) == pytest.approx(1.0)


def test_a_measure_that_falls_with_accuracy_orders_no_pair(grid):
    accuracy = grid.column("accuracy")
    assert analysis.within_a_street(grid.column("flip"), accuracy) == pytest.approx(-1.0)
    assert analysis.pairs_on_a_street(grid.column("flip"), accuracy) == 0.0


def test_measures_of_which_less_is_better_are_turned(grid):
    assert analysis.within_a_street(grid.column("sbd"), grid.column("accuracy")) == pytest.approx(1.0)


def test_pairs_of_nearly_the_same_accuracy_are_not_asked_for():
    accuracy = np.array([[0.70], [0.70 + analysis.APART / 2], [0.80]])
    assert analysis.pairs_on_a_street(np.array([[2.0], [1.0], [3.0]]), accuracy) == 1.0


def test_an_interval_of_noise_holds_zero_and_that_of_a_law_does_not(grid):
    noise, accuracy = np.random.default_rng(3).normal(size=(6, 5)), grid.column("accuracy")
    _, low, high = analysis.with_interval(grid, noise, analysis.streets_of_a_network, accuracy)
    assert low < 0 < high
    value, low, high = analysis.with_interval(grid, accuracy**2, analysis.streets_of_a_network, accuracy)
    assert (value, low, high) == pytest.approx((1.0, 1.0, 1.0))


def test_a_sample_draws_families_and_networks_within_them(grid):
    networks, columns = next(grid.samples())
    assert len(columns) == 5
    drawn = {grid.family[k] for k in networks}
    assert drawn <= {"a", "b"}
    assert len(networks) == 6


def test_what_a_measure_adds_to_the_softmax_is_its_own_error():
    rng = np.random.default_rng(1)
    softmax, alpha = rng.uniform(size=(2, 6, 5))
    assert analysis._left_out(0.2 + 0.3 * softmax + 0.4 * alpha, [softmax, alpha]) < 1e-9
    assert analysis._left_out(0.2 + 0.3 * softmax + 0.4 * alpha, [softmax]) > 0.05


def test_streets_are_written_with_the_calibration_that_their_copy_lacks(tmp_path):
    source = tmp_path / "clone/dataset/sequences"
    for street in streets.STREETS:
        for folder, suffix in (("image_2", "png"), ("velodyne", "bin"), ("labels", "label")):
            (source / street / folder).mkdir(parents=True)
            for k in range(streets.FRAMES + 2):
                (source / street / folder / f"{k:06d}.{suffix}").write_bytes(b"%d" % k)
        (source / street / "calib.txt").write_text("P2: 1 0 0 0 0 1 0 0 0 0 1 0\n")
        (source / street / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 12)
    streets.prepare(tmp_path / "clone", tmp_path / "work")
    of_03 = tmp_path / "work/data/03"
    assert len(list((of_03 / "image_2").iterdir())) == len((of_03 / "poses.txt").read_text().splitlines()) == 10
    tr = next(line for line in (of_03 / "calib.txt").read_text().splitlines() if line.startswith("Tr:"))
    assert len(np.array(tr.split()[1:], float)) == 12


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["prepare", "nowhere", "--work", "w"], "git clone https://github.com/rancheng/mini_kitti_dataset"),
        (["run", "--work", "nowhere"], "no predictions; python scripts/streets.py predict"),
        (["show", "--results", "nowhere"], "is not there: python scripts/streets.py run"),
    ],
)
def test_a_mistake_is_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert streets.main(words) == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.splitlines()) == 1


def test_the_rows_of_the_page_are_those_of_the_results(monkeypatch):
    """The page has the rows that matter of each table, at least three."""
    monkeypatch.setattr(analysis, "SAMPLES", 3)  # ends of intervals are left out: they take a minute
    rows, classes = (analysis.load(RESULTS / name) for name in ("streets.csv", "streets-classes.csv"))
    page = re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)[1]
    said = [block.splitlines() for block in re.findall(r"(?:^\|.*\n)+", values(page), re.MULTILINE)]
    tables = streets.tables(rows, classes)
    choices = [line.split(" | ")[:2] for line in tables.pop("choices")[2:]]
    assert len(said) == len(tables)
    for (title, lines), printed in zip(tables.items(), said, strict=True):
        expected = values("\n".join(lines)).splitlines()
        assert printed[:2] == expected[:2], title
        assert len(printed) >= 5, title
        assert set(printed) <= set(expected), title
    *others, (_, within_families) = [(name, alpha) for name, alpha in choices if alpha.strip()]
    values_of_alpha = sorted(alpha for _, alpha in others)
    assert f"over all streets is {values_of_alpha[0]} to {values_of_alpha[-1]};" in page
    assert f"alone it is\n{within_families}." in page
    found = re.search(r"rank correlation is ([+-][.\d]+)\.\n", page)
    assert found
    assert any(title.endswith(found[1]) for title in tables)


def values(text):
    """The text without the ends of intervals."""
    return re.sub(r" \([+-]?\d?\.\d+ to [+-]?\d?\.\d+\)", "", text)
