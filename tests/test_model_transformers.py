"""Model `transformers` on each kind of checkpoint, tiny ones, against transformers' own post-processing."""

from __future__ import annotations

import importlib.util
import shutil

import numpy as np
import pytest
import tiny_models
import torch
import transformers
from model_folders import tiny
from pictures import blobs

from semstab.errors import ConfigError, DataError, MissingDependencyError
from semstab.models import create
from semstab.models.sam import SamOptions, SamProposer

WIDE = [blobs(shift=k) for k in range(2)]
TALL = [np.ascontiguousarray(image.transpose(1, 0, 2)) for image in WIDE]

UNIVERSAL = ("mask2former", "maskformer", "oneformer", "eomt")


def loaded(kind, cls):
    return cls.from_pretrained(tiny(kind)).eval()


@pytest.fixture(scope="module", params=UNIVERSAL)
def universal(request):
    return request.param, create("transformers", checkpoint=str(tiny(request.param)))


@pytest.mark.parametrize("images", [WIDE, TALL], ids=["wide", "tall"])
@torch.inference_mode()
def test_universal_segmentation_is_that_of_transformers(universal, images):
    kind, model = universal
    more = {"class_info_file": None} if kind == "oneformer" else {}
    processor = transformers.AutoImageProcessor.from_pretrained(tiny(kind), backend="pil", **more)
    if kind == "oneformer":
        text = {"max_seq_length": 24, "task_seq_length": 24}
        processor = transformers.OneFormerProcessor(processor, tiny_models.tokenizer(), **text)
        inputs = processor(images=images, task_inputs=["semantic"] * 2, return_tensors="pt")
    else:
        inputs = processor(images=images, return_tensors="pt")
    offsets = inputs.pop("patch_offsets", None)
    output = loaded(kind, transformers.AutoModelForUniversalSegmentation)(**inputs)
    if offsets is not None:
        output.patch_offsets = offsets
    sizes = [image.shape[:2] for image in images]
    theirs = processor.post_process_semantic_segmentation(output, sizes, return_segmentation_scores=True)
    labels = set()
    for prediction, wanted in zip(model.predict(images, scores=True), theirs, strict=True):
        values = wanted.segmentation_scores
        np.testing.assert_array_equal(prediction.labels, wanted.segmentation)
        np.testing.assert_allclose(prediction.scores, (values / values.sum(0)).permute(1, 2, 0), atol=2e-6)
        labels |= set(np.unique(prediction.labels))
    streamed = np.stack(list(model.stream(images[0]).maps()), axis=2)
    np.testing.assert_array_equal(streamed, model.predict(images[:1], scores=True)[0].scores)
    assert len(labels) > 1
    assert model.label_space.classes == tuple(tiny_models.NAMES.values())


def test_padding_of_eomt_is_not_stretched_over_the_image(tmp_path):
    """Of an image of windows that are padded, the padding is cut off; transformers' semantic maps keep it."""
    folder = shutil.copytree(tiny("eomt"), tmp_path / "model")
    size = {"shortest_edge": 64, "longest_edge": 64}
    transformers.EomtImageProcessorPil(size=size, do_pad=True).save_pretrained(folder)
    square = np.zeros((80, 80, 3), np.uint8)
    square[:48] = WIDE[0]
    model = create("transformers", checkpoint=str(folder))
    (padded,), (cut,) = model.predict([square], scores=True), model.predict([WIDE[0]], scores=True)
    inner = np.s_[:30]  # further down the resize mixes padding in
    assert (padded.labels[inner] == cut.labels[inner]).mean() > 0.9


@torch.inference_mode()
def test_prompts_of_clipseg():
    prompts = ["road", "a tree"]
    model = create("transformers", checkpoint=str(tiny("clipseg")), prompts=prompts)
    assert model.label_space.classes == ("road", "a tree")
    network = loaded("clipseg", transformers.CLIPSegForImageSegmentation)
    processor = transformers.AutoImageProcessor.from_pretrained(tiny("clipseg"), backend="pil")
    pixels = processor(images=WIDE[:1], return_tensors="pt")["pixel_values"].expand(2, -1, -1, -1)
    tokens = tiny_models.tokenizer()(prompts, padding=True, return_tensors="pt")
    logits = network(**tokens, pixel_values=pixels).logits
    full = torch.nn.functional.interpolate(logits[None], size=(48, 80), mode="bilinear")[0]
    (found,) = model.predict(WIDE[:1], scores=True)
    np.testing.assert_array_equal(found.labels, full.argmax(0))
    np.testing.assert_allclose(found.scores, full.softmax(0).permute(1, 2, 0), atol=1e-6)
    threshold = float(full.sigmoid().amax(0).median())
    unsure = create("transformers", checkpoint=str(tiny("clipseg")), prompts="road, a tree", threshold=threshold)
    (some,) = unsure.predict(WIDE[:1], scores=True)
    ignored = (full.sigmoid().amax(0) < threshold).numpy()
    assert 0 < ignored.mean() < 1
    np.testing.assert_array_equal(some.labels, np.where(ignored, 255, found.labels))
    assert not some.scores[ignored].any()


@pytest.mark.parametrize("kind", ["dpt", "data2vec"])
@torch.inference_mode()
def test_models_of_squares_see_squares_and_say_so(kind, caplog):
    model = create("transformers", checkpoint=str(tiny(kind)))
    assert "sees squares: images are squeezed into 64x64" in caplog.text
    (found,) = model.predict(WIDE[:1])
    processor = transformers.AutoImageProcessor.from_pretrained(tiny(kind), backend="pil")
    square = {"height": 64, "width": 64}
    more = {"keep_aspect_ratio": False} if kind == "dpt" else {}
    pixels = processor(images=WIDE[:1], size=square, return_tensors="pt", **more)["pixel_values"]
    logits = loaded(kind, transformers.AutoModelForSemanticSegmentation)(pixel_values=pixels).logits
    full = torch.nn.functional.interpolate(logits, size=(48, 80), mode="bilinear")[0]
    np.testing.assert_array_equal(found.labels, full.argmax(0))
    with pytest.raises(ConfigError, match=r"image_size: a '.*' model sees squares; give one number, 64 for example"):
        create("transformers", checkpoint=str(tiny(kind)), image_size=[64, 96])


def test_a_size_that_a_model_cannot_see_is_one_line():
    model = create("transformers", checkpoint=str(tiny("data2vec")), image_size=96)
    with pytest.raises(ConfigError, match=r"cannot see 96x96 .*; give the size that it was made for") as caught:
        model.predict(WIDE[:1])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("clipseg", {}, "model needs prompts; set prompts"),
        ("clipseg", {"prompts": ["a", "b"], "image_size": [32, 64]}, "sees squares; give one number"),
        ("eomt", {"image_size": 32}, "sees windows of the size that it was made for"),
        ("eomt", {"engine": "onnx"}, "engine onnx cannot run a 'eomt' model"),
        ("segformer", {"prompts": ["a", "b"]}, "prompts and threshold are for 'clipseg' models, not for 'segformer'"),
    ],
)
def test_options_that_do_not_fit(kind, options, message):
    with pytest.raises(ConfigError, match=message):
        create("transformers", checkpoint=str(tiny(kind)), **options)


def test_without_torchvision_it_is_said_what_to_install(monkeypatch):
    there = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "torchvision" else there(name))
    with pytest.raises(MissingDependencyError, match=r"leave it out, or pip install 'semstab\[torchvision\]'$"):
        create("transformers", checkpoint=str(tiny("segformer")), processor="torchvision")


# --- The preprocessing's library --------------------------------------------------------------------------------------


def test_the_library_that_resizes_does_not_depend_on_what_is_installed(monkeypatch):
    """Both were used, whichever was there: up to 1.8 % of the labels differed."""
    asked = []
    original = transformers.AutoImageProcessor.from_pretrained

    def from_pretrained(folder, **options):
        asked.append(options["backend"])
        return original(folder, **options)

    monkeypatch.setattr(transformers.AutoImageProcessor, "from_pretrained", from_pretrained)
    model = create("transformers", checkpoint=str(tiny("segformer")))
    assert asked == ["pil"]
    assert model.identity()["processor"] == "pil"
    assert SamProposer(SamOptions(checkpoint=str(tiny("sam")))).identity()["processor"] == "pil"
    assert asked == ["pil", "pil"]


def test_another_library_than_the_one_asked_for_is_refused(monkeypatch):
    class SegformerImageProcessor:
        pass

    monkeypatch.setattr(
        transformers.AutoImageProcessor, "from_pretrained", lambda folder, **options: SegformerImageProcessor()
    )
    with pytest.raises(DataError, match="cannot do its work by pil; set processor: torchvision"):
        create("transformers", checkpoint=str(tiny("segformer")))


# --- Segment Anything's later kinds -----------------------------------------------------------------------------------

EVERY = {"points_per_side": 2, "pred_iou": 0, "stability": 0, "nms_iou": 1, "min_area": 0}


@pytest.mark.parametrize("kind", ["sam2", "sam_hq"])
@torch.inference_mode()
def test_later_kinds_of_sam_propose(kind):
    proposer = SamProposer(SamOptions(checkpoint=str(tiny(kind)), **EVERY))
    found = proposer.propose(WIDE[0])
    model = loaded(kind, transformers.AutoModelForMaskGeneration)
    grid = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    if kind == "sam2":
        pixels = torch.from_numpy(WIDE[0]).permute(2, 0, 1)[None].float() / 255
        pixels = torch.nn.functional.interpolate(pixels, size=(64, 64), mode="bilinear", antialias=True)
        mean, std = (torch.tensor(x)[:, None, None] for x in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
        output = model(pixel_values=(pixels - mean) / std, input_points=(grid * 64)[None, :, None])
        masks = torch.nn.functional.interpolate(output.pred_masks[0], size=(48, 80), mode="bilinear")
    else:
        processor = transformers.SamImageProcessorPil.from_pretrained(tiny("sam"))
        inputs = processor(images=WIDE[0], return_tensors="pt")
        height, width = (int(side) for side in inputs["reshaped_input_sizes"][0])
        points = (grid * torch.tensor([width, height]))[None, :, None].float()
        output = model(pixel_values=inputs["pixel_values"], input_points=points)
        sizes = (inputs["original_sizes"], inputs["reshaped_input_sizes"])
        masks = processor.post_process_masks(output.pred_masks, *sizes, binarize=False)[0]
    wanted = {
        (round(float(score), 4), int((mask > 0).sum()))
        for score, mask in zip(output.iou_scores.flatten(), masks.flatten(0, 1), strict=True)
        if (mask > 0).any() and score > 0
    }
    areas = np.bitwise_count(found.packed).sum(1)
    got = {(round(float(score), 4), int(area)) for score, area in zip(found.scores, areas, strict=True)}
    assert len(wanted) > 1
    assert got == wanted


def test_a_sam_of_another_kind(tmp_path, monkeypatch):
    from semstab.models import sam

    monkeypatch.setattr(sam, "KINDS", ())
    with pytest.raises(DataError, match="a 'sam' model; name one of sam, sam_hq, sam2"):
        SamProposer(SamOptions(checkpoint=str(tiny("sam"))))
