"""What is done to the pixels of a frame: what moves is left out, noise is added, one frame is warped into another."""
