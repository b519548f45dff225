"""SegEarth-OV and its parts, each against a plain re-computation; then whole on a tiny CLIP."""

import math

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from model_folders import KINDS, folder_of, tiny
from pictures import blobs
from transformers import AutoTokenizer, CLIPModel

from semstab.errors import ConfigError, DataError
from semstab.models import create
from semstab.models.segearth_ov import (
    CLIP_MEAN,
    CLIP_STD,
    JointBilateralUpsampler,
    SimFeatUp,
    dense_features,
    normalised,
    read_prompts,
    self_self_attention,
    slide,
    starts,
)
from semstab.testing import checks

IMAGES = [blobs(shift=k) for k in range(2)]


@pytest.fixture(scope="module")
def clip():
    return CLIPModel.from_pretrained(tiny("clip")).eval()


def random(*shape, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape)).float()


def softmax(x, axis):
    e = np.exp(x - x.max(axis=axis, keepdims=True))
    return e / e.sum(axis=axis, keepdims=True)


def weights(linear):
    return linear.weight.detach().double().numpy(), linear.bias.detach().double().numpy()


# --- The last block ---------------------------------------------------------------------------------------------------


def plain_attention(attention, tokens):
    """Head by head and token by token, in float64."""
    x = tokens.double().numpy()
    q, k, v = (x @ W.T + b for W, b in map(weights, (attention.q_proj, attention.k_proj, attention.v_proj)))
    d, out = attention.head_dim, np.zeros_like(x)
    for n in range(len(x)):
        for head in range(attention.num_heads):
            part = slice(head * d, (head + 1) * d)
            for t in range(x.shape[1]):
                for y in (q, k, v):
                    likeness = np.array([y[n, t, part] @ y[n, s, part] for s in range(x.shape[1])]) / math.sqrt(d)
                    out[n, t, part] += softmax(likeness, 0) @ v[n, :, part]
    W, b = weights(attention.out_proj)
    return out @ W.T + b


@torch.inference_mode()
def test_the_attention_is_that_of_its_formula(clip):
    attention = clip.vision_model.encoder.layers[-1].self_attn
    tokens = random(2, 5, 16)
    np.testing.assert_allclose(self_self_attention(attention, tokens), plain_attention(attention, tokens), atol=1e-5)


@torch.inference_mode()
def test_features_are_clips_own_up_to_the_last_block(clip):
    pixels = random(2, 3, 32, 32)
    before = clip.vision_model(pixels, output_hidden_states=True).hidden_states[-2]
    last = clip.vision_model.encoder.layers[-1]
    tokens = torch.from_numpy(plain_attention(last.self_attn, last.layer_norm1(before))).float()
    expected = clip.visual_projection(clip.vision_model.post_layernorm(tokens))
    whole, patches = dense_features(clip, pixels)
    assert patches.shape == (2, 12, 4, 4)
    torch.testing.assert_close(whole, expected[:, 0], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(patches[1, :, 2, 3], expected[1, 1 + 2 * 4 + 3], atol=1e-4, rtol=1e-4)


# --- SimFeatUp --------------------------------------------------------------------------------------------------------


def mirrored(i, n):
    """An index beyond the border, reflected without repeating the outer pixel."""
    i = abs(i)
    return 2 * (n - 1) - i if i >= n else i


def brute_force_upsampling(module, source, guidance):
    """Pixel by pixel and neighbour by neighbour, in float64."""
    r, D = module.radius, module.diameter
    two_layers = [module.range_proj, module.fixup_proj]
    (A, a, B, b), (C, c, E, e) = (
        [*(w[:, :, 0, 0] if w.ndim == 4 else w for layer in (seq[0], seq[3]) for w in weights(layer))]
        for seq in two_layers
    )
    g = guidance[0].double().numpy()
    H, W = g.shape[1:]
    bicubic = torch.nn.functional.interpolate(source.double(), size=(H, W), mode="bicubic", align_corners=False)[0]
    gelu = np.vectorize(lambda x: x * 0.5 * (1 + math.erf(x / math.sqrt(2))))
    key = np.einsum("kc,chw->khw", B, gelu(np.einsum("kc,chw->khw", A, g) + a[:, None, None])) + b[:, None, None]
    temperature = min(max(math.exp(float(module.range_temp)), 1e-4), 1e4)
    sigma = float(module.sigma_spatial)
    offsets = [(dy, dx) for dy in range(-r, r + 1) for dx in range(-r, r + 1)]
    spatial = np.array([math.exp(-((dy / r) ** 2 + (dx / r) ** 2) / (2 * sigma**2)) for dy, dx in offsets])
    out = np.zeros((source.shape[1], H, W))
    for y in range(H):
        for x in range(W):
            near = [(mirrored(y + dy, H), mirrored(x + dx, W)) for dy, dx in offsets]
            kernel = softmax(temperature * np.array([key[:, y, x] @ key[:, v, u] for v, u in near]), 0) * spatial
            kernel = kernel / max(kernel.sum(), 1e-7)
            kernel = kernel + 0.1 * (E @ gelu(C @ np.concatenate([kernel, g[:, y, x]]) + c) + e)
            for weight, (v, u) in zip(kernel, near, strict=True):
                out[:, y, x] += weight * bicubic[:, v, u].numpy()
    assert len(offsets) == D**2
    return out


@torch.inference_mode()
@pytest.mark.parametrize(("radius", "temperature", "sigma"), [(1, 0.0, 1.0), (2, 0.7, 0.6), (2, -20.0, 2.0)])
def test_joint_bilateral_upsampling_is_that_of_its_formula(radius, temperature, sigma):
    torch.manual_seed(0)
    module = JointBilateralUpsampler(radius).eval()
    module.range_temp.fill_(temperature)
    module.sigma_spatial.fill_(sigma)
    source, guidance = random(1, 4, 3, 4), random(1, 3, 6, 8, seed=1)
    expected = brute_force_upsampling(module, source, guidance)
    np.testing.assert_allclose(module(source, guidance)[0], expected, atol=1e-5)


def checkpoint(path, channels=12):
    """A file as the public checkpoints are: all weights below 'upsampler.'."""
    torch.manual_seed(1)
    module = SimFeatUp(channels)
    torch.save({"state_dict": {f"upsampler.{key}": value for key, value in module.state_dict().items()}}, path)
    return module.eval()


@torch.inference_mode()
def test_features_are_upsampled_16_times(tmp_path):
    module = checkpoint(tmp_path / "jbu_one.ckpt")
    loaded = SimFeatUp.load(tmp_path / "jbu_one.ckpt", 12, torch.device("cpu"), torch.float32)
    features, image = random(1, 12, 3, 4), random(1, 3, 24, 32)
    upsampled = loaded(features, image)
    assert upsampled.shape == (1, 12, 48, 64)
    torch.testing.assert_close(upsampled, module(features, image))
    step = features
    for size in ((6, 8), (12, 16), (24, 32), (48, 64)):
        step = module.up(step, torch.nn.functional.adaptive_avg_pool2d(image, size))
    torch.testing.assert_close(upsampled, step + 0.1 * module.fixup_proj(step))


def test_the_names_are_those_of_the_public_checkpoint():
    assert {name: tuple(value.shape) for name, value in SimFeatUp(512).state_dict().items()} == {
        "up.range_temp": (),
        "up.sigma_spatial": (),
        "up.range_proj.0.weight": (32, 3, 1, 1),
        "up.range_proj.0.bias": (32,),
        "up.range_proj.3.weight": (32, 32, 1, 1),
        "up.range_proj.3.bias": (32,),
        "up.fixup_proj.0.weight": (121, 124, 1, 1),
        "up.fixup_proj.0.bias": (121,),
        "up.fixup_proj.3.weight": (121, 121, 1, 1),
        "up.fixup_proj.3.bias": (121,),
        "fixup_proj.1.weight": (512, 512, 1, 1),
        "fixup_proj.1.bias": (512,),
    }


def test_fewer_than_3x3_patches_are_refused():
    with pytest.raises(ConfigError, match="SimFeatUp needs 3x3 patches or more, a window has 2x4"):
        SimFeatUp(4)(random(1, 4, 2, 4), random(1, 3, 16, 32))


def test_weights_that_are_none(tmp_path):
    bad = tmp_path / "bad.ckpt"
    bad.write_bytes(b"no")
    with pytest.raises(DataError, match="no SimFeatUp weights for 12 channels"):
        create("segearth-ov", checkpoint=str(tiny("clip")), upsampler=bad)
    checkpoint(tmp_path / "other.ckpt", channels=8)
    with pytest.raises(DataError, match="no SimFeatUp weights for 12 channels"):
        create("segearth-ov", checkpoint=str(tiny("clip")), upsampler=tmp_path / "other.ckpt")
    with pytest.raises(DataError, match="there is no SimFeatUp checkpoint"):
        create("segearth-ov", checkpoint=str(tiny("clip")), upsampler=tmp_path / "nowhere.ckpt")


# --- Windows ----------------------------------------------------------------------------------------------------------


@checks
@given(st.integers(1, 60), st.integers(1, 30), st.data())
def test_windows_cover_an_axis_and_stay_inside(length, window, data):
    stride = data.draw(st.integers(1, window))
    begins = starts(length, window, stride)
    covered = {x for start in begins for x in range(start, min(start + window, length))}
    assert covered == set(range(length))
    assert all(start + min(window, length) <= length for start in begins)
    assert begins == sorted(set(begins))


@checks
@given(st.integers(1, 20), st.integers(1, 20), st.integers(1, 8), st.data())
def test_overlapping_windows_are_averaged(height, width, window, data):
    """Each window answers with its own number: a pixel gets the mean of those that cover it."""
    stride = data.draw(st.integers(1, window))
    pixels = torch.arange(height * width, dtype=torch.float32).reshape(1, height, width)
    found = slide(pixels, window, stride, lambda w: w[:, :1, :1].expand(1, *w.shape[1:]))
    total, count = np.zeros((height, width)), np.zeros((height, width))
    for top in starts(height, window, stride):
        for left in starts(width, window, stride):
            total[top : top + window, left : left + window] += top * width + left
            count[top : top + window, left : left + window] += 1
    np.testing.assert_allclose(found[0], total / count, rtol=1e-6)


def test_the_image_is_shown_in_clips_colours():
    pixels = normalised(np.full((30, 60, 3), 255, dtype=np.uint8), 20)
    assert (pixels.shape, pixels.dtype) == ((3, 10, 20), np.float32)
    for channel, mean, deviation in zip(pixels, CLIP_MEAN, CLIP_STD, strict=True):
        np.testing.assert_allclose(channel, (1 - mean) / deviation, rtol=1e-5)


# --- Prompts ----------------------------------------------------------------------------------------------------------


def test_the_shipped_prompts_are_those_for_uavid():
    prompts = read_prompts(None)
    assert prompts.names == ["background", "building", "road", "car", "tree", "vegetation", "human"]
    assert (prompts.background, prompts.prob_threshold, len(set(prompts.templates))) == ("background", 0.3, 80)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"classes": ["a"]}, "classes: "),
        ({"classes": ["a,", "b"]}, "classes: 'a,' has an empty name"),
        ({"classes": ["a", "b"], "templates": ["a photo"]}, "templates: 'a photo' must hold {} once"),
        ({"classes": ["a", "b"], "background": "c"}, "the background 'c' is not a class"),
        ({"classes": ["a", "b"], "prob_threshold": 0.3}, "prob_threshold needs a background class"),
        ({"classes": ["a", "b"], "clases": []}, "unknown setting 'clases'; did you mean 'classes'?"),
    ],
)
def test_prompts_that_cannot_be_used(tmp_path, content, message):
    file = tmp_path / "prompts.yaml"
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError) as caught:
        read_prompts(file)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{file}: ")


# --- The whole --------------------------------------------------------------------------------------------------------


@pytest.fixture(params=KINDS, scope="module")
def options(request):
    return {"checkpoint": str(folder_of(request.param, "clip")), **({"resize": 64} if request.param == "tiny" else {})}


@pytest.fixture(scope="module")
def model(options):
    return create("segearth-ov", **options)


def test_a_label_and_scores_a_pixel(model):
    for prediction in model.predict(IMAGES, scores=True):
        assert (prediction.labels.dtype, prediction.labels.shape) == (np.uint8, (48, 80))
        assert prediction.labels.max() < 7
        assert (prediction.scores.dtype, prediction.scores.shape) == (np.float32, (48, 80, 7))
        np.testing.assert_allclose(prediction.scores.sum(axis=2), 1, atol=1e-5)
        decided = prediction.labels != 0
        np.testing.assert_array_equal(prediction.scores.argmax(axis=2)[decided], prediction.labels[decided])


@torch.inference_mode()
def test_text_features_are_means_over_sentences(clip, tmp_path):
    file = tmp_path / "prompts.yaml"
    file.write_text(yaml.safe_dump({"classes": ["car, van", "tree"], "templates": ["a {}.", "one big {}"]}))
    model = create("segearth-ov", checkpoint=str(tiny("clip")), prompts=file)
    tokenizer = AutoTokenizer.from_pretrained(tiny("clip"))
    for row, name in zip(model.queries, ("car", "van", "tree"), strict=True):
        features = []
        for sentence in (f"a {name}.", f"one big {name}"):
            found = clip.get_text_features(**tokenizer([sentence], return_tensors="pt")).pooler_output[0]
            features.append(found / found.norm())
        mean = sum(features) / 2
        torch.testing.assert_close(row, mean / mean.norm(), atol=1e-5, rtol=1e-4)


def test_the_likeliest_name_of_a_class_counts_and_unlikely_pixels_are_background(monkeypatch, tmp_path):
    file = tmp_path / "prompts.yaml"
    names = {"classes": ["ground", "car, van", "tree"], "background": "ground", "prob_threshold": 0.5}
    file.write_text(yaml.safe_dump(names))
    model = create("segearth-ov", checkpoint=str(tiny("clip")), prompts=file, resize=32, sharpness=1.0)
    probability = torch.tensor([[0.1, 0.2, 0.6, 0.1], [0.3, 0.25, 0.2, 0.25], [0.1, 0.3, 0.0, 0.6]])  # car, car, tree

    def window_logits(window):
        """The left third of the image shows the first row, and so on."""
        column = torch.linspace(0, 2.999, window.shape[2]).long()
        return probability.log().clamp(min=-30)[column].T[:, None].expand(4, window.shape[1], -1)

    monkeypatch.setattr(model, "window_logits", window_logits)
    (prediction,) = model.predict([np.zeros((32, 32, 3), dtype=np.uint8)], scores=True)
    labels, scores = prediction.labels[0], prediction.scores[0]
    assert labels[[2, 16, 29]].tolist() == [1, 0, 2]
    np.testing.assert_allclose(scores[2], np.array([0.1, 0.6, 0.1]) / 0.8, atol=1e-5)
    np.testing.assert_allclose(scores[29], np.array([0.1, 0.3, 0.6]) / 1.0, atol=1e-5)


@torch.inference_mode()
def test_logits_are_cosines_with_the_images_own_taken_off(clip):
    model = create("segearth-ov", checkpoint=str(tiny("clip")), bias=-0.3)
    window = random(3, 32, 32)
    whole, patches = dense_features(clip, window[None])
    found = model.window_logits(window)
    assert found.shape == (7, 32, 32)
    expected = np.zeros((7, 4, 4))
    for q, query in enumerate(model.queries):
        for y in range(4):
            for x in range(4):
                patch = patches[0, :, y, x]
                expected[q, y, x] = query @ patch / patch.norm() - 0.3 * (query @ whole[0] / whole[0].norm())
    upsampled = torch.nn.functional.interpolate(torch.from_numpy(expected)[None], size=(32, 32), mode="bilinear")[0]
    torch.testing.assert_close(found.double(), upsampled, atol=1e-5, rtol=1e-4)


def test_with_simfeatup(tmp_path):
    checkpoint(tmp_path / "jbu_one.ckpt")
    options = {"checkpoint": str(tiny("clip")), "resize": 48}
    plain, sharp = (
        create("segearth-ov", **options),
        create("segearth-ov", **options, upsampler=tmp_path / "jbu_one.ckpt"),
    )
    assert plain.identity()["upsampler"] == "bilinear"
    assert len(sharp.identity()["upsampler"]) == 32
    a, b = (model.predict(IMAGES[:1], scores=True)[0].scores for model in (plain, sharp))
    assert a.shape == b.shape == (48, 80, 7)
    assert np.abs(a - b).max() > 0.01


def test_a_stride_that_leaves_gaps_is_refused():
    with pytest.raises(ConfigError, match="stride 40 leaves gaps between windows of 32 pixels"):
        create("segearth-ov", checkpoint=str(tiny("clip")), stride=40)


@pytest.mark.parametrize("option", [{"resize": 40}, {"bias": 0.0}, {"stride": 8}])
def test_identity_has_the_settings(option):
    usual, other = (create("segearth-ov", checkpoint=str(tiny("clip")), **more).identity() for more in ({}, option))
    assert usual != other
