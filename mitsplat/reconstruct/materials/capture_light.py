"""Light of photographs, in the frame of their capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mitsuba as mi
from pydantic import Field

from mitsplat.capture.capture import Capture
from mitsplat.errors import InputError
from mitsplat.images.untrusted_images import check_images
from mitsplat.renderer.scene_emitters import emitter_dict, load_emitter
from mitsplat.scene.spec.light_spec import LightSpec
from mitsplat.storage.content_hash import file_hash
from mitsplat.storage.field_types import StrictModel
from mitsplat.storage.files import resolve_inside
from mitsplat.storage.yaml_input import load_yaml


class _LightFile(StrictModel):
    """Lights of a file by ``mitsplat lights``."""

    lights: tuple[Annotated[LightSpec, Field(discriminator="kind")], ...] = Field(min_length=1)


@dataclass(frozen=True)
class CaptureLight:
    """Lights of photographs, in the frame of their capture. White in the photographs is the radiance 1.

    Attributes:
        lights: The lights.
        folder: Folder of the images that they name.

    Raises:
        InputError: If a light is random or moves, or an image is missing.
    """

    lights: tuple[LightSpec, ...]
    folder: Path = Path()

    def __post_init__(self) -> None:
        for light in self.lights:
            if any(getattr(light, name, None) for name in ("draw", "path", "pool")):
                raise InputError("the lights of photographs must be fixed: remove draw, path and pool")
            image = getattr(light, "image", None)
            if image is not None and not (self.folder / image).is_file():
                raise InputError(f"{self.folder / image}: no such image")

    @classmethod
    def load(cls, path: Path) -> CaptureLight:
        """Read the key ``lights`` of a file, as ``mitsplat lights`` writes it.

        Raises:
            InputError: If the file cannot be read or breaks a rule.
        """
        lights = load_yaml(path, _LightFile).lights
        try:
            images = [resolve_inside(path.parent, image) for one in lights if (image := getattr(one, "image", None))]
            if reason := next(filter(None, check_images(images)), None):
                raise InputError(reason)
            return cls(lights, path.parent)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def scene(self) -> mi.Scene:
        """Return a Mitsuba scene of the lights."""
        emitters = [load_emitter(emitter_dict(light, self.folder), movable=False) for light in self.lights]
        return mi.load_dict({"type": "scene"} | {f"light_{number}": part for number, part in enumerate(emitters)})

    def content(self) -> list[object]:
        """Return the values and the hashes of the images, for the hash of the inputs."""
        images = [image for light in self.lights if (image := getattr(light, "image", None))]
        hashes = [file_hash(self.folder / image) for image in images]
        return [*(light.model_dump(mode="json") for light in self.lights), *hashes]


def require_light_frame(capture: Capture) -> None:
    """Raise InputError if lights have no place in the frame of a capture."""
    if capture.units != "metre" or capture.up != "z":
        raise InputError(
            "lights need a capture in metres with z up, such as one with a board or tags "
            f"(got units {capture.units}, up {capture.up})"
        )
