"""Two visits of one place: agreement across is exact, what changed is found, and visits are aligned by points."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import visits as simulated
from command_line import bench
from scipy.spatial.transform import Rotation

import semstab
from semstab import Frame, Intrinsics
from semstab.data.georeference import Georeference
from semstab.errors import ConfigError, DataError
from semstab.statistics.visit_agreement import two_visits
from semstab.statistics.visits import GONE, MOVED, NEW, STAYED, VisitedSpots, VisitSampler, by_turns
from semstab.two_visits import Alignment
from semstab.two_visits.alignment import between

H, W, FOCAL, HEIGHT, FRAMES = 120, 160, 120.0, 20.0, 16
CAMERA = Intrinsics(FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2)


def flown(boxes: list[tuple[float, float]], *, other: float = 0.0, shift: float = 0.0) -> list[Frame]:
    """A camera looks down on a floor with boxes 3 m high; labels of `other` of its squares of 2 m are 2."""
    changed = np.random.default_rng(1).random((64, 64)) < other
    u, v = np.meshgrid((np.arange(W) - CAMERA.cx) / FOCAL, (np.arange(H) - CAMERA.cy) / FOCAL)
    series = []
    for k in range(FRAMES):
        x = 0.8 * k - 6.0 + shift
        depth = np.full((H, W), HEIGHT)
        for left, top in boxes:
            px, py = x + u * (HEIGHT - 3), v * (HEIGHT - 3)
            depth[(left <= px) & (px < left + 4) & (top <= py) & (py < top + 4)] = HEIGHT - 3
        floor = np.floor((x + u * HEIGHT) / 2).astype(int) % 64, np.floor(v * HEIGHT / 2).astype(int) % 64
        labels = np.where(depth < HEIGHT, 1, 2 * changed[floor]).astype(np.uint8)
        pose = np.eye(4)
        pose[0, 3] = x
        series.append(Frame(k, depth.astype(np.float32), CAMERA, pose, labels=labels))
    return series


def visited(first: list[Frame], second: list[Frame]) -> VisitedSpots:
    sampler = VisitSampler(3)
    for visit, frame in by_turns(first, second, (len(first), len(second))):
        sampler.add_of(visit, frame)
    return sampler.visits(("floor", "box", "wet"))


def test_what_a_visit_sees_and_sees_through_moved_within_it() -> None:
    """It is neither gone nor new, though the other visit sees the surface there."""
    found = visited(flown([]), flown([]))
    first, second = (
        dataclasses.replace(votes, seen=np.full_like(votes.seen, 5), through=np.full_like(votes.through, through))
        for votes, through in zip(found.votes, (0, 4), strict=True)
    )
    for votes in ((first, second), (second, first)):
        assert set(dataclasses.replace(found, votes=votes).change) == {MOVED}


@pytest.mark.parametrize(("error", "share"), [("blobs", 0.0), ("none", 0.3), ("border", 0.1)])
def test_agreement_across_is_that_of_points_of_the_surface(error: str, share: float) -> None:
    """Other paths, the same scene: without changes another visit costs nothing, else what the changed places do."""
    condition = simulated.Visits("orbit", error, share, frames=16)
    made = simulated.MadeVisits.from_visits(condition, 1, (90, 120))
    _, told = simulated.said(made, condition)
    *alphas, across = simulated.exact_across(made, 5000, np.random.default_rng(0))
    cost = np.mean(alphas) - across
    assert told.alpha.cost.value == pytest.approx(cost, abs=0.02)
    assert told.alpha.across.value == pytest.approx(across, abs=0.03)
    assert told.alpha.first.value == pytest.approx(alphas[0], abs=0.03)
    assert (told.alpha.cost.low > 0) == (share > 0)
    assert (told.relabelled > 2 * told.by_chance + 0.02) == (share > 0)


def test_alpha_within_is_the_one_of_a_run_if_all_spots_are_common() -> None:
    same = flown([(0, 0)], other=0.3)
    told = two_visits(visited(same, [dataclasses.replace(frame) for frame in same]))
    assert told.alpha.first.value == told.alpha.second.value == pytest.approx(told.alpha.across.value, abs=1e-3)
    assert abs(told.alpha.cost.value) < 1e-3
    assert told.relabelled == 0


def test_boxes_that_go_and_come_are_changes_of_the_surface_and_not_of_labels() -> None:
    spots = visited(flown([(-4, -6), (1, 2)]), flown([(-4, -6), (4, -4)], shift=0.3))
    point, change = spots.spots.point, spots.change
    class_of = spots.dominant
    on_box = point[:, 2] < HEIGHT - 1
    left, gone, new = (
        on_box & (np.abs(point[:, :2] - middle) < 2.2).all(axis=1) for middle in ((-2, -4), (3, 4), (6, -2))
    )
    assert (change[gone] == GONE).mean() > 0.6
    assert (change[new] == NEW).mean() > 0.6
    assert (change[left] == STAYED).mean() > 0.6
    assert not np.isin(change[left | ~on_box], (GONE, NEW)).any()
    told = two_visits(spots)
    box = next(row for row in told.classes if row.name == "box")
    assert box.gone == pytest.approx(0.5, abs=0.15)
    assert box.new == pytest.approx(0.5, abs=0.15)
    assert told.relabelled < 0.01
    assert told.alpha.across.value > 0.95
    assert class_of[0][gone].max() == 1


def test_labels_that_change_are_told_by_class() -> None:
    told = two_visits(visited(flown([(0, 0)]), flown([(0, 0)], other=0.25, shift=0.3)))
    assert told.gone == told.new == 0
    floor = next(row for row in told.classes if row.name == "floor")
    assert floor.becomes == "wet"
    assert floor.relabelled == pytest.approx(0.25, abs=0.08)
    assert told.by_chance < 0.01
    assert told.alpha.cost.low > 0.1


def test_frames_come_by_turns_each_in_its_order() -> None:
    mixed = list(by_turns("abcdef", "xyz", (6, 3)))
    assert [item for visit, item in mixed if visit == 0] == list("abcdef")
    assert [item for visit, item in mixed if visit == 1] == list("xyz")
    assert "".join(item for _, item in mixed) == "axbcydezf"


def test_points_turn_and_move_the_second_visit() -> None:
    rng = np.random.default_rng(0)
    first = rng.normal(0, 20, (8, 3))
    turn = Rotation.from_rotvec([0.1, -0.2, 1.0]).as_matrix()
    second = (first - [5, 6, 7]) @ turn
    exactly = Alignment.between(first, second)
    assert exactly.residual < 1e-9
    np.testing.assert_allclose(second @ exactly.matrix[:3, :3].T + exactly.matrix[:3, 3], first, atol=1e-9)
    noisy = Alignment.between(first + rng.normal(0, 0.1, first.shape), second)
    left = first - (second @ noisy.matrix[:3, :3].T + noisy.matrix[:3, 3])
    assert 0.05 < noisy.residual < 0.25
    assert np.abs(left).max() < 0.3


@pytest.mark.parametrize(("text", "wrong"), [
    ("1 2 3 4 5\n", "line 1: write x y z"),
    ("# none\n1 2 3 4 5 x\n", "line 2: write x y z"),
    ("1 2 3 4 5 6\n", "1 points; give 3"),
    ("0 0 0 0 0 0\n1 0 0 1 0 0\n2,0,0,2,0,0\n", "in a line"),
])  # fmt: skip
def test_points_that_do_not_tell_are_refused_in_one_line(text: str, wrong: str, tmp_path: Path) -> None:
    (tmp_path / "points.txt").write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=wrong):
        Alignment.read(tmp_path / "points.txt")


def test_georeferences_bring_visits_together_unless_their_projections_differ() -> None:
    utm = Georeference("A", (100.0, 200.0, 5.0))
    matrix = between(utm, dataclasses.replace(utm, offset=(110.0, 190.0, 5.0)), None, "evening")
    np.testing.assert_allclose(matrix @ [1, 2, 3, 1], [11, -8, 3, 1])
    np.testing.assert_array_equal(between(None, None, None, "evening"), np.eye(4))
    with pytest.raises(ConfigError, match="--align"):
        between(utm, Georeference("B"), None, "evening")
    with pytest.raises(ConfigError, match="--align"):
        between(utm, None, None, "evening")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The city by two lights, and the labels of a model that reads its images."""
    folder = tmp_path_factory.mktemp("visits")
    for light in ("noon", "evening"):
        options = [
            word for key in ("width=96", "height=54", "frames=10", f"light={light}") for word in ("--option", key)
        ]
        bench(*options, "--scene", "scene0", "--predict", "colour-clusters,clusters=3", "--voxel-size", "1",
              "--check", "none", "--no-geometry-check", "--out", light, "--rerun", "off", cwd=folder)  # fmt: skip
    return folder


def test_the_command_tells_agreement_across_and_writes_a_folder(runs: Path) -> None:
    screen = bench("compare", "noon", "evening", "--same-place", "--out", "both", cwd=runs, columns=80).stdout
    assert "alpha within noon" in screen
    content = json.loads((runs / "both/visits.json").read_text(encoding="utf-8"))
    (scene,) = content["scenes"]
    alpha = scene["visits"]["alpha"]
    within = (alpha["first"]["value"] + alpha["second"]["value"]) / 2
    assert alpha["cost"]["value"] == pytest.approx(within - alpha["across"]["value"])
    assert scene["visits"]["gone"] + scene["visits"]["new"] < 0.01 * scene["visits"]["stayed"]
    for file in ("report.html", "tables/visits.csv", "tables/visits_classes.csv", "figures/visits_map__scene0.png"):
        assert (runs / "both" / file).stat().st_size > 0


def test_a_run_beside_itself_costs_nothing_and_a_shifted_one_is_moved_back(runs: Path) -> None:
    itself = semstab.compare_visits(runs / "noon", runs / "noon").scenes[0].visits
    assert abs(itself.alpha.cost.value) < 1e-3
    (runs / "points.txt").write_text("\n".join(f"{x} {y} 0 {x} {y} 0" for x, y in ((0, 0), (9, 0), (0, 9))))
    moved = semstab.compare_visits(runs / "noon", runs / "noon", align=runs / "points.txt")
    assert moved.residual == pytest.approx(0, abs=1e-9)
    assert moved.scenes[0].visits.alpha.cost.value == pytest.approx(itself.alpha.cost.value, abs=0.01)


@pytest.mark.parametrize(("words", "wrong"), [
    (("noon", "--same-place"), "two visits; 1 runs"),
    (("noon", "evening", "--align", "points.txt"), "add --same-place"),
    (("noon", "evening", "--same-place", "--markdown"), "leave out"),
    (("noon", "evening", "--same-place", "--align", "none.txt"), "none.txt"),
])  # fmt: skip
def test_what_cannot_be_compared_is_said_in_one_line(words: tuple[str, ...], wrong: str, runs: Path) -> None:
    failed = bench("compare", *words, cwd=runs, code=2)
    assert wrong in failed.stderr
    assert len(failed.stderr.strip().splitlines()) == 1


def test_light_changes_images_and_nothing_else() -> None:
    from semstab.datasets import open_dataset

    options = {"width": 64, "height": 36, "frames": 2}
    noon, evening = (open_dataset("city", {**options, **light}).scene("scene0") for light in ({}, {"light": "evening"}))
    one, other = (scene.frame(1, "sim-steady") for scene in (noon, evening))
    np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(one.labels, other.labels)
    assert np.abs(one.color.astype(int) - other.color).mean() > 5
    assert noon.digest([0], "gt") != evening.digest([0], "gt")
    assert noon.fingerprints(0) == evening.fingerprints(0)
