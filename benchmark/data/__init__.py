"""Frames, and what they become: label spaces, voxel tables, measures, and the results that are reported."""
