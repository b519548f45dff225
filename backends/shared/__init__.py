"""What several backends share, from the pixels of a frame to the report of it.

association             a frame's observations in numpy: all that a backend in pure Python needs, with `total`
total                   what a frame did to a map, the map's totals, and the report made of both
keys                    voxel indices packed into one integer that counts from a map's origin
aggregator              a frame's observations by compiled loops: pixel_keys, entries, merging
columns                 the compiled update of dense columns
hashing, beliefs        what the compiled loops call
"""
