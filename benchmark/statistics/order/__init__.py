"""What the order of observations adds: drift of places, and other rules to fuse by."""
