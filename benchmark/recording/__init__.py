"""The rerun recording of a run, written while it goes on. Only this package imports rerun.

Entities, all below the scene's name:

camera, camera/color                    Transform3D and Pinhole; EncodedImage (JPEG)
camera/BACKBONE/labels, .../drift       SegmentationImage: classes; drift that the frame caused at each pixel's voxel.
                                        Smaller ones have a Transform3D, which spreads them over the camera's image
depth, trajectory                       DepthImage; LineStrips3D
map/BACKBONE/BACKEND/CHUNK              VoxelGridMap, coloured by class; components category:colors, op:values
                                        and KEY:values of each measure, which the views map to its own
series/NAME/BACKBONE/BACKEND            Scalars: a series of `SERIES`
flips/BACKBONE/voxel_N                  StateChange: the dominant class of the voxels that drifted most
flips_report/BACKBONE, flips_at/...     TextDocument: the frames that moved them; Points3D: where those voxels are
camera/BACKBONE/flips                   Points2D: those voxels in the frame, where their numbers lie inside its image
difference/BACKBONE/A and B/PART        VoxelGridMap: voxels where two backends differ
difference_report/BACKBONE/A and B      TextDocument: how many they are
legend, all_classes                     Points2D: the classes in use and their colours
drift_legend                            SegmentationImage: the levels of drift
log                                     TextLog: each unit's final numbers

and in the recording of a comparison

change/RUN/agreement, .../truth         VoxelGridMap: what each voxel that changed lost or gained
change/RUN/.../same, .../places         Points3D: the other voxels; the places that got worse, with their numbers
"""

from semstab.recording.observer import Recording
from semstab.recording.series import SERIES
from semstab.recording.target import Target
from semstab.recording.voxel_maps import looks

__all__ = ["SERIES", "Recording", "Target", "looks"]
