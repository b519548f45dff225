"""Code that several backends share, from the pixels of a frame to the report of it.

- `association`: a frame's observations in numpy: all that a backend in pure Python needs, with `observations`
- `observations`: the evidence of a frame for voxels, its change of a map, the map's totals, and the report made of both
- `keys`: voxel indices packed into one integer that counts from a map's origin
- `aggregator`: a frame's observations by compiled loops: tile_loops, merge_loops (labels) and score_loops (soft scores)
- `columns`: the compiled update of dense columns
- `beliefs`: entropy and Jensen-Shannon divergence in compiled loops
"""
