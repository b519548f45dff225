"""The files of a project of OpenDroneMap or OpenSfM: its poses, images, surfaces and depth maps, and their names."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from semstab.datasets.files.templates import Folders, Template, inside
from semstab.datasets.formats.dense_depth import HEADER_BYTES, dmap_header
from semstab.datasets.formats.images import COLOR_SUFFIXES, DEPTH_SUFFIXES
from semstab.runtime.files import open_file

UNDISTORTED = "undistorted/reconstruction.json"
DISTORTED = "reconstruction.json"

MESHES = (
    "odm_meshing/odm_mesh.ply", "odm_meshing/odm_25dmesh.ply", "odm_texturing*/odm_textured_model_geo.obj",
    "odm_texturing*/*_geo.obj",
)  # fmt: skip
DSM = "odm_dem/dsm.tif"
MVE = "mve/views/view_{:04d}.mve/depth-L0.mvei"
DMAPS = "openmvs/depthmaps"

Kind = Literal["mesh", "dsm", "mve", "openmvs", "files"]


@dataclass(frozen=True)
class Project:
    """The parts of a project: its folder, that of OpenSfM in it, and the file of its poses."""

    folder: Path
    opensfm: Path
    poses: Path

    @property
    def undistorted(self) -> bool:
        """Whether the poses are of undistorted images."""
        return self.poses == self.opensfm / UNDISTORTED


def find_project(folder: Path) -> Project | None:
    """The project in a folder, of OpenDroneMap or of OpenSfM; None where nothing is reconstructed."""
    for opensfm in (folder / "opensfm", folder):
        for poses in (opensfm / UNDISTORTED, opensfm / DISTORTED):
            if poses.is_file():
                return Project(folder, opensfm, poses)
    return None


# --- names and images -----------------------------------------------------------------------------------------------


PHOTO_SUFFIXES = (".JPG", ".jpg", ".JPEG", ".jpeg", ".png", ".PNG", ".tif", ".TIF", ".tiff", ".TIFF")
ADDED_SUFFIXES = ("", ".tif", ".jpg", ".png")
"""What ODM appends to the name of an undistorted image."""


def bare_name(shot: str) -> str:
    """A shot's name without the suffixes of images: DJI_0018 of DJI_0018.JPG.tif."""
    while Path(shot).suffix and Path(shot).suffix in PHOTO_SUFFIXES:
        shot = shot[: -len(Path(shot).suffix)]
    return shot


def written_names(shot: str) -> tuple[str, ...]:
    """The names that files of a shot may have: its own, and without and with any suffixes."""
    bare = bare_name(shot)
    names = (f"{bare}{suffix}{added}" for suffix in PHOTO_SUFFIXES for added in ADDED_SUFFIXES)
    return tuple(dict.fromkeys((shot, *(f"{shot}{added}" for added in ADDED_SUFFIXES), bare, *names)))


def frame_names(shots: Iterable[str]) -> list[str]:
    """The frames' names: the shots' without suffixes, or as they are where these would not differ."""
    names = list(shots)
    bare = [bare_name(name) for name in names]
    return bare if len(set(bare)) == len(names) else names


class Images:
    """The files of a project's images, by the names that ODM and OpenSfM give them; `stated` is where they are else."""

    def __init__(self, project: Project, stated: Path | None) -> None:
        self._folders = Folders()
        self._project = project
        self._photographs = [project.folder / "images", project.opensfm / "images"]
        own = [project.opensfm / "undistorted/images"] if project.undistorted else self._photographs
        self._own = own if stated is None else [stated]

    def color(self, shot: str) -> Path | None:
        """The image that the shot's pose is of."""
        return self._first(self._own, shot)

    def photograph(self, shot: str) -> Path | None:
        """The photograph that it was made of."""
        return self._first(self._photographs, shot)

    def _first(self, places: Iterable[Path], shot: str) -> Path | None:
        for place in places:
            for written in written_names(shot):
                path = inside(place, place, written, str(self._project.poses))
                if path.suffix.lower() in COLOR_SUFFIXES and self._folders.has(path):
                    return path
        return None


# --- depth ----------------------------------------------------------------------------------------------------------


def _mesh(project: Project, _: str) -> Path | None:
    return next((path for pattern in MESHES for path in sorted(project.folder.glob(pattern))), None)


def _dsm(project: Project, _: str) -> Path | None:
    path = project.folder / DSM
    return path if path.is_file() else None


def _mve(project: Project, _: str) -> Path | None:
    return next(iter(sorted(project.folder.glob("mve/views/*/depth-L0.mvei"))), None)


def _openmvs(project: Project, _: str) -> Path | None:
    return next(iter(_dmap_files(project)), None)


def _files(project: Project, template: str) -> Path | None:
    folder = (project.folder / template).parent
    return folder if "{" not in str(folder) and folder.is_dir() else None


LOOK_FOR: dict[Kind, Callable[[Project, str], Path | None]] = {
    "mesh": _mesh, "dsm": _dsm, "mve": _mve, "openmvs": _openmvs, "files": _files,
}  # fmt: skip
"""By source of depth what finds it in a project, with the template of depth files; the one taken first in front."""

PLACES: dict[Kind, str] = {
    "mesh": "odm_meshing/odm_mesh.ply, odm_25dmesh.ply, odm_texturing*/*_geo.obj",
    "dsm": DSM,
    "mve": "mve/views/view_NNNN.mve/depth-L0.mvei",
    "openmvs": "opensfm/undistorted/openmvs/depthmaps/*.dmap",
    "files": "depth/NAME.png",
}


def _dmap_files(project: Project) -> list[Path]:
    return sorted((project.opensfm / "undistorted" / DMAPS).glob("*.dmap"))


def _depth_maps(project: Project) -> dict[str, Path]:
    """Depth maps of OpenMVS by the name of the frame that each says it is of."""
    found = {}
    for path in _dmap_files(project):
        with open_file(path) as file:
            image = dmap_header(path, file.read(HEADER_BYTES)).image
        found[bare_name(Path(image.replace("\\", "/")).name)] = path
    return found


def depth_files(project: Project, kind: Kind | None, names: Mapping[str, str], template: Template) -> dict[str, Path]:
    """The depth map that each shot has, or would have, by its name; `names` are the frames' by those of their shots."""
    if kind == "mve":
        return {shot: project.folder / MVE.format(k) for k, shot in enumerate(names)}
    if kind == "openmvs":
        maps, folder = _depth_maps(project), project.opensfm / "undistorted" / DMAPS
        return {shot: maps.get(name, folder / f"{name}.dmap") for shot, name in names.items()}
    folders = Folders()
    wanted = {shot: project.folder / template.filled(name=name) for shot, name in names.items()}
    return {shot: folders.one_of(path, DEPTH_SUFFIXES) or path for shot, path in wanted.items()}
