"""Models of a few thousand random weights, saved to a folder as a pretrained one is: the real loading code runs."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from transformers import (
    CLIPConfig,
    CLIPModel,
    CLIPTokenizer,
    SamConfig,
    SamImageProcessorPil,
    SamModel,
    SegformerConfig,
    SegformerForSemanticSegmentation,
    SegformerImageProcessorPil,
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
