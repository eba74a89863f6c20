"""Content of a mesh file: parts with materials and textures, in the units and axes of the file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import trimesh
from PIL import Image

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.errors import InputError
from mitsplat.geometry.rigid import scaling
from mitsplat.images.colour import eight_bit, in_srgb
from mitsplat.storage.files import IMAGE_ERRORS

Wrap = Literal["repeat", "mirror", "clamp"]
"""Continuation of a texture outside of its image; the names are those of Mitsuba's ``bitmap``."""

Axis = Literal["x", "y", "z"]

DIELECTRIC_SPECULAR = 0.04
"""Reflectance at normal incidence of common plastics, lacquers and glass."""
UNKNOWN_COLOUR = 0.5
"""Linear grey of parts without a colour."""
ROUGHNESS = 0.6
LEAST_ROUGHNESS = 0.05
_FULL_SPECULAR = 0.08
"""Reflectance at normal incidence of a white specular colour."""
OPAQUE = 0.999
MAX_FRACTION = 1.01
"""Largest number that counts as a colour from 0 to 1."""

_WRAPPED: dict[Wrap, Callable[[Float64Array], Float64Array]] = {
    "repeat": lambda t: t % 1.0,
    "mirror": lambda t: 1.0 - np.abs(t % 2.0 - 1.0),
    "clamp": lambda t: np.clip(t, 0.0, 1.0),
}


@dataclass(frozen=True, eq=False)
class Texture:
    """Image on a mesh.

    Attributes:
        pixels: Image, shape (H, W, C).
        uv: Texture coordinates of every face corner, v up, shape (F, 3, 2).
        wrap: Continuation outside of the image along u and v.
    """

    pixels: npt.NDArray[np.uint8]
    uv: Float64Array
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")

    def __post_init__(self) -> None:
        if not np.isfinite(self.uv).all():
            raise InputError("texture coordinates must be finite")

    def at(self, faces: Int64Array, barycentric: Float64Array) -> npt.NDArray[np.uint8]:
        """Return the nearest texels (N, C) at barycentric coordinates (N, 3) of faces (N,)."""
        height, width = self.pixels.shape[:2]
        u, v = np.einsum("nk,nkc->cn", barycentric, self.uv[faces])
        u, v = _WRAPPED[self.wrap[0]](u), _WRAPPED[self.wrap[1]](v)
        column = np.minimum((u * width).astype(int), width - 1)
        row = np.minimum(((1.0 - v) * height).astype(int), height - 1)
        return np.asarray(self.pixels[row, column])


@dataclass(frozen=True, eq=False)
class Material:
    """One material, uniform except for its textures.

    Attributes:
        factor: Linear colour, or factor of the texture, shape (3,).
        texture: Display-encoded base colour, three channels, or None.
        metallic: Metalness, 0 to 1; the mean if there is a texture of it.
        roughness: Roughness of glTF's material model, > 0; the mean if there is a texture of it.
        specular: Reflectance at normal incidence of the non-metallic part.
        shiny: True if the material reflects a highlight.
        warnings: Ignored properties of the file's material, a sentence each.
        metallic_roughness: Texture of metalness and roughness times 255, two channels, or None.
        normal_map: Tangent-space normals of glTF, three channels, or None.
    """

    factor: Float64Array
    texture: Texture | None
    metallic: float = 0.0
    roughness: float = 1.0
    specular: float = DIELECTRIC_SPECULAR
    shiny: bool = True
    warnings: tuple[str, ...] = ()
    metallic_roughness: Texture | None = None
    normal_map: Texture | None = None


def phong_gloss(highlight: float, exponent: float | None) -> tuple[float, float]:
    """Return reflectance at normal incidence and roughness of the highlight that MTL and COLLADA state.

    Args:
        highlight: Mean of the specular colour.
        exponent: Phong's exponent, or None if the file states none.
    """
    specular = _FULL_SPECULAR * min(1.0, highlight)
    if exponent is None:
        return specular, ROUGHNESS
    # Converted to the slope variance of a microfacet surface (Walter et al. 2007).
    return specular, float(np.clip((2.0 / (max(0.0, exponent) + 2.0)) ** 0.25, LEAST_ROUGHNESS, 1.0))


UNKNOWN_MATERIAL = Material(np.full(3, UNKNOWN_COLOUR), None, shiny=False)
"""Material of parts without a material and without colours."""
PAINTED_MATERIAL = Material(np.ones(3), None, shiny=False)
"""Matt material of parts with colours at their vertices or faces only."""


@dataclass(frozen=True, eq=False)
class FilePart:
    """Part of a mesh file with one material.

    Attributes:
        name: Name of the part.
        vertices: Positions in the units of the file, shape (V, 3).
        faces: Vertices of each face, shape (F, 3).
        transform: Transform of the positions, shape (4, 4).
        material: The material.
        colours: Linear colours of the face corners that the material's factor multiplies, shape (F, 3, 3), or None.
        double_sided: True if the file states that both sides of the faces are visible.
        normals: Normals that the file states at the face corners, of any length and before ``transform``, shape
            (F, 3, 3), or None.
    """

    name: str
    vertices: Float64Array
    faces: Int64Array
    transform: Float64Array
    material: Material
    colours: Float64Array | None = None
    double_sided: bool = False
    normals: Float64Array | None = None


@dataclass(frozen=True, eq=False)
class MeshFile:
    """Content of a mesh file.

    Attributes:
        parts: Its parts with faces, in their order.
        metres_per_unit: Length of its unit [m], or None if the file does not state it.
        up: Axis that points up, or None if the file does not state it.
        warnings: Parts of the file that were left out, a sentence each.
        in_single: True if the positions are stored as 32-bit numbers.
        tolerance: Maximum distance of the facets from the surfaces of the file [mm], or None for a file of facets.
    """

    parts: tuple[FilePart, ...]
    metres_per_unit: float | None = None
    up: Axis | None = None
    warnings: tuple[str, ...] = ()
    in_single: bool = False
    tolerance: float | None = None


@dataclass(frozen=True)
class MeshFrame:
    """Units and vertical axis of a mesh file; absent values are those that the file states.

    Attributes:
        metres_per_unit: Length of the unit [m]; 1 if neither this nor the file states it.
        up: Axis that points up; z if neither this nor the file states it.
    """

    metres_per_unit: float | None = None
    up: Axis | None = None

    def to_world(self, stated_units: float | None = None, stated_up: Axis | None = None) -> Float64Array:
        """Return the transform (4, 4) to metres with z up, for the values that a file states."""
        return world_from_file(self.metres_per_unit or stated_units or 1.0, self.up or stated_up or "z")


def world_from_file(metres_per_unit: float, up: Axis) -> Float64Array:
    """Return the transform (4, 4) from the file's units and axes to metres, z up."""
    matrix = scaling(metres_per_unit)
    if up == "y":
        matrix = matrix @ trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    elif up == "x":
        matrix = matrix @ trimesh.transformations.rotation_matrix(-np.pi / 2, (0, 1, 0))
    return np.asarray(matrix)


def pixels_of(image: Image.Image) -> npt.NDArray[np.uint8]:
    """Return the pixels (H, W, 3) of a texture.

    Raises:
        InputError: If the image is damaged.
    """
    try:
        return np.array(eight_bit(in_srgb(image) if image.mode == "CMYK" else image))
    except IMAGE_ERRORS as error:
        raise InputError(f"its texture cannot be read ({error})") from error


def alpha_of(image: Image.Image) -> npt.NDArray[np.uint8]:
    """Return the opacity (H, W, 1) of a texture times 255.

    Raises:
        InputError: If the image is damaged.
    """
    try:
        return np.asarray(image.convert("RGBA").getchannel("A"))[..., None]
    except IMAGE_ERRORS as error:
        raise InputError(f"its texture cannot be read ({error})") from error


def is_transparent(image: Image.Image) -> bool:
    """Return True if an image has transparent pixels.

    Raises:
        InputError: If the image is damaged.
    """
    return image.has_transparency_data and bool(alpha_of(image).min() < 250)


WITHOUT_COORDINATES = "its texture has no coordinates, and is left out"
TRANSPARENT_COLOURS = "the colours of its vertices are transparent, but are baked as opaque"
TRANSPARENT_TEXELS = "its texture has transparent texels, which are baked as opaque"


def gloss_texture(stored: Texture, metallic: float, roughness: float) -> Texture:
    """Return metalness and roughness of glTF's texture, whose green is roughness and whose blue is metalness.

    Args:
        stored: Texture with the channels of the file.
        metallic: Factor of the metalness.
        roughness: Factor of the roughness.
    """
    values = np.clip(stored.pixels[..., [2, 1]] / 255.0 * (metallic, roughness), (0.0, LEAST_ROUGHNESS), 1.0)
    return Texture(np.rint(255 * values).astype(np.uint8), stored.uv, stored.wrap)


def means_of(gloss: Texture) -> tuple[float, float]:
    """Return the mean metalness and roughness of a texture of both."""
    metallic, roughness = gloss.pixels.mean(axis=(0, 1)) / 255.0
    return float(metallic), float(roughness)


def item(values: object, index: object, kind: str) -> Any:
    """Return an item of a list of a file.

    Raises:
        ValueError: If there is no list, or no such item in it.
    """
    if not isinstance(values, list) or not isinstance(index, int) or not 0 <= index < len(values):
        raise ValueError(f"{kind} {index!r} is missing")
    return values[index]
