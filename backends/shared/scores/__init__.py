"""From soft scores to sums by voxel: one pass over the scores, in vectors."""
