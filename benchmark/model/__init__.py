"""What a scene's frames become: frames, label spaces, voxel tables, measures, and the results that are reported."""
