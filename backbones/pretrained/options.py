"""Settings of the backbone `transformers`."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, PositiveInt, field_validator

from semstab.backbones.pretrained.preprocessing import ImageModelOptions


class SegmenterOptions(ImageModelOptions):
    """Which checkpoint, at which image size, run by what, asked for what."""

    image_size: PositiveInt | tuple[PositiveInt, PositiveInt] | None = Field(
        None,
        description="the shorter side in pixels, the shape of the image kept; or [height, width]; where not given, what"
        " the checkpoint was made for",
    )
    engine: Literal["torch", "onnx"] = Field("torch", description="torch, or ONNX Runtime on the CPU")
    prompts: tuple[str, ...] | None = Field(None, description="of a CLIPSeg model: what it is asked for, its classes")
    threshold: float | None = Field(
        None, gt=0, lt=1, description="of a CLIPSeg model: where no prompt is as likely, nothing is said"
    )

    @field_validator("prompts", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        return [part.strip() for part in value.split(",")] if isinstance(value, str) else value
