"""Keys of ``capture.json``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from mitsplat.geometry.lens import Lens
from mitsplat.storage.field_types import Positive, StrictModel

_Row = tuple[float, float, float, float]


class PhotoCamera(StrictModel):
    """Keys of a camera, as in :class:`~mitsplat.geometry.camera.Camera`."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    near: float
    lens: Lens = "opencv"
    world_from_camera: tuple[_Row, _Row, _Row, _Row]


class PhotoSpec(StrictModel):
    """Keys of a photo; file names are relative to the capture folder, and ``gain`` is absent without a correction."""

    name: str = Field(min_length=1)
    file: str = Field(min_length=1)
    mask: str | None = None
    camera: PhotoCamera
    gain: tuple[Positive, Positive, Positive] | None = Field(None, exclude_if=lambda gain: gain is None)


class CaptureSpec(StrictModel):
    """Keys of ``capture.json``."""

    format_version: int = Field(1, ge=1)
    units: Literal["metre", "unknown"]
    up: Literal["z", "unknown"]
    table: bool = False
    scale_error: Annotated[float, Field(ge=0)] | None = None
    rejected: dict[str, str]
    photos: list[PhotoSpec]
