"""Finishes that replace the materials of mesh files."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from PIL import ImageColor

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_materials import MAX_SPECULAR
from mitsplat.images.colour import decode_srgb
from mitsplat.mesh_files.mesh_file import DIELECTRIC_SPECULAR, LEAST_ROUGHNESS, ROUGHNESS, Material


@dataclass(frozen=True)
class SurfaceFinish:
    """Material that replaces that of a file; each value applies to all parts, None keeps the file's value.

    A colour replaces textures and vertex colours. Roughness, metalness or specular on a matt part make it glossy.

    Attributes:
        colour: Display-encoded colour: a CSS name, ``#rrggbb``, or red, green, blue from 0 to 1.
        roughness: Roughness of glTF's material model, 0 (a mirror) to 1.
        metallic: Metalness, 0 for dielectrics to 1 for metals.
        specular: Reflectance at normal incidence of dielectrics, 0 (matt) to 0.08; 0.04 for plastics.
    """

    colour: str | tuple[float, float, float] | None = None
    roughness: float | None = None
    metallic: float | None = None
    specular: float | None = None

    def __post_init__(self) -> None:
        for name, most in (("roughness", 1.0), ("metallic", 1.0), ("specular", MAX_SPECULAR)):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= most:
                cause = " (for a metal, give metallic 1)" if name == "specular" and value > most else ""
                raise InputError(f"{name} must be from 0 to {most:g} (got {value:g}){cause}")
        self.linear_colour()

    def linear_colour(self) -> Float64Array | None:
        """Return linear red, green and blue, shape (3,), or None."""
        if self.colour is None:
            return None
        if isinstance(self.colour, str):
            try:
                encoded = np.array(ImageColor.getrgb(self.colour)[:3]) / 255.0
            except ValueError:
                raise InputError(f"colour must be a name or #rrggbb, such as steelblue (got {self.colour!r})") from None
        else:
            encoded = np.asarray(self.colour, dtype=np.float64)
            if encoded.shape != (3,) or not ((encoded >= 0) & (encoded <= 1)).all():
                raise InputError(f"colour must be red, green and blue from 0 to 1 (got {self.colour!r})")
        return decode_srgb(encoded)

    def applied_to(self, material: Material) -> Material:
        """Return ``material`` with the values that this finish defines."""
        colour = self.linear_colour()
        if colour is not None:
            material = replace(material, factor=colour, texture=None, warnings=())
        given = {
            name: value for name in ("roughness", "metallic", "specular") if (value := getattr(self, name)) is not None
        }
        if not given:
            return material
        if not material.shiny:
            material = replace(material, roughness=ROUGHNESS, specular=DIELECTRIC_SPECULAR)
        material = replace(material, **given)
        gloss = material.metallic_roughness
        if gloss is not None:
            pixels = gloss.pixels.copy()
            for channel, name in enumerate(("metallic", "roughness")):
                if name in given:
                    pixels[..., channel] = round(255 * given[name])
            gloss = replace(gloss, pixels=pixels)
        return replace(
            material,
            metallic_roughness=gloss,
            roughness=max(material.roughness, LEAST_ROUGHNESS),
            shiny=material.specular > 0 or material.metallic > 0,
        )
