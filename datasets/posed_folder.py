"""Posed images in plain folders: depth/, pose/, labels/BACKBONE/, scores/BACKBONE/, intrinsics.txt, scene.yaml."""

from __future__ import annotations

import hashlib
import json
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from semstab.datasets import disk
from semstab.datasets.images import MILLIMETRES, read_color, read_depth, read_labels, read_mask, read_scores
from semstab.datasets.ray_depth import planar
from semstab.datasets.same_view import Labels, Scores, fitted
from semstab.datasets.scene_files import LABEL_SPACE_FILE, FrameFiles, SceneFiles, listed, nearest, scene_folders
from semstab.datasets.scene_settings import CAMERA_AXES, SETTINGS_FILE, UP_AXES, SceneSettings, read_settings
from semstab.datasets.text_files import read_intrinsics, read_pose
from semstab.errors import ConfigError, DataError
from semstab.frames import Frame, Intrinsics
from semstab.labels import LabelSpace


class PosedFolder:
    """Scene folders under a root, or one that is the root itself.

    Raises DataError where there is no scene.
    """

    class Options(SceneSettings):
        """Where the scenes are, what to do with incomplete frames, and overrides of scene.yaml."""

        root: Path = Field(description="a scene folder, or a folder that contains scene folders")
        incomplete: Literal["error", "skip"] = Field(
            "error", description="a frame without depth, pose or labels is an error, or is left out with a warning"
        )

    def __init__(self, options: Options) -> None:
        self.options = options
        self._folders = scene_folders(options.root)

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scene folders, in natural order."""
        return tuple(self._folders)

    def scene(self, name: str) -> PosedScene:
        """Open one. Raises ConfigError for a name that is not there, and what `PosedScene` raises."""
        return PosedScene(name, self._folder(name), self.options)

    def images(self, name: str) -> PosedScene:
        """Open one for prediction: its frames have colour, whatever label maps there are or lack."""
        return PosedScene(name, self._folder(name), self.options, needs="color")

    def _folder(self, name: str) -> Path:
        if name not in self._folders:
            raise ConfigError(f"{self.options.root}: scene '{name}' is not there; {nearest(name, self._folders)}")
        return self._folders[name]


class PosedScene:
    """One scene folder; opening it lists folders and reads scene.yaml and intrinsics.txt, but no image.

    needs  what a frame must have beside depth and pose: labels of every backbone, or colour

    Raises ConfigError for settings that cannot be used, DataError for missing files.
    """

    labels_like_depth = True
    """Its label maps have the depth's pixels, whatever size the colour images have."""

    def __init__(
        self,
        name: str,
        folder: Path,
        options: PosedFolder.Options,
        needs: Literal["labels", "color"] = "labels",
    ) -> None:
        self.name = name
        self.folder = folder
        self.settings = read_settings(folder, options)
        self._files = SceneFiles(folder)
        self._intrinsics = read_intrinsics(folder / "intrinsics.txt")
        self._names = self._files.complete(options.incomplete, needs)
        self.backbones = tuple(self._files.sources)
        self.regions = tuple(self._files.regions)
        self.ground_truth = self._files.ground_truth is not None
        up = self.settings.up_axis
        self._digests: dict[Path, bytes] = {}
        self._spaces: dict[str, LabelSpace | None] = {}
        self.up: npt.NDArray[np.float64] | None = np.array(UP_AXES[up], dtype=np.float64) if up else None

    def __len__(self) -> int:
        """Number of frames: names that have depth, a pose, and labels of every backbone."""
        return len(self._names)

    def label_space(self, backbone: str) -> LabelSpace:
        """The classes of the backbone's own label_space.yaml, else those of the scene.

        Raises DataError where none of them says any, ConfigError where there is no such backbone, or it has none.
        """
        if backbone in self.regions:
            raise ConfigError(f"{self.folder}: '{backbone}' holds regions without classes, which cannot be fused")
        space = self._space_of(backbone)
        if space is None:
            raise DataError(
                f"{self.folder / SETTINGS_FILE}: the classes are not known; set 'classes: [name, ...]' in id order,"
                f" or 'taxonomy: NAME', or put a {LABEL_SPACE_FILE} into {self._files.source(backbone).folder}"
            )
        return space

    def frame(self, index: int, backbone: str, *, color: bool = True) -> Frame:
        """Frame 0 <= index < len with that backbone's labels or scores, and colour where there is any and it is wanted.

        Raises DataError that names the file, ConfigError where there is no such frame or backbone.
        """
        files = self._frame_files(index, backbone)
        depth = self.depth(index)
        layout = self.settings.scores_layout or "KHW"
        return Frame(
            index=int(index),
            depth=depth,
            intrinsics=self.intrinsics(depth.shape),
            T_wc=self.T_wc(index),
            labels=read_labels(files["labels"], self._space_of(backbone), self._read) if "labels" in files else None,
            scores=read_scores(files["scores"], layout, depth.shape, self._read) if "scores" in files else None,
            color=read_color(files["color"]) if color and "color" in files else None,
            mask=read_mask(files["mask"], self._read) if "mask" in files else None,
            files={what: str(file) for what, file in files.items()},
        )

    @property
    def depth_scale(self) -> float:
        """Units of its stored depth in a metre: what is said, else what its kind of file means."""
        is_png = all(path.suffix.lower() == ".png" for path in self._files.depth.files.values())
        return self.settings.depth_scale or (MILLIMETRES if is_png else 1.0)

    def color(self, index: int) -> npt.NDArray[np.uint8] | None:
        """Colour (H, W, 3) uint8 RGB, None where the frame has none; needs no labels. Raises DataError."""
        path = self._files.color.files.get(self._name(index))
        return None if path is None else read_color(path)

    def image_name(self, index: int) -> str:
        """The name that the frame's files share."""
        return self._name(index)

    def predicted(self, index: int, *, labels: Labels | None = None, scores: Scores | None = None) -> Frame:
        """The frame with labels (H, W) or scores (H, W, K) that were predicted on its colour image; no colour.

        They are brought to the depth's pixels. Raises DataError that names the file, also where the two images do not
        show the same view.
        """
        name = self._name(index)
        parts = (self._files.depth, self._files.pose, self._files.color, self._files.mask)
        files = {part.kind: part.files[name] for part in parts if name in part.files}
        depth = self.depth(index)
        labels, scores = fitted(labels, scores, depth.shape, str(files.get("color", name)))
        return Frame(
            index=int(index),
            depth=depth,
            intrinsics=self.intrinsics(depth.shape),
            T_wc=self.T_wc(index),
            labels=labels,
            scores=scores,
            mask=read_mask(files["mask"], self._read) if "mask" in files else None,
            files={what: str(file) for what, file in files.items()},
        )

    def depth(self, index: int) -> npt.NDArray[np.float32]:
        """Depth (H, W) float32 in metres, planar z; needs no labels. Raises DataError that names the file."""
        depth = read_depth(self._files.depth.files[self._name(index)], self.settings.depth_scale, self._read)
        return planar(depth, self.intrinsics(depth.shape)) if self.settings.depth_kind == "ray" else depth

    def intrinsics(self, shape: tuple[int, ...]) -> Intrinsics:
        """Intrinsics of the depth image of that shape (H, W), pixels."""
        size = self.settings.intrinsics_size
        return self._intrinsics.resized(size, (shape[1], shape[0])) if size else self._intrinsics

    def T_wc(self, index: int) -> npt.NDArray[np.float64]:
        """Pose (4, 4) camera-to-world in metres, OpenCV camera axes; needs no labels.

        Raises DataError that names the file. That the pose is rigid is checked by `Frame`.
        """
        path = self._files.pose.files[self._name(index)]
        T = read_pose(path)
        if not np.isfinite(T).all():
            return T  # lost tracking: Frame says so
        if self.settings.pose_convention == "world_to_camera":
            T = _inverse(T, path)
        T[:3, :3] = T[:3, :3] @ CAMERA_AXES[self.settings.camera_axes or "opencv"]
        return T

    def digest(self, indices: list[int], backbone: str) -> str:
        """A hash of the settings, the classes and the files behind those frames; colour does not count.

        Of the images it is the content that `frame` read, where it did; others are read for it.
        """
        digest = hashlib.blake2b(digest_size=16)
        digest.update(json.dumps(self._effective_settings(backbone)).encode())
        paths = [self.folder / "intrinsics.txt"]
        for index in indices:
            paths += [path for kind, path in self._frame_files(index, backbone).items() if kind != "color"]
        for path in paths:
            digest.update(path.relative_to(self.folder).as_posix().encode() + b"\0")
            digest.update(self._digests.get(path) or disk.file_digest(path))
        return digest.hexdigest()

    def _read(self, path: Path) -> bytes:
        """The content of an image file; its digest is kept, so that `digest` need not read the file again."""
        data = disk.read_bytes(path)
        self._digests[path] = disk.digest(data)
        return data

    @cached_property
    def _space(self) -> LabelSpace | None:
        try:
            return self.settings.label_space()
        except ConfigError as error:
            raise ConfigError(f"{self.folder}: {error}") from error

    def _space_of(self, backbone: str) -> LabelSpace | None:
        """The classes of a backbone's label maps, None where nothing says them; its file is read once."""
        file = self._files.source(backbone).folder / LABEL_SPACE_FILE
        if backbone not in self._spaces:
            shared = None if backbone in self.regions else self._space
            self._spaces[backbone] = LabelSpace.load(file) if file.is_file() else shared
        return self._spaces[backbone]

    def _effective_settings(self, backbone: str) -> dict[str, Any]:
        """What scene.yaml and the options say together, with the taxonomy's content instead of its name."""
        settings = self.settings.model_dump(mode="json", exclude={"taxonomy", "classes"})
        space = self._space_of(backbone)
        return settings | {"label_space": space.to_dict() if space else None}

    def _name(self, index: int) -> str:
        if not 0 <= index < len(self):
            raise ConfigError(f"{self.folder}: there is no frame {index}; it has {len(self)}, counted from 0")
        return self._names[index]

    def _frame_files(self, index: int, backbone: str) -> dict[str, Path]:
        """Depth, pose, labels or scores, and colour where there is any, by kind."""
        name = self._name(index)
        source = self._files.source(backbone)
        if name not in source.files:  # only of the ground truth and of regions: the others are complete
            missing = [str(source.folder / f"{other}.png") for other in self._names if other not in source.files]
            raise DataError(f"{self.folder}: {listed(missing)}; choose frames that have them, or add them")
        parts: list[FrameFiles] = [self._files.depth, self._files.pose, source, self._files.color, self._files.mask]
        return {part.kind: part.files[name] for part in parts if name in part.files}


def _inverse(T: npt.NDArray[np.float64], path: Path) -> npt.NDArray[np.float64]:
    try:
        return np.linalg.inv(T).astype(np.float64, copy=False)
    except np.linalg.LinAlgError as error:
        raise DataError(f"{path}: the pose cannot be inverted, so it is not rigid; leave this frame out") from error
