"""From pixels to runs of one voxel and label: keys, words, tiles, and the merging of what they hold."""
