"""The settings of a gate: its rules, the level, what is to become of what is undecided."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from semstab.config import read_yaml, validated
from semstab.errors import ConfigError
from semstab.gating.judging import Frames


class GateConfig(BaseModel):
    """What stands in gate.yaml.

    level   the probability with which a rule may fail that holds, or pass that does not
    frames  'random': rules are judged for other frames like these, and other places; 'fixed': for other places in these
            very frames, which says nothing of the next flight
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    rules: tuple[str, ...] = ()
    level: float = Field(0.05, ge=1e-4, le=0.25)
    undecided: Literal["pass", "fail"] = "pass"
    frames: Frames = "random"


def gate_config(
    file: str | Path | None = None,
    rules: Sequence[str] = (),
    level: float | None = None,
    undecided: str | None = None,
    frames: str | None = None,
) -> GateConfig:
    """From a YAML file, and what is given beside it, which counts more; rules are added to the file's.

    Raises ConfigError, which names the file and the setting.
    """
    given = {"level": level, "undecided": undecided, "frames": frames}
    options = {name: value for name, value in given.items() if value is not None}
    config = GateConfig() if file is None else validated(GateConfig, read_yaml(file), f"{file}: ")
    config = validated(GateConfig, {**config.model_dump(), **options, "rules": (*config.rules, *rules)}, "gate: ")
    if not config.rules:
        where = f"{file}: rules" if file is not None else "gate"
        raise ConfigError(f"{where}: there is no rule; write e.g. --rule 'alpha drop < 0.02'")
    return config
