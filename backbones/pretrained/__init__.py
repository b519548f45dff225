"""Checkpoints of transformers for segmentation: found, loaded whole, asked for labels and scores."""
