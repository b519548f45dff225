"""Frames that stand out: by hand, by the textbook's example, and on a run whose bad frames are known."""

import base64
import csv
import dataclasses
import io
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from posed_config import configure
from posed_writer import write_posed
from simulated_events import spots_at

from semstab import Frame, Intrinsics
from semstab.api import run_study
from semstab.recording.voxel_maps import agreement_report
from semstab.report.page import render
from semstab.report.tables import tables
from semstab.report.terminal import screen
from semstab.statistics import Views
from semstab.statistics.frame_disagreement import (
    LoneDisagreement,
    largest_deviate,
    lone_disagreement,
    outlying_frames,
    outlying_rows,
    stands_alone,
)

W, H, FOCAL, DEPTH, BLOCK, FRAMES = 192, 128, 128.0, 2.03, 16, 15
BAD = {"clean": set(), "every-third": {0, 3, 6, 9, 12}}
CLASSES = ["wall", "door", "window"]


def spots(places):
    """Observations of places, each with its labels in order of the views that see it: {view: label}."""
    spot = np.array([k for k, place in enumerate(places) for _ in place])
    view, label = (np.array([row[i] for place in places for row in place.items()]) for i in (0, 1))
    views = Views.from_rows([[10 * t, t, 0.0, 0.0, np.nan, 1.0] for t in range(int(view.max()) + 1)])
    point = np.array([[8.0 * k, 0, 0] for k in range(len(places))])
    return dataclasses.replace(spots_at(point, spot, view, label, len(views)), views=views)


def test_a_view_stands_alone_where_those_before_and_after_agree_on_another_class() -> None:
    answers = spots(
        [dict(enumerate(labels)) for labels in ((0, 1, 0), (0, 0, 1, 1), (1, 1, 1, 1, 1, 0), (0, 1), (2, 0, 1))]
    )
    alone = stands_alone(answers.observations()).tolist()
    assert alone == [False, True, False, *4 * [False], *5 * [False], True, False, False, *3 * [False]]


def test_the_frames_beside_a_bad_one_are_not_blamed() -> None:
    """Of seven views the fourth errs at all places: it alone has an excess, by its index, not by its position."""
    found = lone_disagreement(spots([{t: int(t == 3) for t in range(7)} for _ in range(60)]))
    assert found.frame.tolist() == [0, 10, 20, 30, 40, 50, 60]
    assert found.share.tolist() == [0, 0, 0, 1, 0, 0, 0]
    blamed = outlying_frames(found, 7, name="frame-{}".format).frames
    assert [(outlier.frame, outlier.name, outlier.places, outlier.share, outlier.null) for outlier in blamed] == [
        (30, "frame-30", 60, 1, 0)
    ]


def test_two_views_of_a_place_tell_nothing() -> None:
    assert len(lone_disagreement(spots([{0: 0, 1: 1}] * 60)).frame) == 0


@given(st.lists(st.lists(st.integers(0, 2), min_size=3, max_size=9), min_size=1, max_size=12))
def test_the_excesses_of_all_views_of_a_place_sum_to_nothing(places) -> None:
    """Each place adds 0 to the sum over frames of places times excess, whatever its labels are."""
    found = lone_disagreement(spots([dict(enumerate(labels)) for labels in places]))
    assert found.places @ found.excess == pytest.approx(0.0, abs=1e-9)


ROSNER = """
-.25 .68 .94 1.15 1.20 1.26 1.26 1.34 1.38 1.43 1.49 1.49 1.55 1.56 1.58 1.65 1.69 1.70 1.76 1.77 1.81 1.91 1.94 1.96
1.99 2.06 2.09 2.10 2.14 2.15 2.23 2.24 2.26 2.35 2.37 2.40 2.47 2.54 2.62 2.64 2.90 2.92 2.92 2.93 3.21 3.26 3.30 3.59
3.68 4.30 4.64 5.34 5.42 6.01"""
"""Example of Rosner (1983), with three outliers, as in NIST/SEMATECH's handbook of statistical methods, 1.3.5.17.3."""


def test_outliers_are_those_of_the_published_example() -> None:
    values = np.array(ROSNER.split(), float)
    assert values[outlying_rows(values, 0.025)].tolist() == [5.34, 5.42, 6.01]
    published = [3.158, 3.151, 3.143, 3.136, 3.128]
    assert [largest_deviate(54 - k, 0.025) for k in range(5)] == pytest.approx(published, abs=1e-3)


def test_five_outliers_of_fifteen_do_not_hide_each_other() -> None:
    values = np.where(np.arange(15) % 3 == 0, 0.1, 0.0) + np.random.default_rng(0).normal(0, 0.01, 15)
    assert outlying_rows(values).tolist() == [0, 3, 6, 9, 12]


@pytest.mark.parametrize("n", [6, 15, 60])
def test_of_equal_frames_one_is_named_as_rarely_as_stated(n) -> None:
    rng, trials = np.random.default_rng(n), 400
    assert sum(len(outlying_rows(rng.standard_normal(n))) > 0 for _ in range(trials)) <= 0.07 * trials


def test_frames_that_see_too_little_are_counted_and_not_judged() -> None:
    n, zero = np.array([*[100] * 7, 20]), np.zeros(8)
    found = outlying_frames(LoneDisagreement(np.arange(8), n, np.where(n == 20, 1.0, 0.0), zero), views=10)
    assert (found.judged, found.unjudged, found.frames) == (7, 3, ())
    few = outlying_frames(LoneDisagreement(np.arange(5), n[:5], zero[:5], zero[:5]), views=5)
    assert (few.judged, few.unjudged) == (0, 5)


def test_an_excess_below_three_in_a_hundred_places_is_not_named() -> None:
    share = np.array([0.029, *[0.0] * 9])
    outliers = [
        outlying_frames(LoneDisagreement(np.arange(10), np.full(10, 900), times * share, 0 * share), 10).frames
        for times in (1, 2)
    ]
    assert [len(outlying) for outlying in outliers] == [0, 1]


# --- A run ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A camera moves along a wall; blocks of labels err anew in each frame, in every third one 15 % more of them."""
    root = tmp_path_factory.mktemp("frames") / "wall"
    camera, depth = Intrinsics(FOCAL, FOCAL, W / 2, H / 2), np.full((H, W), DEPTH, np.float32)
    frames = {model: [] for model in BAD}
    for i in range(FRAMES):
        truth = np.tile(((np.arange(W) + i * 0.2 * FOCAL / DEPTH).astype(int) // 48 % 3).astype(np.uint8), (H, 1))
        pose = np.eye(4)
        pose[:3, 3] = [0.2 * i + 0.003, 0.003, 0.0]
        for model, bad in BAD.items():
            share = 0.04 + 0.15 * (i in bad)
            wrong = np.random.default_rng([len(bad), i]).permutation(H * W // BLOCK**2) < share * H * W / BLOCK**2
            shift = np.kron(wrong.reshape(H // BLOCK, W // BLOCK), np.ones((BLOCK, BLOCK), np.uint8))
            color = np.repeat(truth[..., None] * 80, 3, axis=2)
            labels = ((truth + shift) % 3).astype(np.uint8)
            frames[model].append(Frame(i, depth, camera, pose, labels=labels, color=color))
    write_posed(root, [f"shot-{7 * i:03d}" for i in range(FRAMES)], frames, classes=CLASSES, up_axis="-y")
    folder = Path(tmp_path_factory.mktemp("run")) / "out"
    return run_study(configure(root, voxel_size=0.125, check=None), folder, report=False), folder


def names(frames):
    return {f"shot-{7 * i:03d}" for i in frames}


def in_text(text):
    return set(re.findall(r"shot-\d+", text))


@pytest.mark.parametrize("model", BAD)
def test_the_bad_frames_and_no_other_are_named_by_statistics_series_table_and_viewer(run, model) -> None:
    result, _ = run
    record = result.record(model=model)
    found = record.statistics.outlying_frames
    assert {outlier.name for outlier in found.frames} == names(BAD[model])
    assert found.judged == FRAMES
    with record.series.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["name"] for row in rows if row["outlying"] == "1"} == names(BAD[model])
    of_series = {row["name"]: float(row["lone_percent"]) for row in rows}
    assert all(of_series[outlier.name] == pytest.approx(100 * outlier.share) for outlier in found.frames)
    (table,) = (table for table in tables(result) if table.name == "frames")
    (group,) = (group for group in table.groups if group.name == model)
    assert {row[1] for row in group.rows} == (names(BAD[model]) or {"none"})
    assert in_text(agreement_report(record.statistics)) == names(BAD[model])


def test_screen_and_report_name_the_same_frames_with_pictures_of_the_worst(run) -> None:
    result, folder = run
    assert in_text("\n".join(screen(result))) == names(BAD["every-third"])
    page = render(result, folder)
    visible = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    sentence = "".join(re.findall(r"frames that stand out[^<]*", visible))  # worst places list their own frames
    assert in_text(sentence) == names(BAD["every-third"])
    worst = result.record(model="every-third").statistics.outlying_frames.frames[:3]
    titles = re.findall(r"<figcaption>every-third, (shot-\d+): alone at", visible)
    assert titles == [outlier.name for outlier in worst]
    pictures = re.findall(r'<img src="data:image/png;base64,([^"]*)" alt="alone"', visible)
    shares = [(pixels(outlier) == [213, 94, 0]).all(axis=2).mean() for outlier in pictures]
    assert len(shares) == len(worst)
    assert all(0.05 < share < 0.2 for share in shares)  # 19 % of the blocks err, not all where both neighbours see them


def pixels(encoded):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB"))
