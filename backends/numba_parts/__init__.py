"""What the numba backend is made of: the records of its map, the loops over them, and the log of observations."""
