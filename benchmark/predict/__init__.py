"""Running segmentation models: over a sequence to label maps on disk, or inside a run with nothing on disk."""
