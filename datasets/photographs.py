"""Photographs whose cameras a photogrammetry program has computed: what its readers share.

A reader returns shots: names, poses, cameras and lenses. Depth comes from the surface that the program exported, a mesh
or a height model, or from depth images; images are those that the cameras are of, distorted ones are undistorted.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar

import numpy as np
from pydantic import Field

from semstab.core.types import Float64
from semstab.data.georeference import INSTALL, Georeference, wkt
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Folders, FrameSource, Template, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.files.surfaces import SEEN_FROM_ABOVE
from semstab.datasets.formats.disk import natural
from semstab.datasets.formats.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from semstab.datasets.geometry.cameras import Camera, Poses
from semstab.datasets.geometry.lenses import Lens
from semstab.errors import DataError, MissingDependencyError, summarize_error

PHOTO_SUFFIXES = (".JPG", ".jpg", ".JPEG", ".jpeg", ".png", ".PNG", ".tif", ".TIF", ".tiff", ".TIFF")
ADDED_SUFFIXES = ("", ".tif", ".jpg", ".png")
"""The suffixes that ODM appends to the name of an undistorted image."""


def bare_name(shot: str) -> str:
    """Return a shot's name without the suffixes of images: DJI_0018 of DJI_0018.JPG.tif."""
    while Path(shot).suffix and Path(shot).suffix in PHOTO_SUFFIXES:
        shot = shot[: -len(Path(shot).suffix)]
    return shot


def written_names(shot: str) -> tuple[str, ...]:
    """Return the names that files of a shot may have: its own, and without and with any suffixes."""
    bare = bare_name(shot)
    names = (f"{bare}{suffix}{added}" for suffix in PHOTO_SUFFIXES for added in ADDED_SUFFIXES)
    return tuple(dict.fromkeys((shot, *(f"{shot}{added}" for added in ADDED_SUFFIXES), bare, *names)))


def frame_names(shots: Iterable[str]) -> list[str]:
    """Return the frames' names: the shots' without suffixes, or as they are where these would not differ."""
    names = list(shots)
    bare = [bare_name(name) for name in names]
    return bare if len(set(bare)) == len(names) else names


def find_image(folders: Iterable[Path], shot: str, contents: Folders, where: str) -> Path | None:
    """Return the image of a shot in the first folder that has one; `where` is the file that names the shot."""
    for folder in folders:
        for written in written_names(shot):
            path = inside(folder, folder, written, where)
            if path.suffix.lower() in COLOR_SUFFIXES and contents.has(path):
                return path
    return None


SURFACES = (".ply", ".obj", ".tif", ".tiff", ".las", ".laz")


@dataclass(frozen=True, eq=False)
class Shot:
    """One photograph: its name, its pose (4, 4), its camera without distortion, and its lens.

    Attributes:
        pose: In the convention of the dataset's options.
        lens: Lens of the photograph, or None without distortion.
    """

    name: str
    pose: Poses
    camera: Camera
    lens: Lens | None


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The shots that a file holds, and the georeference of their coordinates, if known.

    Attributes:
        mesh_origin: Where meshes that the program exports count from, in the projection; None: as the shots do.
    """

    file: Path
    shots: Sequence[Shot]
    georeference: Georeference | None = None
    mesh_origin: tuple[float, float, float] | None = None


class PosedImageOptions(FileOptions):
    """Options of photographs that a program has posed."""

    images: Path | None = Field(None, description="folder of the posed images, if not the usual one")
    depth: str = Field("depth/{name}", description="template of depth files in the scene's folder")
    labels_on: Literal["undistorted", "original"] | None = Field(
        None, description="images that labels were predicted on; by default the posed ones"
    )
    up_axis: opt.UpAxis = "z"


class PhotographOptions(PosedImageOptions):
    """Options of photographs and a file of their cameras."""

    cameras: str | None = Field(None, description="file of the cameras in the scene's folder; found by default")
    mesh_origin: opt.Offset = Field(
        None, description="[east, north, up] in crs from which the mesh's coordinates count, if it was exported shifted"
    )


Options = TypeVar("Options", bound=PhotographOptions)


class Photographs(FileDataset[Options], Generic[Options]):
    """{name} is the photograph's name without its suffix: DJI_0018. Label maps may have it, too: DJI_0018.JPG.png.

    Attributes:
        patterns: Where the file of the cameras may be in a scene's folder.
    """

    patterns: tuple[str, ...]

    def __init__(self, options: Options) -> None:
        self._depth = Template("depth", options.depth, ("name",), ("name",))
        self._read: dict[Path, Reconstruction] = {}
        super().__init__(options)

    @abstractmethod
    def has_cameras(self, path: Path) -> bool:
        """Return whether a file is one of cameras, by its first lines."""

    @abstractmethod
    def reconstruction(self, path: Path, folder: Path) -> Reconstruction:
        """Read the file of the cameras of a scene's folder. Raises DataError for what it cannot be."""

    def is_scene(self, folder: Path) -> bool:
        """Return whether there is a file of cameras."""
        return self._file(folder) is not None

    def settled(self, folder: Path) -> Options:
        """Return the options, with the only mesh of the folder as surface where nothing else gives depth.

        Raises:
            DataError: If there is none, or several.
        """
        options = self.options
        if options.surface is not None or (folder / self._depth.text).parent.is_dir():
            return options
        surfaces = sorted(path for path in folder.glob("*") if path.suffix.lower() in SURFACES)
        meshes = [path for path in surfaces if path.suffix.lower() not in SEEN_FROM_ABOVE]
        if len(meshes) != 1:
            listed = f" (here are {', '.join(path.name for path in surfaces[:5])})" if surfaces else ""
            raise DataError(
                f"{folder}: has no depth images; set surface to the mesh, cloud or height model that was"
                f" exported: --option surface=FILE{listed}"
            )
        return options.model_copy(update={"surface": meshes[0]})

    def georeference(self, folder: Path, options: FileOptions) -> Georeference | None:
        """Return the georeference that the options or the cameras' files give."""
        return self._reconstruction(folder).georeference or super().georeference(folder, options)

    def mesh_origin(self, folder: Path, surface: Path) -> tuple[float, float, float] | None:
        """Return the origin of a mesh's coordinates in the projection, or None if they are the shots' coordinates."""
        return self.options.mesh_origin or self._reconstruction(folder).mesh_origin

    def frames(self, folder: Path) -> list[FrameSource]:
        """Return a frame for each shot, in natural order of names. Raises what `reconstruction` raises."""
        reconstruction, contents = self._reconstruction(folder), Folders()
        where, frames = str(reconstruction.file), []
        images = self.image_folders(folder)
        names = frame_names(shot.name for shot in reconstruction.shots)
        if repeated := next((name for name in names if names.count(name) > 1), None):
            raise DataError(f"{where}: two photographs are called {repeated[:80]!r}; rename one")
        for shot, name in zip(reconstruction.shots, names, strict=True):
            color = find_image(images, shot.name, contents, where) or inside(images[0], images[0], shot.name, where)
            original = self.options.labels_on != "undistorted" and shot.lens is not None
            depth = inside(folder, folder, self._depth.filled(name=name), where)
            frames.append(
                FrameSource(
                    name=name, depth=contents.one_of(depth, DEPTH_SUFFIXES) or depth, pose=shot.pose,
                    pose_file=reconstruction.file, camera=shot.camera, color=color, color_lens=shot.lens,
                    label_lens=shot.lens if original else None, photograph=color, aliases=written_names(shot.name),
                )
            )  # fmt: skip
        return sorted(frames, key=lambda frame: natural(frame.name))

    def image_folders(self, folder: Path) -> Sequence[Path]:
        """Return the folders in which the images of a scene are sought."""
        return [folder / "images" if self.options.images is None else self.options.images, folder]

    def _reconstruction(self, folder: Path) -> Reconstruction:
        if folder not in self._read:
            path = self._file(folder)
            assert path is not None
            self._read[folder] = self.reconstruction(path, folder)
        return self._read[folder]

    def _file(self, folder: Path) -> Path | None:
        """Return the file of the cameras in a folder; of several the one that the options name."""
        if self.options.cameras is not None:
            path = inside(self.options.root, folder, self.options.cameras, "option cameras")
            return path if path.is_file() else None
        matches = [path for pattern in self.patterns for path in sorted(folder.glob(pattern)) if self.has_cameras(path)]
        if len(matches) > 1:
            listed = ", ".join(path.name for path in matches[:5])
            raise DataError(f"{folder}: several files hold cameras ({listed}); name one: --option cameras=FILE")
        return matches[0] if matches else None


# Coordinates that count from the Earth's centre, brought into a projection.

WGS84 = 4326
STEP = 100.0
"""Metres over which the axes of the projection are measured."""


def from_geocentric(poses: Float64, crs: str, wanted: str | None, where: str) -> tuple[Float64, Georeference]:
    """Return camera-to-world poses (n, 4, 4) in a projection, less whole metres, and its georeference.

    Args:
        poses: (n, 4, 4) in metres from the Earth's centre, x to the meridian of Greenwich, z to the north pole.
        crs: Reference system on whose ellipsoid they are: geographic or projected, in any words that pyproj reads.
        wanted: Projection; by default `crs` if it is a projection, else the zone of UTM of the first camera.
        where: File, for messages.

    Raises:
        DataError: For a reference system that is not known, or cameras that are nowhere in it.
        ConfigError, MissingDependencyError: As `wkt` does.
    """
    try:
        from pyproj import CRS, Transformer
        from pyproj.exceptions import CRSError, ProjError
    except ImportError as error:
        raise MissingDependencyError(
            f"{where}: its coordinates are geocentric, which needs pyproj; {INSTALL}"
        ) from error
    try:
        stated = CRS.from_user_input(crs)
    except (CRSError, RecursionError) as error:
        raise DataError(f"{where}: {crs[:60]!r} is no reference system ({summarize_error(error)})") from error
    geodetic = stated.geodetic_crs
    if geodetic is None or geodetic.ellipsoid is None:
        raise DataError(f"{where}: {stated.name} is no reference system of the Earth; set crs: EPSG:NUMBER")
    axes = f"+a={geodetic.ellipsoid.semi_major_metre!r} +b={geodetic.ellipsoid.semi_minor_metre!r}"
    steps = f"+step +inv +proj=cart {axes} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    down = Transformer.from_pipeline(f"+proj=pipeline {steps}")
    longitude, latitude = down.transform(*poses[0, :3, 3])[:2]
    zone, south = int((longitude + 180) // 6) % 60 + 1, latitude < 0
    utm = f"+proj=utm +zone={zone} {'+south ' * south}{axes} +units=m +no_defs +type=crs"
    if geodetic.to_epsg() == WGS84:
        utm = f"EPSG:{(32700 if south else 32600) + zone}"
    wanted = wanted or (crs if stated.is_projected else utm)
    onto = Transformer.from_crs(geodetic, CRS.from_user_input(wkt(wanted, where)), always_xy=True)

    def projected(points: Float64) -> Float64:
        try:
            result = np.stack(onto.transform(*down.transform(*points.T), errcheck=True), axis=1)
        except ProjError as error:
            raise DataError(f"{where}: its cameras are nowhere in {wanted[:60]!r} ({error}); set crs") from error
        return np.asarray(result, dtype=np.float64)

    centres = projected(poses[:, :3, 3])
    offset = np.floor(centres.mean(axis=0))
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[:, :3, 3] = centres - offset
    for k, pose in enumerate(poses):
        ends = projected(pose[:3, 3] + STEP / 2 * np.concatenate([np.eye(3), -np.eye(3)]))
        u, _, v = np.linalg.svd((ends[:3] - ends[3:]).T / STEP)  # the nearest rotation to the projection's derivative
        result[k, :3, :3] = u @ v @ pose[:3, :3]
    return result, Georeference.from_crs(wanted, tuple(offset.tolist()), where)
