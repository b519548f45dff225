"""The study of what would steady a model: what it recommends, and from the command line to the report."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import predicted_scene
import pytest
from PIL import Image
from typer.testing import CliRunner

from semstab.cli import app
from semstab.engine import load_result
from semstab.report.filter_study import FilterResult, FilterStudy, advice, filter_studies

NAN = float("nan")


def result_of(filters="", flicker=0.2, worth=0.8, **more):
    defaults = {
        "plain": flicker,
        "alpha": 0.5,
        "next_frame": worth,
        "accuracy": worth,
        "miou": worth,
        "consistent_wrong": 0.05,
        "changed": 0.2 if filters else 0.0,
        "seen": 0.9,
    }
    return FilterResult(filters, flicker, **{**defaults, "lag": 0.0, "coverage": 1.0, "milliseconds": 2.0, **more})


def study(*rows, truth=True):
    unknown = {"accuracy": NAN, "miou": NAN, "consistent_wrong": NAN, "lag": NAN}
    rows = [row if truth else dataclasses.replace(row, **unknown) for row in (result_of(), *rows)]
    return FilterStudy("net", rows[0], tuple(rows[1:]))


def said(found):
    return " ".join(advice(found))


@pytest.mark.parametrize("truth", [True, False])
def test_the_steadiest_is_not_the_best(truth):
    frozen = result_of("ema:0.98", flicker=0.001, worth=0.4, alpha=0.99)
    good = result_of("ema-warped:0.6", flicker=0.08, worth=0.9, alpha=0.8)
    found = study(frozen, good, truth=truth)
    assert found.best.filters == "ema-warped:0.6"
    assert [row.filters for row in found.misleading] == ["ema:0.98"]
    assert "Use --filter ema-warped:0.6 over net: flicker falls from 20.0 to 8.0 %" in said(found)
    assert "These filters lower flicker and make labels worse: ema:0.98." in said(found)
    assert ("There is no ground truth: the accuracy of labels" in said(found)) is not truth


def test_the_best_is_the_steadier_one_of_those_alike_and_alpha_alone_chooses_nothing():
    found = study(result_of("ema:0.9", worth=0.79, alpha=0.99, flicker=0.01))
    assert found.best is None
    assert said(found).startswith(
        "Use none of these filters over net: none lowers its flicker without a loss of accuracy"
    )
    found = study(result_of("ema:0.98", flicker=0.3, worth=0.4, plain=0.001, consistent_wrong=0.4, lag=4.5))
    assert found.best is None
    assert (
        "These filters lower flicker and make labels worse: ema:0.98. ema:0.98 has 0.1 % flicker at the same pixel"
        " (20.0 % without), but 40 %" in said(found)
    )
    assert "it follows changes 4.5 frames late" in said(found)
    rows = result_of("vote:3", 0.1, 0.9), result_of("vote:5", 0.05, 0.899), result_of("vote:9", 0.01, 0.88)
    assert study(*rows).best.filters == "vote:5"
    assert "Use --filter ema:0.6 --filter guided:8 over net" in said(study(result_of("ema:0.6+guided:8", 0.1, 0.9)))


@pytest.mark.parametrize(
    "loss", [{"lag": 1.2}, {"coverage": 0.9}, {"miou": 0.7}, {"accuracy": 0.79}, {"flicker": 0.25}], ids=str
)
def test_what_a_filter_must_not_cost(loss):
    found = study(dataclasses.replace(result_of("vote:9", flicker=0.05, worth=0.9), **loss))
    assert found.best is None


def test_a_filter_that_changes_next_to_nothing_is_not_recommended():
    found = study(result_of("ema:0.3", flicker=0.1, worth=0.9, changed=0.0003))
    assert found.best is None
    assert "These filters change fewer than 0.1 % of the labels: ema:0.3." in said(found)
    found = study(result_of("ema:0.3", flicker=0.1, worth=0.9, changed=0.0012))
    assert "flicker falls from 20.0 to 10.0 %, 0.12 % of the labels change" in said(found)
    assert "fewer than" not in said(found)


def test_nothing_is_recommended_where_flicker_is_known_of_next_to_nothing():
    found = study(result_of("ema:0.3", flicker=0.1, worth=0.9))
    assert found.best is not None
    for visible_share in (0.003, NAN):
        blind = dataclasses.replace(found, unfiltered=dataclasses.replace(found.unfiltered, seen=visible_share))
        assert blind.best is None
        assert said(blind).startswith("No filter over net is recommended: two frames in a row see the same surface at")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Labels of a wall that flicker, with the truth, through the command to the end."""
    folder = tmp_path_factory.mktemp("filters")
    scene = predicted_scene.write(folder / "flight", frames=8)
    (scene / "scene.yaml").write_text("classes: [dark, bright, blue]\n")
    rng = np.random.default_rng(0)
    for name in ("gt", "net"):
        (scene / "labels" / name).mkdir(parents=True)
    for k in range(8):
        truth = ((np.arange(80) + 2 * k) // 9 % 2 + np.zeros((48, 1))).astype(np.uint8)
        noisy = np.where(rng.random(truth.shape) < 0.25, 1 - truth, truth).astype(np.uint8)
        for name, labels in (("gt", truth), ("net", noisy)):
            Image.fromarray(labels).save(scene / f"labels/{name}/{k:03d}.png")
    filters = [w for f in ("ema:0.98", "ema-warped:0.6", "vote:3+guided:4") for w in ("--filter", f)]
    words = ["filters", "--data", scene, "--model", "net", *filters, "--voxel-size", "0.1", "--out", folder / "out"]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return folder, result.output


def test_the_folder_and_the_terminal_hold_what_to_use(done):
    _, text = done
    assert "Use --filter ema-warped:0.6 over net: flicker falls from" in " ".join(text.split())
    table = text[text.index("Use --filter") :]
    assert "ema-warped:0.6" in table
    folder, _ = done
    rows = json.loads((folder / "out/tables/tables.json").read_text())["filters"]
    page = (folder / "out/report.html").read_text()
    assert "Use --filter ema-warped:0.6 over net" in page
    (found,) = filter_studies(load_result(folder / "out"))
    assert [row.filters for row in found.filtered] == ["ema:0.98", "ema-warped:0.6", "vote:3+guided:4"]
    best, frozen = found.best, found.filtered[0]
    assert best.accuracy > found.unfiltered.accuracy + 0.05
    assert frozen.consistent_wrong > 0.2
    assert len(rows["rows"]) == 4


def test_a_second_start_computes_nothing(done):
    folder, _ = done
    filters = ["--filter", "ema:0.98", "--filter", "ema-warped:0.6", "--filter", "vote:3+guided:4"]
    words = ["filters", "--data", folder / "flight", "--model", "net", *filters, "--voxel-size", "0.1"]
    result = CliRunner().invoke(app, [str(w) for w in (*words, "--out", folder / "out", "--report", "off")])
    assert result.exit_code == 0, result.output
    units = json.loads((folder / "out/manifest.json").read_text())["units"]
    assert (units["kept"], units["computed"]) == (4, 0)


@pytest.mark.parametrize(("words", "said"), [
    (("--model", "nut"), "model 'nut' is not there; did you mean 'net'?"),
    (("--model", "net", "--filter", "ema:0.6+smooth"), "filter 'smooth' is not known"),
    (("--predict", "nothing"), "model 'nothing' is not known"),
])  # fmt: skip
def test_bad_input_is_one_line(done, words, said):
    folder, _ = done
    command = ["filters", "--data", folder / "flight", *words, "--voxel-size", "0.1", "--out", folder / "bad"]
    result = CliRunner().invoke(app, [str(word) for word in command])
    assert result.exit_code == 2
    assert said in result.output
    assert len(result.output.strip().splitlines()) == 1


# --- sparse depth


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    """The same wall, with depth in one pixel of 25."""
    folder = tmp_path_factory.mktemp("sparse")
    scene = predicted_scene.write(folder / "flight", frames=6)
    (scene / "scene.yaml").write_text("classes: [dark, bright]\n")
    (scene / "labels" / "net").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for k in range(6):
        path = scene / f"depth/{k:03d}.png"
        Image.fromarray(np.where(rng.random((48, 80)) < 0.04, np.array(Image.open(path)), 0).astype(np.uint16)).save(
            path
        )
        truth = (np.arange(80) + 2 * k) // 9 % 2 + np.zeros((48, 1))
        labels = np.where(rng.random(truth.shape) < 0.1, 1 - truth, truth).astype(np.uint8)
        Image.fromarray(labels).save(scene / f"labels/net/{k:03d}.png")
    return folder


def command(folder, *words):
    given = [*words, "--data", folder / "flight", "--model", "net", "--voxel-size", "0.1", "--no-geometry-check"]
    return CliRunner().invoke(app, [str(word) for word in given])


@pytest.mark.parametrize("words", [("filters",), ("run", "--rerun", "off", "--check", "none")], ids=["study", "run"])
def test_filters_that_warp_are_refused(sparse, tmp_path, words):
    result = command(sparse, *words, "--filter", "ema-warped:0.3", "--out", tmp_path / "out", "--report", "off")
    assert result.exit_code == 2
    (line,) = [line for line in result.output.splitlines() if line.startswith("error")]
    assert "of a pixel with depth have depth, 50 % are needed; ema-warped:0.3 would find few" in line


def test_shipped_ones_that_warp_are_left_out_flicker_is_of_what_both_frames_see(sparse, tmp_path):
    result = command(sparse, "filters", "--out", tmp_path / "out", "--report", "off")
    assert result.exit_code == 0, result.output
    assert "flight: left out, because depth is sparse" in result.output
    (found,) = filter_studies(load_result(tmp_path / "out"))
    names = [row.filters for row in found.filtered]
    assert "ema:0.3" in names
    assert not [name for name in names if "warped" in name]
    record = load_result(tmp_path / "out").select()[0]
    assert record.image_space.compensated_share < 0.06  # of the pixels with depth, where the frame before has it, too
    assert record.quality.seen == pytest.approx(0.04 * 5 / 6, rel=0.1)  # 6 frames make 5 pairs
    assert record.quality.flicker == pytest.approx(2 * 0.1 * 0.9, abs=0.04)


@pytest.mark.parametrize(("count", "listed"), [(4, "ema:0.1, ema:0.2, ema:0.3, ema:0.4."), (6, "ema:0.4 and 2 more.")])
def test_filters_that_change_nothing_are_named_up_to_four(count, listed):
    found = study(*(result_of(f"ema:0.{k + 1}", changed=0.0) for k in range(count)))
    (line,) = (line for line in advice(found) if line.startswith("These filters change fewer than"))
    assert line.endswith(listed)
