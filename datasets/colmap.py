"""COLMAP reconstructions with depth maps: a dense workspace (images/, sparse/, stereo/depth_maps/), or one like it.

Sources: Schönberger and Frahm, Structure-from-Motion Revisited, CVPR 2016; colmap.github.io/format.html.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, Field

from semstab.datasets.files.frame_source import FrameSource
from semstab.datasets.files.options import FileOptions, Folders, PixelCentre, PoseConvention, Template, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.formats.colmap_model import has_model, image_name, read_model
from semstab.datasets.formats.images import DEPTH_SUFFIXES

MODEL_FOLDERS = ("sparse", "sparse/0", ".")


class ColmapOptions(FileOptions):
    """What the format says, and may be said otherwise."""

    pose_convention: PoseConvention = "world_to_camera"
    pixel_centre: PixelCentre = 0.5
    model: str | None = Field(
        None, description="folder of the sparse model in the scene's; sparse, sparse/0 or the scene's own by default"
    )
    images: str = Field("images", description="folder of the (undistorted) images in the scene's")
    depth: str = Field(
        "stereo/depth_maps/{image}.geometric.bin",
        description="template of depth maps: {image} is the image's name in the model, {name} the same without suffix",
    )


class Colmap(FileDataset[ColmapOptions]):
    """{name} is the image's name in the model without suffix: 0012, or cam0/0012.

    Depth maps in .bin files are in the model's unit, others in metres, unless depth_scale says so; with
    metres_per_unit both become metric.
    """

    Options: type[BaseModel] = ColmapOptions
    looks_like = "a sparse model (cameras and images, .bin or .txt) in sparse/, and depth maps"

    def __init__(self, options: ColmapOptions) -> None:
        self._depth = Template("depth", options.depth, ("image", "name"))
        super().__init__(options)

    def is_scene(self, folder: Path) -> bool:
        """Whether there is a sparse model."""
        return self._model(folder) is not None

    def frames(self, folder: Path) -> list[FrameSource]:
        """One a registered image. Raises what `read_model` raises."""
        options, folders = self.options, Folders()
        model = self._model(folder)
        assert model is not None
        path, images = read_model(model)
        frames = []
        for image in images:
            name = image_name(image.name)
            wanted = inside(options.root, folder, self._depth.filled(image=image.name, name=name), str(path))
            depth = folders.one_of(wanted, (*DEPTH_SUFFIXES, ".bin")) or wanted
            color = inside(options.root, folder, f"{options.images}/{image.name}", str(path))
            frames.append(
                FrameSource(
                    name=name,
                    depth=depth,
                    pose=image.T_cw,
                    pose_file=path,
                    camera=image.camera,
                    color=color if folders.has(color) else None,
                    depth_scale=1 / (options.metres_per_unit or 1.0) if depth.suffix == ".bin" else None,
                )
            )
        return frames

    def _model(self, folder: Path) -> Path | None:
        names = MODEL_FOLDERS if self.options.model is None else (self.options.model,)
        candidates = (inside(self.options.root, folder, name, "option model") for name in names)
        return next((candidate for candidate in candidates if has_model(candidate)), None)
