"""SegEarth-OV, and what it is made of."""
