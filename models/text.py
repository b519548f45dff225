"""Embeddings of names by a text encoder of transformers, such as CLIP's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import nn
from transformers import AutoModel, AutoTokenizer

from semstab.core.types import Float32
from semstab.errors import DataError
from semstab.models.checkpoint import Checkpoint, ModelOptions


@torch.inference_mode()
def text_embeddings(checkpoint: str, names: Sequence[str], templates: Sequence[str]) -> Float32:
    """Return (n, D) float32: of each name the normalised mean of the normalised features of its sentences.

    Args:
        checkpoint: A folder that save_pretrained wrote, or an id on the hub, of a model with text features.
        names: Names.
        templates: Sentences, in which {} stands for the name.

    Raises:
        DataError: If the model has no text features, and what loading a checkpoint raises.
    """
    options = ModelOptions(checkpoint=checkpoint)
    files = Checkpoint.find(options)
    model, tokenizer = files.load_model(AutoModel, options), files.load(AutoTokenizer)
    if not hasattr(model, "get_text_features"):
        raise DataError(f"{checkpoint}: a {type(model).__name__} has no text features; choose CLIP, SigLIP or the like")
    embeddings = []
    for name in names:
        sentences = [template.replace("{}", name) for template in templates]
        tokens = tokenizer(sentences, padding=True, truncation=True, return_tensors="pt")
        output = model.get_text_features(**tokens)
        sentence_features = nn.functional.normalize(getattr(output, "pooler_output", output), dim=-1)
        embeddings.append(nn.functional.normalize(sentence_features.mean(dim=0), dim=-1))
    return np.asarray(torch.stack(embeddings).float().numpy(), np.float32)
