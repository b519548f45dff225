"""A recording of which several processes write parts, as one file in the end."""

from __future__ import annotations

import subprocess
import uuid
from dataclasses import dataclass, replace
from pathlib import Path

from semstab.core.files import atomic_path
from semstab.errors import ConfigError
from semstab.model.records import RECORDING_PARTS
from semstab.model.results import slug
from semstab.recording.target import Target, rerun_program
from semstab.task import Task


@dataclass(frozen=True)
class Parts:
    """Files of one recording: one a job, and one of what all have in common.

    folder  in which they lie until they are merged
    name    by which rerun knows that they belong together
    """

    folder: Path
    name: str

    @classmethod
    def of(cls, folder: Path) -> Parts:
        """In the folder of a run or a study."""
        return cls(folder / RECORDING_PARTS, uuid.uuid4().hex)

    def of_the_whole(self, target: Target) -> Target:
        """Where what all jobs have in common goes, of a recording that is to be that file in the end."""
        return replace(target, file=self.folder / "whole.rrd", name=self.name, final=target.file)

    def of_group(self, task: Task) -> Target:
        """Where the pictures of a backbone on a scene go, or of a stretch of its frames."""
        file = f"{slug(task.scene.name, task.backbone)}-{task.indices[0]}.rrd"
        return Target(self.folder / file, name=self.name)

    def merged(self, whole: Target) -> Target:
        """Make one file of the parts, and remove them. Raises ConfigError where that fails."""
        assert whole.final is not None
        parts = sorted(self.folder.glob("*.rrd"))
        with atomic_path(whole.final) as file:
            command = [rerun_program(), "rrd", "optimize", *map(str, parts), "-o", str(file)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise ConfigError(
                    f"{whole.final}: the parts in {self.folder} cannot be merged ({done.stderr.strip()[:200]})"
                )
        for part in parts:
            part.unlink()
        return Target(whole.final)
