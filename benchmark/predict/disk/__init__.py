"""Predictions on disk: a sequence in, label maps, scores or regions out, with what they depend on beside them."""
