"""CLIP as a dense feature extractor: its last block lets each patch look at its like (Li et al. 2025, CVPR)."""

from __future__ import annotations

from typing import Any

import torch


def dense_features(model: Any, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Features in the space that images and texts share, not normalised: (N, D) of the image, (N, D, h, w) of patches.

    model   a transformers CLIPModel in evaluation mode
    pixels  (N, 3, H, W) normalised; H and W are multiples of the patch size

    All blocks but the last are CLIP's own. The last one is `self_self_attention` of its first layer norm's output, with
    neither residual nor MLP.
    """
    vision = model.vision_model
    patch, native = vision.config.patch_size, vision.config.image_size
    h, w = pixels.shape[-2] // patch, pixels.shape[-1] // patch
    other_size = pixels.shape[-2:] != (native, native)
    hidden = vision.pre_layrnorm(vision.embeddings(pixels, interpolate_pos_encoding=other_size))
    *layers, last = vision.encoder.layers
    for layer in layers:
        hidden = layer(hidden, attention_mask=None)
    tokens = self_self_attention(last.self_attn, last.layer_norm1(hidden))
    tokens = model.visual_projection(vision.post_layernorm(tokens))
    return tokens[:, 0], tokens[:, 1:].transpose(1, 2).unflatten(2, (h, w))


def self_self_attention(attention: Any, tokens: torch.Tensor) -> torch.Tensor:
    """(N, T, D): out_proj of (softmax(q q^T) + softmax(k k^T) + softmax(v v^T)) v, each product by sqrt(d), every head.

    attention  a transformers CLIPAttention
    """
    q, k, v = (_heads(project(tokens), attention) for project in (attention.q_proj, attention.k_proj, attention.v_proj))
    like_q, like_k, like_v = (torch.softmax(x @ x.mT * attention.scale, dim=-1) for x in (q, k, v))
    mixed = (like_q + like_k + like_v) @ v
    out: torch.Tensor = attention.out_proj(mixed.transpose(1, 2).flatten(2))
    return out


def _heads(x: torch.Tensor, attention: Any) -> torch.Tensor:
    """(N, T, D) to (N, heads, T, D / heads)."""
    return x.view(*x.shape[:2], attention.num_heads, attention.head_dim).transpose(1, 2)
