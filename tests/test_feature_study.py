"""The study of features: its tables of made numbers, its errors, and the tables of the page."""

from __future__ import annotations

import re
from pathlib import Path

import feature_study
import streets_analysis as analysis

ROOT = Path(__file__).parents[1]
RESULTS, PAGE = ROOT / "results", ROOT / "docs/open-vocabulary.md"


def made(network, street, feature_alpha, alpha, **more):
    """A row of a network on a street, with all columns of alpha."""
    numbers = {"feature_alpha": feature_alpha, "alpha": alpha, "meaning": alpha, "groups": alpha}
    fields = {"data": "streets", "network": network, "street": street, "family": network[0], "merged": "", "level": ""}
    return fields | numbers | {"verdict": "unstable", "accuracy": alpha, "miou": alpha} | more


def test_features_are_compared_with_labels_network_by_network(monkeypatch):
    monkeypatch.setattr(analysis, "SAMPLES", 20)
    alphas = ((0.3, 0.6, 0.4), (0.5, 0.4, 0.45), (0.7, 0.9, 0.8))
    rows = [
        made(f"n{n}", f"{s}", alpha + 0.2, alpha)
        for n, of_network in enumerate(alphas)
        for s, alpha in enumerate(of_network)
    ]
    grid = analysis.StreetGrid(rows)
    assert "| features | +.20 (+.20 to +.20) | 100 % |" in feature_study.differences_table(grid)
    assert "| groups | +.00 (+.00 to +.00) | 0 % |" in feature_study.differences_table(grid)
    assert feature_study.correlations_table(grid)[-1].startswith("| features | labels | +1.00 (")
    assert feature_study.streets_table(grid)[2:] == [
        "| n2 | .80 | 1.00 | .80 | .80 | .80 |", "| n1 | .45 | .65 | .45 | .45 | .45 |",
        "| n0 | .43 | .63 | .43 | .43 | .43 |",
    ]  # fmt: skip


def test_streets_on_which_classes_or_groups_hold_are_counted():
    rows = [
        made("n", "0", 0.9, 0.9, verdict="stable"),
        made("n", "1", 0.9, 0.7, level="stable", merged="road + sidewalk, car + truck"),
        made("n", "2", 0.9, 0.6, level="usable", merged="road + sidewalk"),
        made("n", "3", 0.9, 0.2),
    ]
    assert feature_study.kept_on_streets(rows)[2:] == ["| n | .60 | 1 | 1 | 1 | 1 | road + sidewalk (2) |"]


def test_without_results_it_says_how_they_are_made(tmp_path, capsys):
    assert feature_study.main(["show", "--results", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "features.csv is not there: python scripts/feature_study.py run" in line


def test_the_rows_of_the_page_are_those_of_the_results(monkeypatch):
    """Ends of bootstrap intervals are left out: they take a minute."""
    monkeypatch.setattr(analysis, "SAMPLES", 3)
    rows = analysis.load(RESULTS / "features.csv")
    of_streets = [row for row in analysis.load(RESULTS / "streets.csv") if row["condition"] == "main"]
    accuracy = {(row["network"], row["street"]): row for row in of_streets}
    tables = feature_study.tables(rows, accuracy)
    ends = re.compile(r" \([+-]?\d?\.\d+ to [+-]?\d?\.\d+\)")
    lines = {ends.sub("", line) for table in tables.values() for line in table}
    page = PAGE.read_text().partition("## Real networks")[2].partition("\n## ")[0]
    printed = [ends.sub("", line) for line in page.splitlines() if line.startswith("| ")]
    assert len(printed) > 20
    assert [line for line in printed if line not in lines] == []
