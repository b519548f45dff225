"""simulations/signs.py: distances to borders by hand, the area under a curve, and a run that errs at a border."""

import math

import numpy as np
import pytest
import signs
from posed_writer import write_posed

import semstab
from semstab import Frame, Intrinsics

H, W, FOCAL, DEPTH, VOXEL = 24, 40, 40.0, 2.0, 0.05


def test_the_area_is_the_share_of_the_pairs_in_which_the_wrong_place_has_more():
    sign, wrong = np.array([3.0, 1.0, 2.0, 1.0]), np.array([True, True, False, False])
    assert signs.auroc(sign, wrong) == pytest.approx((1 + 1 + 0 + 0.5) / 4)
    assert math.isnan(signs.auroc(sign, np.zeros(4, bool)))
    assert math.isnan(signs.auroc(np.array([math.nan, 1, 2, 3]), wrong))


def test_a_border_is_as_far_as_its_nearest_pixel():
    labels = np.zeros((4, 7), np.uint8)
    labels[:, 5:] = 1
    assert signs.to_border(labels).tolist() == [[4, 3, 2, 1, 0, 0, 1]] * 4
    assert signs.to_border(labels.T).T.tolist() == [[4, 3, 2, 1, 0, 0, 1]] * 4
    assert (signs.to_border(np.zeros((3, 4), np.uint8)) == 5).all()  # there is none


def test_scores_are_low_where_their_largest_is_a_small_part_of_all():
    scores = np.array([[[1.0, 0, 0], [2.0, 1, 1], [0, 0, 0]]])
    assert signs.unsure(scores).tolist() == [[0.0, 0.5, 1.0]]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A wall of two classes, whose border the model has 0.2 m too far to the right, with low scores there."""

    def frames(source):
        for k in range(5):
            pose = np.eye(4)
            pose[0, 3] = k * VOXEL  # a pixel
            x = np.tile((np.arange(W) - (W - 1) / 2) * DEPTH / FOCAL + pose[0, 3], (H, 1))
            labels = (x > (0.0 if source == "gt" else 0.2)).astype(np.uint8)
            sure = np.where((x > 0) & (x < 0.2), 0.6, 0.9)
            scores = np.stack([np.where(labels == k, sure, 1 - sure) for k in (0, 1)], axis=2).astype(np.float32)
            yield Frame(
                k, np.full((H, W), DEPTH, np.float32), Intrinsics(FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2), pose,
                color=np.zeros((H, W, 3), np.uint8), labels=None if source == "net-scores" else labels,
                scores=scores if source == "net-scores" else None,
            )  # fmt: skip

    folder = tmp_path_factory.mktemp("signs")
    sources = {source: list(frames(source)) for source in ("net", "gt", "net-scores")}
    write_posed(folder / "wall", [f"{k}" for k in range(5)], sources, classes=["a", "b"], up_axis="-y")
    settings = {
        "dataset": {"name": "posed_folder", "options": {"root": str(folder / "wall")}}, "voxel_size": VOXEL,
        "statistics": True, "check": None,
    }  # fmt: skip
    semstab.run(semstab.load_config(overrides=settings), out=folder / "run", report=False)
    return folder / "run"


@pytest.mark.parametrize("model", ["net", "net-scores"])
def test_lasting_errors_at_a_border_show_by_border_and_scores_not_by_disagreement(run, model):
    name, (numbers,) = signs.of_run(f"{run}:{model}", "net-scores")
    assert name == model
    assert numbers["wrong"] == pytest.approx(4 / (W - 2), abs=0.03)  # of the columns that three frames see
    if model == "net":
        assert numbers[signs.DISAGREE] == pytest.approx(0.5)
    for sign in (signs.IN_MAP, f"{signs.NEAR}: one frame", f"{signs.NEAR}: all"):
        assert numbers[sign] == pytest.approx(1 - 4 * 4 / 2 / (4 * (W - 6)), abs=0.03)  # as near on the other side
    assert numbers[f"{signs.UNSURE}: one frame"] == pytest.approx(1.0)
    assert numbers[f"{signs.UNSURE}: all"] == pytest.approx(1.0)


def test_labels_without_scores_have_no_number_for_them(run):
    _, (numbers,) = signs.of_run(f"{run}:net", None)
    assert math.isnan(numbers[f"{signs.UNSURE}: all"])
    assert numbers[signs.IN_MAP] > 0.9


def test_the_table_has_a_row_for_each_run(run, capsys):
    signs.table([f"{run}:net", f"{run}:net-scores"], None)
    head, _, one, other = capsys.readouterr().out.splitlines()
    assert len(head.split("|")) == len(one.split("|")) == len(other.split("|"))
    assert one.split("|")[1].strip() == "net"
    assert one.split("|")[-2].strip() == "-"
    assert other.split("|")[-2].strip() == "1.00"
