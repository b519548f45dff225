"""Write the rerun recording of a run while it is fused. Only this package imports rerun.

Entities, all below the scene's name:

- `camera`, `camera/color`: Transform3D and Pinhole; EncodedImage (JPEG)
- `camera/MODEL/labels`: SegmentationImage: classes
- `camera/MODEL/contradictions`: SegmentationImage: labels that are not the dominant class of the map before the frame
- `camera/MODEL/drift`: SegmentationImage: drift that the frame caused at each pixel's voxel. A Transform3D spreads each
  picture over the camera's image
- `camera/MODEL/labels/points`, `.../contradictions/points`, `.../drift/points`: Points3D, instead of these pictures, of
  a scan; it has no Pinhole
- `depth`, `trajectory`: DepthImage; LineStrips3D
- `map/MODEL/BACKEND/CHUNK`: VoxelGridMap, coloured by class; components category:colors, op:values and KEY:values of
  each measure, which the views map to its own
- `series/NAME/MODEL/BACKEND`: Scalars: a series of `SERIES`
- `flips/MODEL/voxel_N`: StateChange: the dominant class of the voxels that drifted most
- `flips_report/MODEL`, `flips_at/...`: TextDocument: the top contributing frames; Points3D: positions of those voxels
- `camera/MODEL/flips`: Points2D: those voxels in the frame, where their numbers lie inside its image
- `difference/MODEL/A and B/PART`: VoxelGridMap: voxels where two backends differ
- `difference_report/MODEL/A and B`: TextDocument: the number of these voxels
- `verdict`: TextDocument: the answer of the run, and the verdict of each model
- `categories`: Points2D: the stability categories and their colours
- `legend`, `all_classes`: Points2D: the classes and their colours, those with the most voxels first
- `log`: TextLog: each unit's final numbers

and in the recording of a comparison

- `change/RUN/agreement`, `.../truth`: VoxelGridMap: the loss or gain of each voxel that changed
- `change/RUN/.../same`, `.../locations`: Points3D: the other voxels; the locations that got worse, with their numbers

and in the recording of other programs' maps

- `maps/NAME/difference`, `.../map`, `.../run`: VoxelGridMap: where the maps differ, and the classes of both
- `maps/NAME/difference/places`: Points3D: the largest places where they differ
"""

from semstab.recording.layout import record_changes
from semstab.recording.observer import Recording, lacks_pictures, record_finished
from semstab.recording.target import Target, viewer_command
from semstab.recording.timeline import SERIES
from semstab.recording.voxel_maps import color_modes

__all__ = [
    "SERIES", "Recording", "Target", "color_modes", "lacks_pictures", "record_changes",
    "record_finished", "viewer_command",
]  # fmt: skip
