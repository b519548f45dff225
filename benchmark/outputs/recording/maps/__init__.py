"""What a recording shows of a map: its voxels by measure, its classes, what drifted, flipped and differs."""
