"""Compiled loops, and their keys of cells of voxels: three voxel indices of BITS each, then three digits of 2 bits."""

CELLS = 4
"""Cells along a voxel's edge."""

DIGITS = 6
"""Bits of a key that number the cell in its voxel."""

BITS = 19
"""Bits of a voxel's index along an axis, from the voxel on at which keys begin."""

SPAN = 1 << BITS
SHIFTS = DIGITS + 2 * BITS, DIGITS + BITS, DIGITS
WITHIN = 4, 2, 0
"""Bits of a key at which the three voxel indices begin, and the three digits."""
