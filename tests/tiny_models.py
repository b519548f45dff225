"""Models of a few thousand random weights, saved to a folder as a pretrained one is: the real loading code runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from transformers import (
    CLIPConfig,
    CLIPImageProcessorPil,
    CLIPModel,
    CLIPSegConfig,
    CLIPSegForImageSegmentation,
    CLIPTokenizer,
    Data2VecVisionConfig,
    Data2VecVisionForSemanticSegmentation,
    DetrConfig,
    DPTConfig,
    DPTForSemanticSegmentation,
    DPTImageProcessorPil,
    EomtConfig,
    EomtForUniversalSegmentation,
    EomtImageProcessorPil,
    Mask2FormerConfig,
    Mask2FormerForUniversalSegmentation,
    Mask2FormerImageProcessorPil,
    MaskFormerConfig,
    MaskFormerForInstanceSegmentation,
    MaskFormerImageProcessorPil,
    OneFormerConfig,
    OneFormerForUniversalSegmentation,
    OneFormerImageProcessorPil,
    Sam2Config,
    Sam2Model,
    SamConfig,
    SamHQConfig,
    SamHQModel,
    SamImageProcessorPil,
    SamModel,
    SegformerConfig,
    SegformerForSemanticSegmentation,
    SegformerImageProcessorPil,
    SwinConfig,
)
from transformers.utils import logging

CITYSCAPES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain",
    "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle",
)  # fmt: skip


def segformer(folder: Path, classes: tuple[str, ...] = ("building ", "road", "tree", "car"), side: int = 64) -> Path:
    """A SegFormer whose labels change over an image; one class name has a space too many, as real ones have."""
    torch.manual_seed(0)
    config = SegformerConfig(
        num_encoder_blocks=4,
        depths=[1, 1, 1, 1],
        hidden_sizes=[8, 16, 24, 32],
        num_attention_heads=[1, 2, 3, 4],
        decoder_hidden_size=16,
        initializer_range=0.5,
        id2label=dict(enumerate(classes)),
        label2id={name: k for k, name in enumerate(classes)},
    )
    model = SegformerForSemanticSegmentation(config).eval()
    with torch.no_grad():  # no class wins everywhere
        mean = model(pixel_values=torch.randn(4, 3, 64, 96)).logits.mean(dim=(0, 2, 3))
        model.decode_head.classifier.bias -= mean
    _save(model, folder)
    SegformerImageProcessorPil(size={"height": side, "width": side}).save_pretrained(folder)
    return folder


def sam(folder: Path) -> Path:
    """A SAM for images of 64 pixels that rates its masks about 0.5; its default initialisation ignores the image."""
    torch.manual_seed(0)
    config = SamConfig(
        vision_config={
            "hidden_size": 16,
            "output_channels": 16,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "image_size": 64,
            "patch_size": 8,
            "mlp_dim": 32,
            "num_pos_feats": 8,
            "window_size": 4,
            "global_attn_indexes": [1],
        },
        prompt_encoder_config={
            "hidden_size": 16,
            "image_size": 64,
            "patch_size": 8,
            "mask_input_channels": 4,
        },
        mask_decoder_config={
            "hidden_size": 16,
            "mlp_dim": 32,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "attention_downsample_rate": 2,
            "iou_head_hidden_dim": 16,
            "iou_head_depth": 2,
        },
    )
    model = SamModel(config)
    for name, parameter in model.named_parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=0.2 if name.startswith("vision_encoder") else 0.4)
    torch.nn.init.constant_(model.mask_decoder.iou_prediction_head.proj_out.bias, 0.5)
    _save(model, folder)
    SamImageProcessorPil(
        size={"longest_edge": 64}, pad_size={"height": 64, "width": 64}, mask_size={"longest_edge": 16}
    ).save_pretrained(folder)
    return folder


def clip(folder: Path) -> Path:
    """A CLIP for images of 32 pixels in patches of 8, with a tokenizer of single bytes."""
    torch.manual_seed(0)
    shared = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 3, "num_attention_heads": 2}
    ids = {"bos_token_id": 512, "eos_token_id": 513, "pad_token_id": 513}
    config = CLIPConfig(
        text_config={**shared, "vocab_size": 514, "max_position_embeddings": 77, **ids},
        vision_config={**shared, "image_size": 32, "patch_size": 8},
        projection_dim=12,
    )
    model = CLIPModel(config)
    for parameter in model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=0.3)
    _save(model, folder)
    tokenizer().save_pretrained(folder)
    return folder


NAMES = {k: f"class {k}" for k in range(4)}

SWIN = {
    "image_size": 64,
    "embed_dim": 8,
    "depths": [1, 1, 1, 1],
    "num_heads": [1, 1, 1, 1],
    "window_size": 4,
    "out_features": ["stage1", "stage2", "stage3", "stage4"],
}
SIZE = {"shortest_edge": 64, "longest_edge": 128}


def mask2former(folder: Path) -> Path:
    """Five queries for four classes."""
    config = Mask2FormerConfig(
        backbone_config=SwinConfig(**SWIN), feature_size=32, mask_feature_size=32, hidden_dim=32,
        encoder_feedforward_dim=16, dim_feedforward=16, encoder_layers=1, decoder_layers=2, num_attention_heads=2,
        num_queries=5, id2label=NAMES,
    )  # fmt: skip
    return _random(Mask2FormerForUniversalSegmentation, config, Mask2FormerImageProcessorPil(size=SIZE), folder)


def maskformer(folder: Path) -> Path:
    """Five queries for four classes."""
    decoder = DetrConfig(
        encoder_layers=1, decoder_layers=1, d_model=16, encoder_ffn_dim=16, decoder_ffn_dim=16,
        encoder_attention_heads=2, decoder_attention_heads=2, num_queries=5,
    )  # fmt: skip
    config = MaskFormerConfig(
        backbone_config=SwinConfig(**SWIN), decoder_config=decoder, fpn_feature_size=32, mask_feature_size=32,
        id2label=NAMES,
    )  # fmt: skip
    return _random(MaskFormerForInstanceSegmentation, config, MaskFormerImageProcessorPil(size=SIZE), folder)


def oneformer(folder: Path) -> Path:
    """Five queries for four classes; its preprocessing names a file of the hub, as real ones do."""
    config = OneFormerConfig(
        backbone_config=SwinConfig(**SWIN), num_queries=5, hidden_dim=32, mask_dim=32, conv_dim=32,
        encoder_feedforward_dim=16, encoder_layers=1, decoder_layers=2, dim_feedforward=16, num_attention_heads=2,
        task_seq_len=24, text_encoder_width=32, text_encoder_context_length=24, text_encoder_num_layers=1,
        text_encoder_vocab_size=514, text_encoder_n_ctx=4, id2label=NAMES,
    )  # fmt: skip
    _random(OneFormerForUniversalSegmentation, config, OneFormerImageProcessorPil(size=SIZE), folder, seed=4)
    file = folder / "preprocessor_config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"class_info_file": "ade20k_panoptic.json"}))
    tokenizer().save_pretrained(folder)
    return folder


def eomt(folder: Path) -> Path:
    """Five queries for four classes; an image is seen in square windows."""
    config = EomtConfig(
        hidden_size=16, num_hidden_layers=3, num_attention_heads=2, image_size=64, patch_size=8, num_blocks=1,
        num_queries=5, num_upscale_blocks=1, num_register_tokens=1, id2label=NAMES,
    )  # fmt: skip
    processor = EomtImageProcessorPil(size={"shortest_edge": 64, "longest_edge": None}, do_split_image=True)
    return _random(EomtForUniversalSegmentation, config, processor, folder)


def clipseg(folder: Path) -> Path:
    """Sees squares of 32 pixels."""
    shared = {"hidden_size": 16, "intermediate_size": 16, "num_attention_heads": 2}
    ids = {"bos_token_id": 512, "eos_token_id": 513, "pad_token_id": 513}
    config = CLIPSegConfig(
        text_config={**shared, "num_hidden_layers": 2, "vocab_size": 514, "max_position_embeddings": 77, **ids},
        vision_config={**shared, "num_hidden_layers": 4, "image_size": 32, "patch_size": 8},
        projection_dim=16, reduce_dim=8, decoder_num_attention_heads=2, decoder_intermediate_size=16,
        extract_layers=[1, 2, 3],
    )  # fmt: skip
    square = {"height": 32, "width": 32}
    _random(CLIPSegForImageSegmentation, config, CLIPImageProcessorPil(size=square, do_center_crop=False), folder)
    tokenizer().save_pretrained(folder)
    return folder


VIT = {"hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2, "intermediate_size": 32, "image_size": 64}


def dpt(folder: Path) -> Path:
    """Sees squares."""
    config = DPTConfig(
        **VIT, backbone_out_indices=[0, 1, 2, 3], neck_hidden_sizes=[16, 16, 16, 16], fusion_hidden_size=16,
        use_auxiliary_head=False, id2label=NAMES,
    )  # fmt: skip
    processor = DPTImageProcessorPil(size={"height": 64, "width": 64}, keep_aspect_ratio=True)
    return _random(DPTForSemanticSegmentation, config, processor, folder)


def data2vec(folder: Path) -> Path:
    """Sees squares of 64 pixels."""
    config = Data2VecVisionConfig(
        **VIT, out_indices=[1, 2, 3, 4], use_auxiliary_head=False, pool_scales=[1, 2],
        use_relative_position_bias=True, id2label=NAMES,
    )  # fmt: skip
    processor = SegformerImageProcessorPil(size={"height": 64, "width": 64})
    return _random(Data2VecVisionForSemanticSegmentation, config, processor, folder)


def sam_hq(folder: Path) -> Path:
    """A SAM-HQ like `sam`."""
    config = SamConfig.from_pretrained(sam(folder)).to_dict()
    decoder = {**config["mask_decoder_config"], "vit_dim": 16}
    parts = {key: config[key] for key in ("vision_config", "prompt_encoder_config")}
    for part in (decoder, *parts.values()):
        part.pop("model_type")
    return _random(SamHQModel, SamHQConfig(**parts, mask_decoder_config=decoder), None, folder)


def sam2(folder: Path) -> Path:
    """Sees squares of 64 pixels; without preprocessing, which needs torchvision to be written."""
    trunk = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "num_attention_heads": 1, "image_size": [64, 64],
        "blocks_per_stage": [1, 1, 2, 1], "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 1, 1, 1], "global_attention_blocks": [3],
        "window_positional_embedding_background_size": [4, 4],
    }  # fmt: skip
    vision = {
        "backbone_config": trunk, "backbone_channel_list": [64, 32, 16, 8],
        "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]], "fpn_hidden_size": 16,
    }  # fmt: skip
    decoder = {
        "hidden_size": 16, "mlp_dim": 16, "num_hidden_layers": 2, "num_attention_heads": 2,
        "attention_downsample_rate": 2, "iou_head_depth": 2, "iou_head_hidden_dim": 16,
    }  # fmt: skip
    prompts = {"hidden_size": 16, "image_size": 64, "patch_size": 16, "mask_input_channels": 4}
    config = Sam2Config(vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=decoder)
    return _random(Sam2Model, config, None, folder)


def _random(cls: Any, config: Any, processor: Any, folder: Path, seed: int = 0) -> Path:
    """A model whose answers change over an image."""
    torch.manual_seed(seed)
    model = cls(config)
    for parameter in model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=0.3)
    _save(model, folder)
    if processor is not None:
        processor.save_pretrained(folder)
    return folder


def tokenizer() -> CLIPTokenizer:
    """Of the 256 symbols that stand for bytes, each also at the end of a word, and two special ones."""
    from transformers.convert_slow_tokenizer import bytes_to_unicode

    symbols = list(bytes_to_unicode().values())
    names = [*symbols, *(f"{symbol}</w>" for symbol in symbols), "<|startoftext|>", "<|endoftext|>"]
    return CLIPTokenizer(vocab={name: k for k, name in enumerate(names)}, merges=[])


def _save(model: torch.nn.Module, folder: Path) -> None:
    logging.disable_progress_bar()
    model.save_pretrained(folder)


def set_processor(folder: Path, kind: str, **settings: object) -> None:
    """Let the preprocessing be of another kind, as other or older checkpoints name it."""
    file = folder / "preprocessor_config.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"image_processor_type": kind, **settings}))
