"""Benchmarks with a name: frozen definitions, refused copies of the data, results that are handed in, their table."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import tiny_scene
import yaml
from command_line import bench, error_of
from posed_scene import fails
from posed_writer import write_posed

import semstab
from semstab.comparison.opening import open_run
from semstab.comparison.small_summary import save_summary
from semstab.configure import shipped_benchmarks
from semstab.core.sealed_zip import packed, unpacked
from semstab.datasets import city
from semstab.errors import ConfigError, DataError
from semstab.leaderboard.board import board_of_numbers, boards, numbers_of, tables_of
from semstab.leaderboard.definition import load_benchmark
from semstab.leaderboard.geometry import geometry_file, save_geometry
from semstab.leaderboard.submission import load_submission, require_whole, submissions
from semstab.leaderboard.sums import completed, labelled_share
from semstab.statistics.cluster_sums import ClusterSums, chance_of, value
from semstab.statistics.intervals import estimate, scope_of

ROOT = Path(__file__).parents[1]
FROZEN = json.loads((ROOT / "tests/golden/benchmarks.json").read_text())
WRONG = {"good": 0.02, "same": 0.02, "bad": 0.4}
"""Shares of the labels that are wrong, of each model; good and same err at other pixels."""

FRAMES = 12
CLASSES = ["wall", "door", "window"]


def write_scene(root: Path, seed: int) -> Path:
    """Write a wall that twelve frames see, with labels of three models and the truth."""
    rng = np.random.default_rng(seed)
    truth = [np.tile(((np.arange(32) + 4 * i) // 16 % 3).astype(np.uint8), (24, 1)) for i in range(FRAMES)]
    views = {"gt": [frame(i, labels) for i, labels in enumerate(truth)]}
    for model, share in WRONG.items():
        maps = [
            np.where(rng.random(labels.shape) < share, (labels + 1) % 3, labels).astype(np.uint8) for labels in truth
        ]
        views[model] = [frame(i, labels) for i, labels in enumerate(maps)]
    return write_posed(root, [f"{i:04d}" for i in range(FRAMES)], views, classes=CLASSES, up_axis="-y")


def frame(i: int, labels: np.ndarray) -> semstab.Frame:
    T = np.eye(4)
    T[:3, 3] = [0.25 * i + 0.01, 0.01, 0.01]
    camera = semstab.Intrinsics(32, 32, 16, 12)
    return semstab.Frame(i, np.full(labels.shape, 2, np.float32), camera, T, labels=labels)


def define(path: Path, data: Path | None = None, **changes) -> Path:
    """Write a definition of two walls, with the hashes of the data where that is given."""
    content = {
        "description": "two walls", "get": "see tests", "license": "none", "citation": "nobody",
        "dataset": {"name": "posed_folder"}, "scenes": ["one", "two"], "voxel_size": 0.25, "statistics": True,
        "measures": ["alpha", "flicker", "accuracy", "miou", "wrong_of_consistent"],
    } | changes  # fmt: skip
    path.write_text(yaml.safe_dump(content))
    if data is not None:
        path.write_text(yaml.safe_dump(content | {"digests": load_benchmark(path).digests_of(data)}))
        benchmark = load_benchmark(path)
        save_geometry(geometry_file(path), benchmark.geometry_of(data), benchmark.data_digest)
    return path


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Data of two scenes, the definition walls@1.yaml, a run of it, and the results of its three models."""
    base = tmp_path_factory.mktemp("board")
    # By the labels that seeds 0 and 1 draw, good and same differ, as one pair in twenty does
    for seed, name in enumerate(("one", "two"), start=2):
        write_scene(base / "data" / name, seed)
    define(base / "walls@1.yaml", base / "data")
    bench("benchmark", "walls@1.yaml", "--data", "data", "--out", "run", "--submit", "results", "-q", cwd=base)
    return base


@pytest.fixture
def results(home, tmp_path):
    """The results in a folder of their own, with the path of each model's."""
    shutil.copytree(home / "results", tmp_path / "results")
    return {name: tmp_path / f"results/walls@1__{name}.semstab" for name in WRONG}


def definitions(home):
    benchmark = load_benchmark(home / "walls@1.yaml")
    return {benchmark.id: benchmark}


def rewritten(file: Path, change) -> None:
    """Change the content of a result."""
    with zipfile.ZipFile(file) as archive:
        parts = unpacked(archive)
    content = json.loads(parts["summary.json"])
    change(content)
    file.write_bytes(packed(parts | {"summary.json": json.dumps(content).encode()}))


# --- Definitions ------------------------------------------------------------------------------------------------------


def test_a_published_definition_does_not_change() -> None:
    """A change of what numbers follow from is a new version; tests/golden/regenerate.py adds new ones only."""
    assert {name: load_benchmark(name).digest for name in shipped_benchmarks()} == FROZEN


@pytest.mark.parametrize("name", shipped_benchmarks())
def test_a_shipped_definition_can_be_run_and_says_where_its_data_is(name) -> None:
    benchmark = load_benchmark(name)
    assert (benchmark.id, benchmark.name, benchmark.version) == (
        name,
        name.partition("@")[0],
        int(name.partition("@")[2]),
    )
    assert benchmark.superseded_by is None or benchmark.superseded_by in shipped_benchmarks()
    config = benchmark.configured(Path("DATA") if benchmark.get else None)
    assert benchmark.changed(config) == []
    assert config.benchmark is not None
    assert str(config.benchmark) == f"{name} ({benchmark.digest})"
    assert set(benchmark.places()) <= {*benchmark.scenes, *benchmark.flights}


def test_the_last_version_of_a_name_is_taken_and_an_unknown_one_is_one_line() -> None:
    last = [name for name in shipped_benchmarks() if name.startswith("city@")][-1]
    assert load_benchmark("city").id == last
    fails(
        ConfigError, "'citty' is neither a benchmark that ships nor a .yaml file; did you mean", load_benchmark, "citty"
    )


def test_words_may_change_in_a_version_and_settings_may_not(tmp_path) -> None:
    first = load_benchmark(define(tmp_path / "walls@1.yaml"))
    assert load_benchmark(define(tmp_path / "walls@1.yaml", citation="another")).digest == first.digest
    for change in ({"voxel_size": 0.5}, {"frames": {"stride": 2}}, {"scenes": ["one"]}, {"digests": {"one": "a-b"}}):
        assert load_benchmark(define(tmp_path / "walls@1.yaml", **change)).digest != first.digest
    fails(ConfigError, "walls.yaml: id: string should match", load_benchmark, define(tmp_path / "walls.yaml"))


def test_the_city_is_that_of_its_definition(monkeypatch) -> None:
    benchmark = load_benchmark("city@1")
    benchmark.require_data()
    monkeypatch.setattr(city, "GENERATOR_VERSION", city.GENERATOR_VERSION + 1)
    fails(DataError, r"scene0: frame 0 differs from that of city@1", benchmark.require_data)


def test_another_copy_of_the_data_is_refused_with_the_first_file_that_differs(home, tmp_path) -> None:
    shutil.copytree(home / "data", tmp_path / "data")
    benchmark, data = load_benchmark(home / "walls@1.yaml"), tmp_path / "data"
    benchmark.require_data(data)
    (data / "two/labels/bad/0003.png").write_bytes((data / "two/labels/bad/0002.png").read_bytes())
    benchmark.require_data(data)  # labels are what is assessed
    pose = data / "two/pose/0004.txt"
    text = pose.read_text()
    moved = np.loadtxt(pose)
    moved[0, 3] += 1e-3
    np.savetxt(pose, moved)
    fails(
        DataError, re.escape("two: pose/0004.txt differs from that of walls@1 (frame 4)"), benchmark.require_data, data
    )
    pose.write_text(text)
    depth = next((data / "one/depth").glob("0002.*"))
    content = depth.read_bytes()
    depth.write_bytes(next((data / "one/depth").glob("0003.*")).read_bytes() + b" ")
    fails(DataError, re.escape(f"one: depth/{depth.name} differs from"), benchmark.require_data, data)
    depth.write_bytes(content)
    for kind in ("depth", "pose", "labels/good"):
        next((data / "one" / kind).glob("0011.*")).unlink()
    fails(DataError, "one: 11 frames are selected, but walls@1 has 12", benchmark.require_data, data)


@pytest.mark.parametrize(("words", "line"), [
    (["walls@1.yaml"], "walls@1: name the folder of its data with --data; see tests"),
    (["walls@1.yaml", "--data", "data", "--labels", "data", "--predict", "colour-clusters"], "leave one out"),
    (["walls@1.yaml", "--data", "data", "--card", "card.yaml"], "name its file with --submit"),
    (["city@1", "--data", "data"], "city@1: its data is built in; leave out --data"),
    (["walls@1.yaml", "--data", "data/one"], "data/one: walls@1 has a scene 'two'; known: one"),
    (["city@1", "--taxonomy", "uavid8"], "its classes are not those of city@1: building, road"),
])  # fmt: skip
def test_what_cannot_be_run_is_one_line(home, words, line) -> None:
    last = bench("benchmark", *words, cwd=home, code=2).stderr.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert line in last


# --- Runs and results -------------------------------------------------------------------------------------------------


def test_name_version_and_definition_stand_with_every_number(home, tmp_path) -> None:
    benchmark = load_benchmark(home / "walls@1.yaml")
    stated = f"walls@1 ({benchmark.digest})"
    result = semstab.load_result(home / "run")
    assert result.benchmark == stated
    assert set(result.to_arrow()["benchmark"].to_pylist()) == {stated}
    assert json.loads((home / "run/summary.json").read_text())["benchmark"] == stated
    assert stated in bench("show", "run", cwd=home).stdout
    for file in (home / "run/tables").glob("*.md"):
        assert f"Benchmark {stated}." in file.read_text(), file.name
    for file in (home / "run/tables").glob("*.csv"):
        assert {row["benchmark"] for row in csv.DictReader(io.StringIO(file.read_text()))} <= {stated}, file.name
    semstab.export(home / "run:bad", [tmp_path / "bad.ply", tmp_path / "bad.parquet"], scene="one")
    assert f"comment benchmark {stated}\n".encode() in (tmp_path / "bad.ply").read_bytes()[:2000]
    assert stated in pq.read_schema(tmp_path / "bad.parquet").metadata[b"semstab"].decode()
    page = (home / "run/report.html").read_text()
    assert "Benchmark walls@1" in page
    assert f"definition {benchmark.digest}" in page


def test_the_numbers_of_a_result_are_those_of_the_run(home, results) -> None:
    benchmark, about, handle = load_submission(results["bad"], definitions(home))
    assert (benchmark.id, about.benchmark, handle.model) == ("walls@1", "walls@1", "bad")
    assert about.semstab == semstab.__version__
    assert about.cores > 0
    assert not about.predicted
    assert results["bad"].stat().st_size < 1_000_000
    run, stored = open_run(f"{home / 'run'}:bad"), open_run(results["bad"])
    for scene, entry in run.scenes.items():
        submitted, counted = stored.scenes[scene], handle.scenes[scene].sums
        record, first = submitted.record, entry.record.without_files()
        assert record == first or record.statistics.headline == first.statistics.headline
        for key in ("alpha", "psa", "accuracy", "miou"):
            assert value(submitted.sums, key) == pytest.approx(value(entry.sums, key), abs=1e-6)
            again, first = (estimate(made.sums, key, scope=scope_of(made.sums, key=key)) for made in (submitted, entry))
            assert (again.low, again.high) == pytest.approx((first.low, first.high), abs=1e-5)
        assert value(counted, "accuracy") == pytest.approx(value(entry.sums, "accuracy"), abs=1e-6)
        assert value(counted, "alpha") == pytest.approx(value(entry.sums, "alpha"), abs=1e-6)


def test_a_result_can_be_compared_as_a_run(home, results) -> None:
    small = semstab.compare(results["good"], results["bad"])
    whole = semstab.compare(f"{home / 'run'}:good", f"{home / 'run'}:bad")
    one, other = (comparison.overall[0].contrasts[0] for comparison in (small, whole))
    assert one.measure == other.measure == "alpha"
    assert one.difference.value == pytest.approx(other.difference.value, abs=0.01)
    assert one.change == other.change == "worse"


@pytest.mark.parametrize(("change", "line"), [
    (lambda c: c["about"].update(digest="0123456789abcdef"), "of another definition of walls@1 (0123456789abcdef"),
    (lambda c: c["about"].update(benchmark="walls@2"), "'walls@2' is neither a benchmark"),
    (lambda c: c["scenes"][0].update(name="three"), "one of walls@1 is missing"),
    (lambda c: c["scenes"][0]["summary"].update(frames=11), "one has 11 frames, but 12 in walls@1"),
    (lambda c: c["scenes"][0]["summary"].update(voxel_size=0.3), "its voxels are not those of walls@1"),
    (lambda c: c["about"].update(card={"url": "javascript:x"}), "card: url"),
    (lambda c: c["about"].update(milliseconds=-5.0), "milliseconds or cores are negative"),
    (lambda c: c["about"].update(made="tomorrow"), "about.made: is no day"),
    (lambda c: c["about"].update(processor="x\x1b[2J"), "about.processor: is no line"),
    (lambda c: c.pop("about"), "of no benchmark"),
    (lambda c: c["about"].pop("made"), "made: is missing"),
])  # fmt: skip
def test_a_result_of_something_else_is_refused_in_one_line(home, results, change, line) -> None:
    rewritten(results["good"], change)
    fails(DataError, re.escape(line), load_submission, results["good"], definitions(home))
    assert line in error_of(
        "leaderboard", "results", "--benchmark", home / "walls@1.yaml", cwd=results["good"].parents[1]
    )


def test_a_definition_without_its_spots_ranks_nobody_and_takes_no_result(home, tmp_path) -> None:
    (tmp_path / "walls@1.yaml").write_text((home / "walls@1.yaml").read_text())
    line = "walls@1: the spots of its scenes are not known"
    assert line in error_of("leaderboard", home / "results", "--benchmark", "walls@1.yaml", cwd=tmp_path)
    words = "walls@1.yaml", "--data", home / "data", "--submit", "out"
    assert line in error_of("benchmark", *words, cwd=tmp_path)
    shutil.copy(home / "walls@1.geometry.json", tmp_path)
    other = (home / "walls@1.geometry.json").read_text().replace('"digests":"', '"digests":"0')
    (tmp_path / "walls@1.geometry.json").write_text(other)
    assert "of other data" in error_of("benchmark", *words, cwd=tmp_path)


def test_a_run_with_other_settings_is_not_handed_in(home, tmp_path) -> None:
    shutil.copytree(home / "run", tmp_path / "run")
    path = tmp_path / "run/config.yaml"
    text = path.read_text()
    path.write_text(text.replace("pixel_stride: 1", "pixel_stride: 2"))
    fails(ConfigError, "pixel_stride is not that of walls@1", next, submissions(tmp_path / "run", tmp_path / "out"))
    config = yaml.safe_load(text)
    config["benchmark"]["digest"] = "0123456789abcdef"
    path.write_text(text.partition("\n")[0] + "\n" + yaml.safe_dump(config))
    fails(ConfigError, "walls@1 has changed since", next, submissions(tmp_path / "run", tmp_path / "out"))
    config["benchmark"] = None
    path.write_text(text.partition("\n")[0] + "\n" + yaml.safe_dump(config))
    fails(ConfigError, "it is a run of no benchmark", next, submissions(tmp_path / "run", tmp_path / "out"))
    path.write_text(text + "\n")
    fails(
        DataError,
        "config.yaml: has changed since the run wrote it",
        next,
        submissions(tmp_path / "run", tmp_path / "out"),
    )


def test_a_run_without_ground_truth_is_whole_for_a_definition_without_accuracy_alone(home, monkeypatch) -> None:
    handle, definition = open_run(f"{home / 'run'}:good"), load_benchmark(home / "walls@1.yaml")
    require_whole(definition, handle)
    monkeypatch.setattr(ClusterSums, "truth", False)
    fails(DataError, "one has no ground truth; run it again", require_whole, definition, handle)
    require_whole(definition.model_copy(update={"statistics": False}), handle)
    monkeypatch.undo()
    entry = handle.scenes["one"]
    entry = dataclasses.replace(entry, record=dataclasses.replace(entry.record, statistics=None))
    less = dataclasses.replace(handle, scenes=handle.scenes | {"one": entry})
    fails(DataError, "one has no statistics; run it again", require_whole, definition, less)


def test_a_file_holds_one_model_with_its_card(home, tmp_path) -> None:
    several = submissions(home / "run", tmp_path / "x.semstab")
    fails(ConfigError, r"x.semstab: the run has several models \(bad, good, same\); choose one", next, several)
    card = {"name": "The <b>good</b> one", "by": "us", "parameters": 3.2, "url": "https://example.org/x"}
    (tmp_path / "card.yaml").write_text(yaml.safe_dump(card))
    bench(
        "benchmark", home / "walls@1.yaml", "--data", home / "data", "-m", "good", "--out", "run", "--submit",
        "good.semstab", "--card", "card.yaml", "-q", "--report", "off", cwd=tmp_path,
    )  # fmt: skip
    _, about, handle = load_submission(tmp_path / "good.semstab", definitions(home))
    assert about.card == card
    assert handle.model == "good"
    (tmp_path / "card.yaml").write_text("naem: x\n")
    line = error_of(
        "benchmark", home / "walls@1.yaml", "--data", home / "data", "--submit", "x.semstab", "--card", "card.yaml",
        cwd=tmp_path,
    )  # fmt: skip
    assert "card.yaml: unknown setting 'naem'; did you mean 'name'?" in line


def test_cubes_of_twice_the_edge_hold_the_spots_of_eight(home) -> None:
    spots = load_benchmark(home / "walls@1.yaml").geometry["one"]
    rows = ((-1, 0, 2, 0, 9, 5), (-2, 1, 3, 0, 4, 3), (0, 0, 2, 0, 7, 6), (-1, 0, 2, 1, 8, 2))
    large = dataclasses.replace(spots, edge=0.5, rows=rows).coarsened()
    assert large.edge == 1.0
    assert sorted(large.rows) == [(-1, 0, 1, 0, 13, 8), (-1, 0, 1, 1, 8, 2), (0, 0, 1, 0, 7, 6)]
    assert large.needed == 16


# --- The table --------------------------------------------------------------------------------------------------------


def test_models_are_ranked_and_those_that_cannot_be_told_apart_share_ranks(home, results) -> None:
    (board,) = boards(results["good"].parent, definitions(home))
    rows = {row.name: row for row in board.rows}
    assert [rows[name].ranks for name in ("good", "same", "bad")] == ["1 to 2", "1 to 2", "3"]
    assert board.rows[-1].name == "bad"
    run = semstab.load_result(home / "run")
    for name, row in rows.items():
        alphas = [record.statistics.headline.alpha.value for record in run.select(model=name)]
        accuracy = [record.statistics.headline.accuracy_op2.value for record in run.select(model=name)]
        assert row.alpha.value == row.of_labelled.value == pytest.approx(np.mean(alphas), abs=1e-6)
        assert row.truth("accuracy").value == pytest.approx(np.mean(accuracy), abs=1e-6)
        assert row.labelled == 1.0
        assert row.alpha.low < row.alpha.value < row.alpha.high


def test_the_level_of_a_verdict_is_computed_from_the_sums(home, results) -> None:
    (board,) = boards(results["good"].parent, definitions(home))
    run = semstab.load_result(home / "run")
    for row in board.rows:
        levels = [record.statistics.verdict.level for record in run.select(model=row.name)]
        assert [scene.level for scene in row.scenes.values()] == levels


def test_a_model_that_alpha_does_not_assess_is_shown_without_a_rank(home, results) -> None:
    levels = {"good": ("misleading", "misleading"), "same": ("stable", "usable"), "bad": ("uninformative", "usable")}
    loaded = {name: load_submission(file, definitions(home)) for name, file in results.items()}
    benchmark, listed = loaded["good"][0], [(name, about, handle) for name, (_, about, handle) in loaded.items()]
    numbers = {
        name: {
            scene: dataclasses.replace(of_scene, level=level)
            for (scene, of_scene), level in zip(scenes.items(), levels[name], strict=True)
        }
        for name, scenes in numbers_of(benchmark, listed).items()
    }
    board = board_of_numbers(benchmark, listed, numbers)
    assert [(row.name, row.ranks, row.verdict) for row in board.rows] == [
        ("same", "1", "stable 1, usable 1"), ("bad", "2", "uninformative 1, usable 1"), ("good", "-", "misleading"),
    ]  # fmt: skip
    assert board.reasons == ["not ranked, as consistent labels are often wrong: good"]


def agreeing_share(part) -> float:
    return float(part["agreeing"].sum() / part["observations"].sum())


def test_an_answer_that_is_left_out_counts_as_one_that_disagrees(home, results) -> None:
    """A model that leaves out a tenth of each view: the share .81 of the pairs of answers has two labels."""
    benchmark, _, handle = load_submission(results["good"], definitions(home))
    spots, sums = benchmark.geometry["one"], handle.scenes["one"].sums
    assert completed(sums, spots).answers[0].columns == pytest.approx(sums.answers[0].columns)
    table = spots.table.copy()
    table[:, 5] = np.round(table[:, 5] / 0.9)
    more = dataclasses.replace(spots, rows=tuple(map(tuple, table.tolist())))
    share = labelled_share(sums.answers[0], more)
    assert share == pytest.approx(0.9, abs=0.01)
    whole, chance = completed(sums, more), chance_of(sums.answers[0])
    assert chance_of(whole.answers[0]) == pytest.approx(chance, abs=1e-3)
    agreeing = agreeing_share(sums.answers[0])
    again = agreeing_share(whole.answers[0])
    assert again == pytest.approx(share**2 * agreeing, rel=5e-3)
    assert value(whole, "alpha") < value(sums, "alpha") - 0.1


def test_flights_over_one_place_count_once_together(home, results, tmp_path) -> None:
    """Three scenes, two of them one place: the mean over places, not over scenes."""
    data, again = tmp_path / "data", "one-again"
    shutil.copytree(home / "data", data)
    shutil.copytree(data / "one", data / again)
    file = define(
        tmp_path / "places@1.yaml",
        data,
        scenes=["one", again, "two"],
        flights={"first": ["one", again]},
        measures=["alpha"],
    )
    bench(
        "benchmark",
        file,
        "--data",
        data,
        "--out",
        "run",
        "--submit",
        "out",
        "-m",
        "bad",
        "-q",
        "--report",
        "off",
        cwd=tmp_path,
    )
    benchmark = load_benchmark(file)
    assert benchmark.places() == ("first", "first", "two")
    (board,) = boards(tmp_path / "out", {benchmark.id: benchmark})
    one, two = (board.rows[0].scenes[scene].alpha.value for scene in ("one", "two"))
    assert board.rows[0].scenes[again].alpha.value == one != two
    assert board.rows[0].alpha.value == pytest.approx((one + two) / 2, abs=1e-9)


def test_the_page_says_what_the_terminal_says_and_what_is_stated_stands_apart(home, results) -> None:
    root = results["good"].parents[1]
    rewritten(results["bad"], lambda c: c["about"].update(card={"name": "<script>x</script>", "parameters": 2.0}))
    rewritten(results["good"], lambda c: c["about"].update(card={"parameters": 1.0, "url": "https://example.org/"}))
    said = bench("leaderboard", "results", "--benchmark", home / "walls@1.yaml", "--out", "site", cwd=root).stdout
    assert [file.name for file in (root / "site").iterdir()] == ["index.html"]
    page = (root / "site/index.html").read_text()
    assert "<script" not in page
    assert "&lt;script&gt;x" in page
    assert "flicker" not in page
    (board,) = boards(root / "results", definitions(home))
    ranks, scenes, word = tables_of(board)
    assert [row[0] for row in ranks.groups[0].rows] == ["1 to 2", "1 to 2", "3"]
    assert not {"milliseconds", "parameters", "by", "machine"} & {column.key for column in ranks.columns}
    assert {"parameters", "machine", "url"} <= {column.key for column in word.columns}
    assert [row[0] for row in scenes.groups[0].rows] == [row.name for row in board.rows]
    for row in board.rows:
        assert row.name in said
        assert f"{row.alpha.value:.3f}" in page


def test_the_results_of_the_repository_are_whole_and_their_tables_stand_in_the_docs(monkeypatch) -> None:
    """`python scripts/leaderboard_page.py` writes them."""
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        import leaderboard_page
    finally:
        sys.path.remove(str(ROOT / "scripts"))
    made = [*boards(ROOT / "results")]
    monkeypatch.setattr(leaderboard_page, "boards", lambda folder: made if folder == ROOT / "results" else [])
    assert (ROOT / "docs/leaderboard.md").read_text() == leaderboard_page.page()
    assert {board.benchmark.id for board in made} == {
        "apc_shelf@1",
        "city@1",
        "livingroom@1",
        "semantickitti-images@1",
    }


def test_a_folder_that_makes_no_table_is_one_line(home, results, tmp_path) -> None:
    root = results["good"].parents[1]
    assert "there is no such folder" in error_of("leaderboard", "nowhere", cwd=root)
    (tmp_path / "empty").mkdir()
    assert "it holds no result" in error_of("leaderboard", tmp_path / "empty", cwd=root)
    shutil.copy(results["good"], root / "results/again.semstab")
    line = error_of("leaderboard", "results", "--benchmark", home / "walls@1.yaml", cwd=root)
    assert "again.semstab and walls@1__good.semstab: both are called 'good'" in line
    save_summary(open_run(f"{home / 'run'}:good"), root / "results/again.semstab")
    line = error_of("leaderboard", "results", "--benchmark", home / "walls@1.yaml", cwd=root)
    assert "again.semstab: it is a small summary, but of no benchmark" in line


def test_a_scene_of_files_and_a_scene_without_have_hashes_of_geometry_alone(tmp_path) -> None:
    root = tiny_scene.write(tmp_path / "wall")
    dataset = semstab.datasets.open_dataset("posed_folder", {"root": str(root)})
    scene = dataset.scene(dataset.scenes[0])
    found = [scene.fingerprints(k) for k in range(len(scene))]
    assert [*found[0]] == ["depth/0000.npy", "pose/0000.txt"] or [*found[0]][1] == "pose/0000.txt"
    assert len({hashes[f"pose/{k:04d}.txt"] for k, hashes in enumerate(found)}) == len(scene)
    plain = semstab.datasets.Scene.fingerprints(scene, 0)
    assert [*plain] == ["depth of 0000", "pose of 0000"]
    assert plain["pose of 0000"] == found[0]["pose/0000.txt"]


def test_images_with_depth_by_lidar_may_have_other_classes_in_voxels_than_at_spots() -> None:
    assert load_benchmark("semantickitti-images@1").is_sparse
    assert not load_benchmark("city@1").is_sparse
