"""What fusion leaves behind: one row a voxel, and the log of observations from which that row can be computed again."""

from semstab.model.voxels.columns import index_columns
from semstab.model.voxels.events import Events
from semstab.model.voxels.table import VoxelTable

__all__ = ["Events", "VoxelTable", "index_columns"]
