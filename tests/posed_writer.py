"""The one way in which tests write a posed_folder: by the writer of `semstab-bench convert`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import yaml

from semstab import Frame
from semstab.convert import CONVERSION_FILE, DepthFormat, SceneFolder


def write_posed(
    folder: Path, names: Sequence[str], sources: Mapping[str, Iterable[Frame]], *, scale: float | None = 1000.0,
    **settings: object,
) -> Path:  # fmt: skip
    """Depth, poses and colour of the first source's frames, and the labels or scores of every source.

    `scale` is that of 16-bit depth, None for floats; `settings` are those of scene.yaml; a source without a name has no
    labels.
    """
    written = SceneFolder(folder, {}, tolerance=0.0)
    written.begin(DepthFormat(scale), {})
    for name, *frames in zip(names, *sources.values(), strict=True):
        written.write_geometry(name, frames[0])
        for source, frame in zip(sources, frames, strict=True):
            if source:
                written.write_labels(name, frame, source)
    written.close()
    (folder / CONVERSION_FILE).unlink()  # it is nobody's conversion
    (folder / "scene.yaml").write_text(
        yaml.safe_dump(settings | ({} if scale in (None, 1000) else {"depth_scale": scale}))
    )
    return folder
