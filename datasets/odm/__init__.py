"""Projects of OpenDroneMap, and of OpenSfM, with depth from whatever surface or depth maps they have.

Sources: opendronemap.org (docs, Outputs); opensfm.org; the folders of real projects.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field

from semstab.datasets.files.frame_source import FrameSource
from semstab.datasets.files.label_source import ScenePlace
from semstab.datasets.files.options import DepthKind, FileOptions, PoseConvention, UpAxis
from semstab.datasets.files.reader import FileDataset
from semstab.datasets.files.scene import FileScene
from semstab.datasets.files.templates import Template
from semstab.datasets.formats.disk import natural, subfolders
from semstab.datasets.odm.georeference import GEOREFERENCING, georeference_of
from semstab.datasets.odm.project import (
    DISTORTED,
    LOOK_FOR,
    PLACES,
    UNDISTORTED,
    Images,
    Kind,
    Project,
    depth_files,
    find_project,
    frame_names,
    written_names,
)
from semstab.datasets.odm.reconstruction import Shot, read_reconstruction
from semstab.errors import DataError
from semstab.model.georeference import Georeference


class OdmOptions(FileOptions):
    """What the project says, and may be said otherwise."""

    depth_from: Kind | None = Field(
        None,
        description="mesh, dsm, mve, openmvs, or files (option depth); the first of them that the project has where not"
        " given",
    )
    depth: str = Field("depth/{name}", description="template of depth files in the project")
    images: Path | None = Field(
        None, description="folder of the images that the poses are of, where it is not in the project"
    )
    labels_on: Literal["undistorted", "original"] | None = Field(
        None,
        description="the images that labels were predicted on: undistorted ones or original photographs; those that the"
        " poses are of where not given",
    )
    reconstruction: int | None = Field(None, ge=0, description="which of several reconstructions, counted from 0")
    depth_kind: DepthKind = None
    pose_convention: PoseConvention = "world_to_camera"
    up_axis: UpAxis = "z"


class Odm(FileDataset[OdmOptions]):
    """{name} is the photograph's name without the suffixes: DJI_0018 of DJI_0018.JPG and of DJI_0018.JPG.tif.

    Label maps may have the suffixes, too: DJI_0018.JPG.png. The parts of a split project, submodels/submodel_NNNN, are
    scenes of their own.
    """

    Options: type[BaseModel] = OdmOptions
    looks_like = f"opensfm/{UNDISTORTED} or opensfm/{DISTORTED}, which is there once a project is reconstructed"

    def __init__(self, options: OdmOptions) -> None:
        self._depth = Template("depth", options.depth, ("name",), ("name",))
        self._read: dict[Path, list[Shot]] = {}
        super().__init__(options)

    def find_scenes(self, root: Path) -> Iterator[ScenePlace]:
        """The projects, and the submodels of each beside it."""
        for place in super().find_scenes(root):
            yield place
            parts = place.folder / "submodels"
            for name in subfolders(parts):
                if self.is_scene(parts / name):
                    below = f"{place.below_root}/submodels/{name}"
                    yield ScenePlace(f"{place.name}-submodels-{name}", parts / name, below)

    def is_scene(self, folder: Path) -> bool:
        """Whether there is a reconstruction."""
        return find_project(folder) is not None

    def settled(self, folder: Path) -> OdmOptions:
        """The options with the source of depth that the project has.

        Raises DataError where it has none, or not the one that is asked for.
        """
        options = self.options
        if options.surface is not None:
            return options.model_copy(update={"depth_kind": options.depth_kind or "planar"})
        project = self._project(folder)
        kinds = [options.depth_from] if options.depth_from else list(LOOK_FOR)
        for kind in kinds:
            if (found := LOOK_FOR[kind](project, options.depth)) is not None:
                surface = found if kind in ("mesh", "dsm") else None
                along = options.depth_kind or ("ray" if kind == "mve" else "planar")
                return options.model_copy(update={"surface": surface, "depth_from": kind, "depth_kind": along})
        raise DataError(
            f"{folder}: has no depth: no {', '.join(kinds)} ({'; '.join(PLACES[kind] for kind in kinds)}); set surface"
            " to a mesh, cloud or raster"
        )

    def scene(self, name: str) -> FileScene:
        """Open one; it says where its depth comes from."""
        scene = super().scene(name)
        kind = self.settled(scene.folder).depth_from
        scene.depth_from = f"{kind}, {scene.depth_from or PLACES[kind]}" if kind is not None else scene.depth_from
        return scene

    def georeference(self, folder: Path, options: FileOptions) -> Georeference | None:
        """What the options say, else the project's coords.txt and proj.txt, else OpenSfM's reference."""
        if options.crs is not None:
            return super().georeference(folder, options)
        project = self._project(folder)
        T_cw = [shot.T_cw for shot in self._shots(project.poses)]
        return georeference_of(folder / GEOREFERENCING, project.opensfm, T_cw)

    def frames(self, folder: Path) -> list[FrameSource]:
        """One a shot, in the natural order of their names. Raises what `read_reconstruction` raises."""
        project = self._project(folder)
        shots = self._shots(project.poses)
        names = frame_names(shot.name for shot in shots)
        kind = self.settled(folder).depth_from
        depth = depth_files(
            project, kind, {shot.name: name for shot, name in zip(shots, names, strict=True)}, self._depth
        )
        originals = self._originals(project)
        look = Images(project, self.options.images)
        frames = [
            self._frame(project, look, shot, name, depth[shot.name], originals.get(name))
            for shot, name in zip(shots, names, strict=True)
        ]
        return sorted(frames, key=lambda frame: natural(frame.name))

    def _frame(
        self, project: Project, look: Images, shot: Shot, name: str, depth: Path, original: Shot | None
    ) -> FrameSource:
        color, photograph = look.color(shot.name), look.photograph(shot.name)
        wanted = self.options.labels_on or ("undistorted" if project.undistorted else "original")
        lens = shot.lens
        if wanted == "original" and project.undistorted:
            if original is None:
                raise DataError(
                    f"{project.opensfm / DISTORTED}: does not say how the photograph {name} is distorted, which"
                    " labels_on: original needs"
                )
            lens = original.lens
        return FrameSource(
            name=name,
            depth=depth,
            pose=shot.T_cw,
            pose_file=project.poses,
            camera=shot.camera,
            color=color,
            color_lens=shot.lens,
            label_lens=lens if wanted == "original" else None,
            photograph=photograph if project.undistorted else color,
            aliases=written_names(shot.name),
        )

    def _originals(self, project: Project) -> dict[str, Shot]:
        """The shots with the cameras of the photographs, by the frames' names, where they are asked for."""
        path = project.opensfm / DISTORTED
        if self.options.labels_on != "original" or not project.undistorted or not path.is_file():
            return {}
        shots = self._shots(path)
        return dict(zip(frame_names(shot.name for shot in shots), shots, strict=True))

    def _shots(self, path: Path) -> list[Shot]:
        if path not in self._read:
            self._read[path] = read_reconstruction(path, self.options.reconstruction)
        return self._read[path]

    def _project(self, folder: Path) -> Project:
        project = find_project(folder)
        assert project is not None
        return project
