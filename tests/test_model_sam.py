"""Segment Anything's proposals, and what is made of them: by hand, by brute force, and on a tiny model."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
import transformers
import yaml
from model_folders import KINDS, folder_of, tiny
from pictures import blobs

from semstab.errors import ConfigError
from semstab.models import create
from semstab.models.sam import Proposals, SamOptions, SamProposer, majority, mask_features, read_rules, region_map

IMAGE = blobs()
TINY = {
    "points_per_side": 4,
    "pred_iou": 0.5,
    "stability": 0.3,
    "stability_offset": 0.01,
    "nms_iou": 0.95,
    "min_area": 20,
}
REAL = {**TINY, "points_per_side": 2}


@pytest.fixture(params=KINDS, scope="module")
def options(request):
    return {"checkpoint": str(folder_of(request.param, "sam")), **(TINY if request.param == "tiny" else REAL)}


@pytest.fixture(scope="module")
def proposer(options):
    return SamProposer(SamOptions(**options))


def proposals_of(*masks, scores=None):
    masks = [np.array(mask, dtype=bool) for mask in masks]
    packed = np.array([np.packbits(mask) for mask in masks])
    scores = np.ones(len(masks)) if scores is None else np.array(scores)
    return Proposals(masks[0].shape, packed, scores)


# --- The model's proposals --------------------------------------------------------------------------------------------


def test_proposals_are_masks_of_the_image(proposer):
    proposals = proposer.propose(IMAGE)
    assert len(proposals) > 0
    assert proposals.shape == (48, 80)
    for k in range(len(proposals)):
        assert proposals.mask(k).any()
    assert (np.diff(proposals.scores) <= 0).all()


def test_proposals_are_the_same_again_and_in_other_batches(options, proposer):
    first = proposer.propose(IMAGE)
    for other in (proposer, SamProposer(SamOptions(**options, points_per_batch=3))):
        again = other.propose(IMAGE)
        np.testing.assert_allclose(again.scores, first.scores, atol=1e-5)
        assert (np.bitwise_count(again.packed ^ first.packed).sum(axis=1) <= 2).all()


def test_proposals_are_those_of_the_article(options, proposer):
    """All points at once, every mask at full size, the rules one after the other."""
    model, settings = proposer.model, proposer.options
    inputs = transformers.AutoImageProcessor.from_pretrained(options["checkpoint"], backend="pil")(
        IMAGE, return_tensors="pt"
    )
    height, width = inputs["reshaped_input_sizes"][0].tolist()
    side = settings.points_per_side
    points = [[(x + 0.5) / side * width, (y + 0.5) / side * height] for y in range(side) for x in range(side)]
    with torch.inference_mode():
        found = model(pixel_values=inputs["pixel_values"], input_points=torch.tensor(points)[None, :, None])
        padded = inputs["pixel_values"].shape[-2:]
        low = found.pred_masks[0].flatten(0, 1)[None]
        square = torch.nn.functional.interpolate(low, padded, mode="bilinear")[..., :height, :width]
        logits = torch.nn.functional.interpolate(square, IMAGE.shape[:2], mode="bilinear")[0]
    scores, offset = found.iou_scores[0].flatten(), settings.stability_offset
    stability = (logits > offset).sum((1, 2)) / (logits > -offset).sum((1, 2)).clamp(min=1)
    scored = [
        (float(score), mask.numpy() > 0)
        for score, mask, stable in zip(scores, logits, stability, strict=True)
        if score > settings.pred_iou and stable >= settings.stability and (mask > 0).any()
    ]
    assert len(scored) >= len(proposer.propose(IMAGE))
    boxes = np.array([box_of(mask) for _, mask in scored])
    stay = brute_force_suppression(boxes, np.array([score for score, _ in scored]), settings.nms_iou)
    proposals = proposer.propose(IMAGE)
    assert len(proposals) == len(stay)
    for k, row in enumerate(stay):
        assert (proposals.mask(k) != scored[row][1]).sum() <= 2


def box_of(mask):
    rows, columns = np.nonzero(mask)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def test_the_thresholds_are_thresholds(options):
    everything = SamProposer(SamOptions(**{**options, "pred_iou": 0.0})).propose(IMAGE).scores
    ratings = np.unique(everything[everything < 1])
    between = (ratings[-1] + ratings[-2]) / 2
    few = SamProposer(SamOptions(**{**options, "pred_iou": between})).propose(IMAGE).scores
    assert few.min() == pytest.approx(ratings[-1])
    assert len(SamProposer(SamOptions(**{**options, "stability": 1.0, "stability_offset": 5.0})).propose(IMAGE)) == 0


def test_proposals_are_kept_in_a_folder(options, tmp_path, monkeypatch):
    cached = SamProposer(SamOptions(**options, cache=tmp_path))
    first = cached.propose(IMAGE)
    monkeypatch.setattr(cached, "model", None)
    again = cached.propose(IMAGE)
    for field in dataclasses.fields(first):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(again, field.name))
    other = SamProposer(SamOptions(**{**options, "min_area": 1000}, cache=tmp_path))
    monkeypatch.setattr(other, "model", None)
    assert len(other.propose(IMAGE)) == len(first)
    stricter = SamProposer(SamOptions(**{**options, "nms_iou": 0.1}, cache=tmp_path))
    stricter.propose(IMAGE)
    files = list(tmp_path.glob("*/*.npz"))
    assert len(files) == 2
    for file in files:
        file.write_bytes(file.read_bytes()[:300])
    assert len(SamProposer(SamOptions(**options, cache=tmp_path)).propose(IMAGE)) == len(first)


# --- The parts of it --------------------------------------------------------------------------------------------------


def iou(a, b):
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(width, 0) * max(height, 0)
    whole = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared
    return shared / whole if whole else 0


def brute_force_suppression(boxes, scores, threshold):
    stay = []
    for k in sorted(range(len(boxes)), key=lambda k: (-scores[k], k)):
        if all(iou(boxes[k], boxes[other]) <= threshold for other in stay):
            stay.append(k)
    return stay


# --- sam-raw ----------------------------------------------------------------------------------------------------------


def regions(proposals, min_area):
    return region_map(proposals.by_area(min_area), proposals.shape)


def test_of_equal_masks_the_better_one_lies_below():
    proposals = proposals_of([[0, 1, 1]], [[1, 1, 0]], scores=[0.9, 0.95])
    assert regions(proposals, 1).tolist() == [[1, 2, 2]]


def test_smaller_masks_are_painted_over_larger_ones():
    proposals = proposals_of([[0, 1, 1, 0]], [[1, 1, 1, 0]], [[0, 0, 1, 0]])
    assert regions(proposals, 1).tolist() == [[1, 2, 3, 0]]
    assert regions(proposals, 2).tolist() == [[1, 2, 2, 0]]
    assert regions(proposals, 4).tolist() == [[0, 0, 0, 0]]
    assert regions(proposals, 1).dtype == np.uint16


def test_raw_proposals_have_no_classes(options):
    model = create("sam-raw", **options)
    assert model.label_space is None
    (prediction,) = model.predict([IMAGE])
    assert prediction.labels.dtype == np.uint16
    assert prediction.labels.shape == (48, 80)
    ids = np.unique(prediction.labels)
    assert 0 < ids.max() <= len(model.proposer.propose(IMAGE))


# --- sam-heuristic ----------------------------------------------------------------------------------------------------


def colour(hue, saturation, value, shape=(4, 4)):
    """An RGB image of one colour, given on OpenCV's HSV scale."""
    hsv = np.full((*shape, 3), (hue, saturation, value), dtype=np.uint8)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def test_the_mean_hue_goes_around_the_circle():
    hsv = np.zeros((1, 4, 3), dtype=np.uint8)
    hsv[0, :, 0] = (178, 2, 4, 176)
    hsv[0, :, 1] = (10, 20, 30, 40)
    look = mask_features(hsv, np.ones((1, 4), dtype=bool))
    assert min(look["hue"], 180 - look["hue"]) == pytest.approx(0, abs=1e-6)
    assert (look["saturation"], look["aspect"], look["area"]) == (25, 4, 1)


@pytest.mark.parametrize(
    ("look", "name"),
    [
        ({"hue": 0, "saturation": 49, "value": 70, "area": 0.1, "aspect": 9}, "road"),
        ({"hue": 0, "saturation": 49, "value": 210, "area": 0.1, "aspect": 9}, "road"),
        ({"hue": 0, "saturation": 50, "value": 100, "area": 0.1, "aspect": 9}, "clutter"),
        ({"hue": 20, "saturation": 11, "value": 41, "area": 0.001, "aspect": 9}, "vegetation"),
        ({"hue": 100, "saturation": 200, "value": 229, "area": 0.1, "aspect": 9}, "vegetation"),
        ({"hue": 100, "saturation": 200, "value": 230, "area": 0.1, "aspect": 1}, "clutter"),
        ({"hue": 101, "saturation": 200, "value": 200, "area": 0.1, "aspect": 1}, "clutter"),
        ({"hue": 111, "saturation": 200, "value": 200, "area": 0.1, "aspect": 2.4}, "building"),
        ({"hue": 19, "saturation": 200, "value": 200, "area": 0.1, "aspect": 2.4}, "building"),
        ({"hue": 19, "saturation": 200, "value": 200, "area": 0.1, "aspect": 2.5}, "clutter"),
        ({"hue": 19, "saturation": 200, "value": 200, "area": 0.001, "aspect": 1}, "clutter"),
    ],
)
def test_the_first_rule_that_holds(look, name):
    rules = read_rules(None)
    assert rules.names[rules.class_of(look)] == name


def test_masks_become_classes(monkeypatch):
    model = create("sam-heuristic", checkpoint=str(tiny("sam")), **{**TINY, "min_area": 1})
    image = np.concatenate([colour(0, 20, 120), colour(60, 200, 120), colour(150, 200, 120)], axis=1)
    halves = np.zeros((3, 4, 12), dtype=bool)
    for k in range(3):
        halves[k, :, 4 * k : 4 * k + 3] = True
    monkeypatch.setattr(model.proposer, "propose", lambda image: proposals_of(*halves))
    names = np.array(model.label_space.classes)[model.predict([image])[0].labels]
    assert names[0].tolist() == [*["road"] * 3, "clutter", *["vegetation"] * 3, "clutter", *["building"] * 3, "clutter"]


def test_rules_of_ones_own(tmp_path):
    file = tmp_path / "rules.yaml"
    file.write_text(
        yaml.safe_dump({"classes": ["dark"], "rest": "bright", "rules": [{"name": "dark", "value": {"below": 9}}]})
    )
    rules = read_rules(file)
    assert rules.names == ["dark", "bright"]
    look = {"hue": 0, "saturation": 0, "area": 1, "aspect": 1}
    assert [rules.class_of(look | {"value": value}) for value in (8, 9)] == [0, 1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("classes: [a]\nrest: b\nrules: [{name: c}]", "rules.yaml: the rule 'c' has no class of that name"),
        ("classes: [a]\nrest: b\nrules: [{name: a, hew: {min: 1}}]", "unknown setting .*hew'; did you mean 'hue'"),
        ("classes: [a]", "rest: field required"),
    ],
)
def test_rules_that_cannot_be_used(tmp_path, text, message):
    (tmp_path / "rules.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_rules(tmp_path / "rules.yaml")


# --- sam-vote ---------------------------------------------------------------------------------------------------------


def test_the_majority_inside_a_mask():
    labels = np.array([[1, 1, 2, 255, 255, 255, 3]], dtype=np.uint8)
    proposals = proposals_of([[1, 1, 1, 1, 1, 1, 0]], [[0, 0, 0, 1, 1, 0, 0]])
    assert majority(labels, proposals.by_area(1)).tolist() == [[1, 1, 1, 1, 1, 1, 3]]
    assert majority(labels, proposals_of([[0, 0, 0, 1, 1, 1, 0]]).by_area(1)).tolist() == labels.tolist()


def test_a_tie_goes_to_the_lowest_id_and_smaller_masks_vote_last():
    labels = np.array([[2, 2, 1, 1, 5]], dtype=np.uint16)
    proposals = proposals_of([[0, 0, 0, 1, 1]], [[1, 1, 1, 1, 0]])
    assert majority(labels, proposals.by_area(1)).tolist() == [[1, 1, 1, 1, 1]]
    assert majority(labels, proposals.by_area(3)).tolist() == [[1, 1, 1, 1, 5]]


def test_the_vote_of_another_model(options):
    voter = create("colour-clusters", clusters=4).fit([IMAGE])
    model = create("sam-vote", **options, voter="colour-clusters", voter_options={"clusters": 4}).fit([IMAGE])
    assert model.label_space == voter.label_space
    (prediction,) = model.predict([IMAGE])
    proposals = model.proposer.propose(IMAGE)
    (vote,) = voter.predict([IMAGE])
    expected = majority(vote.labels, proposals.by_area(model.proposer.options.min_area))
    np.testing.assert_array_equal(prediction.labels, expected)
    assert model.identity()["voter_options"] == voter.identity()


def test_regions_cannot_vote():
    raw = {"checkpoint": str(tiny("sam")), **TINY}
    with pytest.raises(ConfigError, match="the voter 'sam-raw' has no classes"):
        create("sam-vote", **raw, voter="sam-raw", voter_options=raw)
