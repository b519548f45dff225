"""The study of published networks: its numbers in the documents are those of results/, and its script and study run."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import predicted_scene
import pytest
import real_networks
from typer.testing import CliRunner

from semstab import load_result, load_study
from semstab.cli import app

ROOT = Path(__file__).parents[1]
RESULTS, PAGE, README = ROOT / "results", ROOT / "docs" / "real-networks.md", ROOT / "README.md"
CONDITION = "livingroom-labels-5-0.02"
SIGNED = r"([+-]\.\d\d|[+-]1\.00)"

NETS = """
import numpy as np


class Threshold:
    classes = ["background", "chair", "sofa"]
    tops = (90, 170)

    def __init__(self, scale=1.0, soft=False):
        self.wrong, self.soft = 0.5 - scale / 5, soft

    def predict(self, image):
        labels = np.digitize(image.mean(axis=2), self.tops).astype(np.uint8)
        rng = np.random.default_rng(int(image.sum()))
        labels[rng.random(labels.shape) < self.wrong] = 0
        return np.eye(3, dtype=np.float32)[labels] if self.soft else labels


class espnetv2_voc(Threshold):
    pass


class dicenet_voc(Threshold):
    tops = (100, 180)
"""
ZOO_README = """
| s | Image Size | FLOPs | Params | mIOU (class-wise) | Link |
|---|---|---|---|---|---|
| 0.5 | 384x384 | 1 | 0.08 | 47.5 | [here](/model/segmentation/model_zoo/dicenet/dicenet_s_0.5_pascal_384x384.pth) |
| 2. 0 | 384x384 | 7 | 0.79 | 67.01  | [here](/model/segmentation/model_zoo/espnetv2/espnetv2_s_2.0_pascal_384x384.pth)|
<!--
| 1.0 | 384x384 | 7 | 1 | 50.4 | [here](/model/segmentation/model_zoo/espnetv2/espnetv2_s_1.0_pascal_384x384.pth) |
-->
"""
TINY = {"dicenet": ("0.5",), "espnetv2": ("1.0", "2.0")}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder of networks that need no weights, and one of a sequence of 21 frames."""
    folder = tmp_path_factory.mktemp("study")
    for family, scales in TINY.items():
        zoo = folder / "networks" / real_networks.ZOO / family
        zoo.mkdir(parents=True)
        for scale in scales:
            (zoo / f"{family}_s_{scale}_pascal_384x384.pth").write_text(f"{family} {scale}")
    (folder / "networks" / real_networks.ZOO / "README.md").write_text(ZOO_README)
    (folder / "networks" / "nets.py").write_text(NETS)
    predicted_scene.write(folder / "data" / "livingroom", frames=21)
    return folder


def in_process(words):
    result = CliRunner().invoke(app, [*words, "--quiet"])
    assert result.exit_code == 0, result.output


def run_script(made, folder, only):
    return real_networks.main([
        "run", "--networks", str(made / "networks"), "--data", str(made / "data"), "--work", str(folder / "work"),
        "--results", str(folder / "results"), "--only", only,
    ])  # fmt: skip


@pytest.fixture(scope="module")
def finished(made, tmp_path_factory):
    """The folder of results and work, of one condition."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(real_networks, "bench", in_process)
        assert run_script(made, folder, CONDITION) == 0
    return folder


# --- The script -------------------------------------------------------------------------------------------------------


def test_networks_are_those_with_weights_and_have_the_published_miou(made) -> None:
    found = real_networks.networks(made / "networks", "voc")
    assert [network.name for network in found] == ["dicenet-0.5", "espnetv2-1.0", "espnetv2-2.0"]
    assert [network.miou for network in found] == pytest.approx([47.5, math.nan, 67.01], nan_ok=True)


def test_a_condition_becomes_a_row_for_each_network(finished) -> None:
    rows = real_networks.load(finished / "results")
    assert [row.network for row in rows] == ["dicenet-0.5", "espnetv2-1.0", "espnetv2-2.0"]
    assert all((row.condition, row.frames, row.voxel_size) == (CONDITION, 5, 0.02) for row in rows)
    noisy, _, clean = rows
    assert noisy.agree < clean.agree
    assert noisy.flicker > clean.flicker
    records = load_result(finished / "work" / "runs" / CONDITION).select(model="espnetv2-2.0")
    assert clean.alpha == pytest.approx(records[0].statistics.headline.alpha.value, rel=1e-5)


def test_commands_name_no_folder_of_this_machine(made, finished) -> None:
    text = (finished / "results" / real_networks.JSON).read_text()
    assert str(made) not in text
    assert str(finished) not in text
    content = json.loads(text)
    assert len(content["predictions"]["livingroom"]) == 3
    assert "--data DATA/livingroom" in content["conditions"][CONDITION]["command"]


def test_digests_are_of_the_files_that_were_used(made, finished) -> None:
    content = json.loads((finished / "results" / real_networks.JSON).read_text())
    weights = made / "networks" / real_networks.ZOO / "dicenet" / "dicenet_s_0.5_pascal_384x384.pth"
    assert content["weights"][weights.name] == real_networks.digest(weights)
    depth = made / "data" / "livingroom" / "depth"
    assert content["sequences"]["livingroom"]["depth"] == real_networks.digest(depth)
    assert set(content["sequences"]["livingroom"]) == {"color", "depth", "pose", "intrinsics.txt", "scene.yaml"}


def test_a_second_start_computes_nothing_again(made, finished, monkeypatch) -> None:
    monkeypatch.setattr(real_networks, "bench", in_process)
    before = (finished / "results" / real_networks.CSV).read_bytes()
    assert run_script(made, finished, CONDITION) == 0
    units = json.loads((finished / "work" / "runs" / CONDITION / "manifest.json").read_text())["units"]
    assert (units["kept"], units["computed"]) == (3, 0)
    assert (finished / "results" / real_networks.CSV).read_bytes() == before


def test_scores_are_predicted_within_the_run(made, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(real_networks, "bench", in_process)
    assert run_script(made, tmp_path, "livingroom-scores") == 0
    rows = real_networks.load(tmp_path / "results")
    assert {row.kind for row in rows} == {"scores"}
    assert len(rows) == 3


def test_show_prints_the_tables_and_draws_the_figure(finished, tmp_path, capsys) -> None:
    figure = tmp_path / "figure.png"
    assert real_networks.main(["show", "--results", str(finished / "results"), "--figure", str(figure)]) == 0
    rows = real_networks.load(finished / "results")
    assert "\n".join(real_networks.condition_table(rows)) in capsys.readouterr().out
    assert figure.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("only", "message"), [("kitchen", "--only kitchen"), ("livingroom", "nets.py is not there")])
def test_a_mistake_is_one_line(made, tmp_path, capsys, only, message) -> None:
    (tmp_path / "empty").mkdir()
    words = ["--networks", str(tmp_path / "empty"), "--data", str(made / "data"), "--work", str(tmp_path)]
    assert real_networks.main(["run", *words, "--results", str(tmp_path), "--only", only]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_the_sequence_is_written_from_a_clone(tmp_path) -> None:
    source = tmp_path / "clone/tests/reconstruction_system/livingroom1_clean_micro"
    for name in ("test_scene/trajectory.log", "image/00000.jpg", "depth/00000.png"):
        (source / name).parent.mkdir(parents=True)
        (source / name).write_bytes(name.encode())
    (source / "test_scene/trajectory.log").write_text("0 0 1\n1 0 0 0.5\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    assert real_networks.main(["sequence", str(tmp_path / "clone"), "--data", str(tmp_path)]) == 0
    written = tmp_path / "livingroom"
    assert (written / "color/00000.jpg").read_text() == "image/00000.jpg"
    assert [float(x) for x in (written / "pose/00000.txt").read_text().split()[:4]] == [1, 0, 0, 0.5]


# --- Rank correlation -------------------------------------------------------------------------------------------------


def test_the_rank_correlation_is_scipys() -> None:
    from scipy.stats import spearmanr

    x, y = [34.5, 47.2, 47.7, 55.7, 60.2, 60.2, 67.0], [0.2, 0.6, 0.1, 0.5, 0.5, 0.7, 0.6]
    found = real_networks.spearman(x, y)
    assert found["rho"] == pytest.approx(spearmanr(x, y).statistic, abs=1e-4)
    assert -1 <= found["low"] < found["rho"] < found["high"] <= 1


@pytest.mark.parametrize(("x", "y"), [([1, 2], [1, 2]), ([1, 2, 3], [5, 5, 5])])
def test_no_correlation_is_said_where_none_is_defined(x, y) -> None:
    assert real_networks.spearman(x, y)["rho"] is None


# --- The study --------------------------------------------------------------------------------------------------------


def test_the_study_has_the_networks_of_the_results() -> None:
    study = load_study("ladder")
    models = study.dataset.options["models"]
    rows = [row for row in real_networks.load(RESULTS) if row.condition == real_networks.MAIN]
    assert {model["name"] for model in models} == {row.network for row in rows}
    for model in models:
        assert model["name"] == f"{model['model'].split(':')[1].removesuffix('_voc')}-{model['options']['scale']}"
    assert [name for name, _ in study.sweeps.given()] == ["voxel_size", "frame_count"]


def test_the_study_runs_in_the_folder_of_the_networks(made, tmp_path, monkeypatch) -> None:
    (command,) = re.findall(
        r"^#   semstab-bench (.*)$", (ROOT / "configs/studies/ladder.yaml").read_text(), re.MULTILINE
    )
    words = command.replace("SEQUENCE", str(made / "data" / "livingroom")).split()
    monkeypatch.chdir(made / "networks")
    small = ["--set", "models=[espnetv2-0.5,dicenet-1.0]", "--only", "voxel_size", "--report", "off"]
    in_process([*words, *small, "--out", str(tmp_path / "study")])
    result = load_result(tmp_path / "study")
    assert result.models == ("espnetv2-0.5", "dicenet-1.0")
    assert result.sweeps() == {"voxel_size": (0.02, 0.04)}


# --- The documents ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rows():
    return real_networks.load(RESULTS)


@pytest.fixture(scope="module")
def stated():
    return json.loads((RESULTS / real_networks.JSON).read_text())


def test_the_correlations_follow_from_the_rows(rows, stated) -> None:
    assert stated["correlations"] == real_networks.correlations(rows)


def test_every_condition_has_its_networks_commands_and_digests(rows, stated) -> None:
    for condition in real_networks.CONDITIONS:
        of = [row for row in rows if row.condition == condition.name]
        assert len(of) == 10
        assert stated["conditions"][condition.name]["command"].startswith("semstab-bench run --data DATA/")
        assert set(stated["sequences"][condition.scene]) >= {"color", "depth", "pose"}
    assert len(stated["weights"]) == 20
    assert real_networks.digest(ROOT / "scripts" / "nets.py") in stated["wrapper"].values()


def test_the_rows_of_the_page_are_those_of_the_results(rows) -> None:
    head, dashes, *conditions = real_networks.condition_table(rows)
    (printed,) = re.findall(rf"{re.escape(head)}\n{re.escape(dashes)}\n((?:\|.*\n)+)", PAGE.read_text(encoding="utf-8"))
    assert len(printed.splitlines()) >= 4
    assert set(printed.splitlines()) <= set(conditions)


@pytest.mark.parametrize("document", [PAGE, README])
def test_correlations_in_the_text_are_those_of_the_main_condition(document, rows, stated) -> None:
    text = re.sub(r"\s+", " ", document.read_text(encoding="utf-8"))
    begin = "## On real networks" if document == README else "## Rooms without ground truth"
    text = re.split(r" ## (?!On|Rooms)", text[text.index(begin) :])[0]
    pattern = rf"(?i)(alpha|VSS|agreement of two frames|flicker) {SIGNED}(?: \({SIGNED} to {SIGNED}\))?"
    keys = {"alpha": "alpha", "vss": "vss", "agreement of two frames": "agree", "flicker": "flicker"}
    found = {
        row["measure"]: row
        for row in stated["correlations"]
        if (row["condition"], row["of"], row["against"]) == (real_networks.MAIN, "all", "published_miou")
    }
    said = re.findall(pattern, text)
    assert {"alpha", "vss"} <= {title.lower() for title, *_ in said}
    for title, *numbers in said:
        row = found[keys[title.lower()]]
        expected = [real_networks.signed(row[key]) for key in ("rho", "low", "high")]
        assert numbers in (expected, [expected[0], "", ""])


def correlation(stated, measure, against, of):
    (row,) = [
        row
        for row in stated["correlations"]
        if (row["condition"], row["measure"]) == (real_networks.MAIN, measure)
        and (row["against"], row["of"]) == (against, of)
    ]
    rho, low, high = (real_networks.signed(row[key]) for key in ("rho", "low", "high"))
    return row["networks"], rho, f"({low} to {high})"


def test_correlations_without_the_uninformative_networks_are_those_of_the_results(stated) -> None:
    count, *alpha = correlation(stated, "alpha", "published_miou", "informative")
    _, *vss = correlation(stated, "vss", "published_miou", "informative")
    text = re.sub(r"\s+", " ", PAGE.read_text(encoding="utf-8"))
    assert f"Among the {count} others alpha has {' '.join(alpha)}, VSS has {' '.join(vss)}" in text


def test_levels_and_alphas_in_the_text_are_those_of_the_rows(rows) -> None:
    row = {(row.condition, row.network): row for row in rows}
    main = {network: of_network for (condition, network), of_network in row.items() if condition == real_networks.MAIN}
    text = re.sub(r"\s+", " ", PAGE.read_text(encoding="utf-8"))
    few, many = row["livingroom-labels-20-0.02", "espnetv2-2.0"], main["espnetv2-2.0"]
    said = [f"{digits(of_network)} ({of_network.verdict}) in {of_network.frames}" for of_network in (few, many)]
    assert f"espnetv2-2.0 has {said[0]} frames and {said[1]}," in text
    assert f"dicenet-0.75, with {digits(main['dicenet-0.75'])}, calls" in text
    assert "The verdict on these three is 'uninformative'" in text
    assert {main[name].verdict for name in ("dicenet-0.2", "espnetv2-0.5", "dicenet-0.5")} == {"uninformative"}


def digits(row):
    return f"{row.alpha:.2f}".removeprefix("0")


def test_both_voxel_sizes_rank_the_networks_alike(rows) -> None:
    for stride in (20, 10, 5):
        small, large = (
            [row for row in rows if row.condition == f"livingroom-labels-{stride}-{v}"] for v in (0.02, 0.04)
        )
        for measure in real_networks.MEASURES:
            of = [[getattr(row, measure) for row in of_size if not math.isnan(row.alpha)] for of_size in (small, large)]
            assert real_networks.spearman(*of)["rho"] == 1


def test_the_text_says_what_the_other_sequences_show(rows) -> None:
    office = [row for row in rows if row.scene == "hololens"]
    assert max(office, key=lambda row: row.alpha).network == "dicenet-0.2"
    assert next(row.verdict for row in office if row.network == "dicenet-0.2") == "uninformative"
    alpha = real_networks.with_miou(office)["alpha"]
    assert alpha["low"] < 0 < alpha["high"]
    flight = real_networks.with_miou([row for row in rows if row.scene == "brighton"])
    assert min(flight[measure]["rho"] for measure in ("alpha", "vss", "agree")) > 0 > flight["flicker"]["rho"]
    scores = real_networks.with_miou([row for row in rows if row.kind == "scores"])
    assert scores["agree"]["low"] > 0


def test_the_parts_of_disagreement_of_scores_are_those_of_the_results(stated) -> None:
    rho = {
        row["measure"]: real_networks.signed(row["rho"])
        for row in stated["correlations"]
        if row["condition"].startswith("livingroom-scores") and row["measure"] in real_networks.PARTS
    }
    text = re.sub(r"\s+", " ", PAGE.read_text(encoding="utf-8"))
    assert f"that part of disagreement has {rho['within']}; the part between frames has {rho['between']}" in text


def test_shares_of_background_in_the_text_are_those_of_the_main_condition(rows) -> None:
    shares = {row.network: 100 * row.largest_share for row in rows if row.condition == real_networks.MAIN}
    said = re.findall(r"(\w+-[\d.]+) \(([\d.]+) % background\)", PAGE.read_text(encoding="utf-8"))
    assert said
    for network, share in said:
        assert share == f"{shares[network]:.1f}"
