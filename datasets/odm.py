"""Projects of OpenDroneMap, and of OpenSfM, with depth from whatever surface or depth maps they have.

Sources: opendronemap.org (docs, Outputs); opensfm.org; the folders of real projects.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field

from semstab.core.files import open_file
from semstab.data.georeference import Georeference
from semstab.datasets.exported_cameras import bundle_distorts, read_bundle, read_nvm
from semstab.datasets.files import options as opt
from semstab.datasets.files.depth import HEADER_BYTES, dmap_header
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import FileOptions, Folders, FrameSource, Template, inside
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.files.scene import FileScene
from semstab.datasets.formats.disk import natural, records, subfolders
from semstab.datasets.formats.images import DEPTH_SUFFIXES, color_size
from semstab.datasets.geometry.lenses import Lens
from semstab.datasets.opensfm import read_reconstruction
from semstab.datasets.photographs import PosedImageOptions, Shot, bare_name, find_image, frame_names, written_names
from semstab.datasets.placing import Placement, Positions, placement_of
from semstab.errors import DataError

# The files of a project of OpenDroneMap or OpenSfM: its poses, images, surfaces and depth maps, and their names.

UNDISTORTED = "undistorted/reconstruction.json"
DISTORTED = "reconstruction.json"
NVM = ("undistorted/reconstruction.nvm", "reconstruction.nvm")
BUNDLES = ("bundler/bundle*.out", "bundle*.out")
"""Files that OpenSfM exports, for a project without reconstruction.json."""

MESHES = (
    "odm_meshing/odm_mesh.ply", "odm_meshing/odm_25dmesh.ply", "odm_texturing*/odm_textured_model_geo.obj",
    "odm_texturing*/*_geo.obj",
)  # fmt: skip
GEOREFERENCED = "odm_texturing*/*_geo.obj"
DSM = "odm_dem/dsm.tif"
VIEWS = "mve/views"
DMAPS = "undistorted/openmvs/depthmaps"

NPZ_MAPS = ("undistorted/depthmaps", "depthmaps")
"""Folders of OpenSfM's depth maps in opensfm/; the last one is that of versions before 0.5."""

NPZ_SUFFIXES = (".clean.npz", ".raw.npz")
"""Suffixes of OpenSfM's own depth maps; depth maps that were checked against their neighbours come first."""

Kind = Literal["mesh", "dsm", "mve", "openmvs", "opensfm", "files"]


@dataclass(frozen=True)
class Project:
    """The parts of a project: its folder, the folder of OpenSfM in it, and the file of its poses.

    Attributes:
        undistorted: Whether the poses are of undistorted images.
    """

    folder: Path
    opensfm: Path
    poses: Path
    undistorted: bool


def find_project(folder: Path, wanted: int | None = None) -> Project | None:
    """Return the project in a folder, of OpenDroneMap or of OpenSfM, or None without a reconstruction.

    Of several bundles, the bundle with the number `wanted` is taken, else the first bundle.
    """
    for opensfm in (folder / "opensfm", folder):
        for name in (UNDISTORTED, DISTORTED, *NVM):
            if (opensfm / name).is_file():
                return Project(folder, opensfm, opensfm / name, name != DISTORTED)
        if bundles := find_bundles(opensfm):
            poses = bundles[min(wanted or 0, len(bundles) - 1)]
            return Project(folder, opensfm, poses, _of_undistorted(poses, opensfm))
    return None


def find_bundles(opensfm: Path) -> list[Path]:
    """Return the bundles of a folder of OpenSfM, one a reconstruction, in their order."""
    matches = (sorted(opensfm.glob(pattern)) for pattern in BUNDLES)
    return next((paths for paths in matches if paths), [])


def _of_undistorted(bundle: Path, opensfm: Path) -> bool:
    """Return whether a bundle is of undistorted images: it may be of either, and says so by what distorts alone."""
    try:
        return (opensfm / "undistorted").is_dir() and not bundle_distorts(bundle)
    except DataError:  # raised where the poses are read
        return False


def photographs_of(project: Project) -> list[Path]:
    """Return the folders in which the photographs of a project are sought."""
    return [project.folder / "images", project.opensfm / "images"]


# --- depth ----------------------------------------------------------------------------------------------------------


LOCATIONS: dict[Kind, str] = {
    "mesh": "odm_meshing/odm_mesh.ply, odm_25dmesh.ply, odm_texturing*/*_geo.obj",
    "dsm": DSM,
    "mve": "mve/views/view_NNNN.mve/depth-L0.mvei",
    "openmvs": "opensfm/undistorted/openmvs/depthmaps/*.dmap",
    "opensfm": "opensfm/undistorted/depthmaps/NAME.clean.npz, NAME.raw.npz (or opensfm/depthmaps)",
    "files": "depth/NAME.png",
}
"""Sources of depth and their paths; the first of them that a project has is taken."""


def find_depth(project: Project, kind: Kind, template: str) -> Path | None:
    """Return the file or folder of a source of depth, or None without this source; `template` names depth files."""
    if kind == "mesh":
        return next((path for pattern in MESHES for path in sorted(project.folder.glob(pattern))), None)
    if kind == "mve":
        return next(iter(sorted(project.folder.glob("mve/views/*/depth-L0.mvei"))), None)
    if kind == "openmvs":
        return next(iter(sorted((project.opensfm / DMAPS).glob("*.dmap"))), None)
    if kind == "opensfm":
        return _npz_maps(project) if project.undistorted else None
    path = project.folder / DSM if kind == "dsm" else (project.folder / template).parent
    exists = path.is_file() if kind == "dsm" else "{" not in str(path) and path.is_dir()
    return path if exists else None


def depth_files(project: Project, kind: Kind | None, names: Mapping[str, str], template: Template) -> dict[str, Path]:
    """Return the depth map, even if missing, of each shot by its name; `names` maps names of shots to frames' names."""
    if kind == "mve":
        return _mve_files(project.folder / VIEWS, names)
    if kind == "openmvs":
        maps, folder = {}, project.opensfm / DMAPS
        for path in sorted(folder.glob("*.dmap")):  # each names the image that it belongs to
            with open_file(path) as file:
                image = dmap_header(path, file.read(HEADER_BYTES)).image
            maps[bare_name(Path(image.replace("\\", "/")).name)] = path
        return {shot: maps.get(name, folder / f"{name}.dmap") for shot, name in names.items()}
    folders = Folders()
    if kind == "opensfm":
        maps_of = _npz_maps(project) or project.opensfm / NPZ_MAPS[0]
        candidates = {
            shot: [maps_of / f"{name}{suffix}" for suffix in NPZ_SUFFIXES for name in written_names(shot)]
            for shot in names
        }
        return {shot: next(filter(folders.has, paths), paths[0]) for shot, paths in candidates.items()}
    expected = {shot: project.folder / template.filled(name=name) for shot, name in names.items()}
    return {shot: folders.one_of(path, DEPTH_SUFFIXES) or path for shot, path in expected.items()}


def _npz_maps(project: Project) -> Path | None:
    """Return the folder of OpenSfM's depth maps, or None without depth maps."""
    folders = (project.opensfm / name for name in NPZ_MAPS)
    with_maps = (maps for maps in folders if any(True for suffix in NPZ_SUFFIXES for _ in maps.glob(f"*{suffix}")))
    return next(with_maps, None)


def _mve_files(views: Path, names: Mapping[str, str]) -> dict[str, Path]:
    """Return the depth map of each shot by the image that its view names, or else by the view's number.

    MVE calls a view after its image, or '0007' after its own number, which then counts shots.

    Raises:
        DataError: If views name images, but none of a shot.
    """
    by_name: dict[str, Path] = {}
    numbers: set[str] = set()
    for view in sorted(views.glob("view_*.mve")):
        number = view.stem.removeprefix("view_")
        view_name = _view_name(view / "meta.ini") or number
        by_name[bare_name(view_name)] = view / "depth-L0.mvei"
        if view_name.isdigit() and int(view_name) == int(number or 0):
            numbers.add(view_name)
    bare_names = {shot: bare_name(name) for shot, name in names.items()}
    if not by_name.keys() & set(bare_names.values()):
        if by_name.keys() - numbers:
            raise DataError(
                f"{views}: the views are called {', '.join(sorted(by_name)[:3])} in their meta.ini, which no shot of"
                f" the reconstruction is ({', '.join(sorted(bare_names.values())[:3])}); take depth_from: mesh"
            )
        return {shot: views / f"view_{k:04d}.mve/depth-L0.mvei" for k, shot in enumerate(names)}
    return {shot: by_name.get(name, views / f"{name}.mve/depth-L0.mvei") for shot, name in bare_names.items()}


def _view_name(path: Path) -> str | None:
    """Return the name in the part [view] of a meta.ini, or None without a name."""
    lines = [text for _, text in records(path)] if path.is_file() else []
    start = lines.index("[view]") + 1 if "[view]" in lines else len(lines)
    part = itertools.takewhile(lambda line: not line.startswith("["), lines[start:])
    settings = (line.partition("=") for line in part)
    return next((value.strip() for key, _, value in settings if key.strip() == "name" and value.strip()), None)


class OdmOptions(PosedImageOptions):
    """Options with the defaults of the project."""

    depth_from: Kind | None = Field(None, description="source of depth; by default the first that the project has")
    reconstruction: int | None = Field(None, ge=0, description="which of several reconstructions, counted from 0")
    depth_kind: opt.DepthKind = None
    pose_convention: opt.PoseConvention = "world_to_camera"


class Odm(FileDataset[OdmOptions]):
    """{name} is the photograph's name without the suffixes: DJI_0018 of DJI_0018.JPG and of DJI_0018.JPG.tif.

    Label maps may have the suffixes, too: DJI_0018.JPG.png. The parts of a split project, submodels/submodel_NNNN, are
    scenes of their own.
    """

    Options: type[BaseModel] = OdmOptions
    contents = (
        f"opensfm/{UNDISTORTED} or opensfm/{DISTORTED}, which is there once a project is reconstructed, or its export"
        " reconstruction.nvm or bundle_r000.out"
    )

    def __init__(self, options: OdmOptions) -> None:
        self._depth = Template("depth", options.depth, ("name",), ("name",))
        self._read: dict[Path, list[Shot]] = {}
        self._placements: dict[Path, Placement | None] = {}
        super().__init__(options)

    def find_scenes(self, root: Path) -> Iterator[SceneEntry]:
        """Yield the projects, and the submodels of each after it."""
        for entry in super().find_scenes(root):
            yield entry
            parts = entry.folder / "submodels"
            for name in subfolders(parts):
                if self.is_scene(parts / name):
                    below = f"{entry.below_root}/submodels/{name}"
                    yield SceneEntry(f"{entry.name}-submodels-{name}", parts / name, below)

    def is_scene(self, folder: Path) -> bool:
        """Return whether there is a reconstruction."""
        return find_project(folder) is not None

    def settled(self, folder: Path) -> OdmOptions:
        """Return the options with the source of depth that the project has.

        Raises:
            DataError: If it has none, or not the one that is asked for.
        """
        options = self.options
        if options.surface is not None:
            return options.model_copy(update={"depth_kind": options.depth_kind or "planar"})
        project = self._project(folder)
        kinds = [options.depth_from] if options.depth_from else list(LOCATIONS)
        for kind in kinds:
            if (source := find_depth(project, kind, options.depth)) is not None:
                surface = source if kind in ("mesh", "dsm") else None
                along = options.depth_kind or ("ray" if kind == "mve" else "planar")
                return options.model_copy(update={"surface": surface, "depth_from": kind, "depth_kind": along})
        raise DataError(
            f"{folder}: has no depth: no {', '.join(kinds)} ({'; '.join(LOCATIONS[kind] for kind in kinds)}); set"
            " surface to a mesh, cloud or raster"
        )

    def scene(self, name: str) -> FileScene:
        """Open one; it names the source of its depth."""
        scene = super().scene(name)
        kind = self.settled(scene.folder).depth_from
        scene.depth_from = f"{kind}, {scene.depth_from or LOCATIONS[kind]}" if kind is not None else scene.depth_from
        placement = None if self.options.crs is not None else self._placement(scene.folder)
        scene.placed = None if placement is None else placement.words
        return scene

    def georeference(self, folder: Path, options: FileOptions) -> Georeference | None:
        """Return the reference of the options, else that of `placement_of` from the project's files."""
        if options.crs is not None:
            return super().georeference(folder, options)
        placement = self._placement(folder)
        return None if placement is None else placement.georeference

    def mesh_origin(self, folder: Path, surface: Path) -> tuple[float, float, float] | None:
        """Return the origin of ODM's georeferenced meshes in a project whose poses are not in the projection."""
        placement = None if self.options.crs is not None else self._placement(folder)
        georeferenced = any(surface == path for path in folder.glob(GEOREFERENCED))
        return placement.mesh_origin if placement is not None and georeferenced else None

    def _placement(self, folder: Path) -> Placement | None:
        if folder not in self._placements:
            project = self._project(folder)
            shots = {bare_name(shot.name): shot.pose for shot in self._shots_of(project)}
            names = {bare_name(shot.name): shot.name for shot in self._shots_of(project)}
            photographs, contents = photographs_of(project), Folders()
            if self.options.images is not None:
                photographs.append(self.options.images)

            def photograph(name: str) -> Path | None:
                return find_image(photographs, names[name], contents, str(project.poses))

            self._placements[folder] = placement_of(folder, project.opensfm, shots, Positions(bare_name, photograph))
        return self._placements[folder]

    def frames(self, folder: Path) -> list[FrameSource]:
        """Return a frame for each shot, in natural order of names.

        Raises:
            DataError: For a damaged file of poses, several reconstructions without a setting that selects one, or a
                missing image whose size is needed.
        """
        project = self._project(folder)
        shots, contents, where = self._shots_of(project), Folders(), str(project.poses)
        if project.undistorted and (shot := next((shot for shot in shots if shot.lens is not None), None)) is not None:
            raise DataError(
                f"{where}: the camera of {shot.name[:80]} distorts, but these should be undistorted images; run ODM"
                " again from opensfm, or remove the file to take the photographs of reconstruction.json"
            )
        names = frame_names(shot.name for shot in shots)
        by_shot = {shot.name: name for shot, name in zip(shots, names, strict=True)}
        depth = depth_files(project, self.settled(folder).depth_from, by_shot, self._depth)
        lenses = self._label_lenses(project, dict(zip(names, shots, strict=True)))
        photographs, images = photographs_of(project), self._images(project)
        frames = []
        for shot, name in zip(shots, names, strict=True):
            color = find_image(images, shot.name, contents, where) or inside(images[0], images[0], shot.name, where)
            frames.append(
                FrameSource(
                    name=name, depth=depth[shot.name], pose=shot.pose, pose_file=project.poses, camera=shot.camera,
                    color=color, color_lens=shot.lens, label_lens=lenses.get(name),
                    photograph=find_image(photographs, shot.name, contents, where) if project.undistorted else color,
                    aliases=written_names(shot.name),
                )
            )  # fmt: skip
        return sorted(frames, key=lambda frame: natural(frame.name))

    def _label_lenses(self, project: Project, shots: Mapping[str, Shot]) -> dict[str, Lens | None]:
        """Return the lens of the photograph that a frame's label map belongs to, where they belong to photographs."""
        if (self.options.labels_on or ("undistorted" if project.undistorted else "original")) != "original":
            return {}
        if project.undistorted:
            path = project.opensfm / DISTORTED
            originals = self._reconstruction(path) if path.is_file() else []
            shots_by_name = dict(zip(frame_names(shot.name for shot in originals), originals, strict=True))
            if lost := next((name for name in shots if name not in shots_by_name), None):
                raise DataError(
                    f"{path}: does not give the distortion of the photograph {lost}, which labels_on: original needs"
                )
            shots = shots_by_name
        return {name: shot.lens for name, shot in shots.items()}

    def _images(self, project: Project) -> list[Path]:
        """Return the folders in which the posed images of a project are sought."""
        if self.options.images is not None:
            return [self.options.images]
        undistorted = [project.opensfm / "undistorted/images", project.opensfm / "undistorted"]
        return undistorted if project.undistorted else photographs_of(project)

    def _shots_of(self, project: Project) -> list[Shot]:
        if project.poses.suffix == ".json":
            return self._reconstruction(project.poses)
        if project.poses not in self._read:
            self._read[project.poses] = self._exported(project)
        return self._read[project.poses]

    def _reconstruction(self, path: Path) -> list[Shot]:
        if path not in self._read:
            self._read[path] = read_reconstruction(path, self.options.reconstruction)
        return self._read[path]

    def _exported(self, project: Project) -> list[Shot]:
        """Read a project's reconstruction.nvm or bundle, and the sizes of its images."""
        path, chosen, images, contents = project.poses, self.options.reconstruction, self._images(project), Folders()
        bundles = find_bundles(project.opensfm) if path.suffix == ".out" else []
        if len(bundles) > 1 and chosen is None:
            raise DataError(
                f"{path}: one of {len(bundles)} reconstructions, which share no coordinates; choose one with"
                " reconstruction: NUMBER"
            )
        if (chosen or 0) >= max(len(bundles), 1):
            raise DataError(
                f"{path}: there is no reconstruction {chosen}; it has {max(len(bundles), 1)}, counted from 0"
            )

        def size_of(name: str) -> tuple[int, int]:
            image = find_image(images, name, contents, str(path))
            if image is None:
                raise DataError(
                    f"{path}: the image {name[:80]!r}, whose size the file does not say, is not in {images[0]}; set"
                    " images: FOLDER"
                )
            return color_size(image)

        return (read_bundle if bundles else read_nvm)(path, size_of)

    def _project(self, folder: Path) -> Project:
        project = find_project(folder, self.options.reconstruction)
        assert project is not None
        return project
