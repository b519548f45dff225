"""Several backbones beside each other: on the same places, by the same looks."""
