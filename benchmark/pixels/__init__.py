"""Changes of a frame's pixels: dynamic objects are left out, noise is added, one frame is warped into another."""
