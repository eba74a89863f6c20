"""Materials of mesh files, and finishes that replace them.

Colours in files are display-encoded (PLY, STL, OBJ with its MTL). Factors and vertex colours of glTF are linear by its
specification (Khronos, *glTF 2.0*, 3.9.2 and 3.7.2.1). A texture without a factor is used unchanged. An MTL without
``Ks``, ``Pr`` and ``Pm``, or with ``illum`` 0 or 1, is matt.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageColor
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_materials import MAX_SPECULAR
from mitsplat.images.colour import decode_srgb, eight_bit
from mitsplat.storage.files import IMAGE_ERRORS, is_inside

DIELECTRIC_SPECULAR = 0.04
"""Reflectance at normal incidence of common plastics, lacquers and glass."""
UNKNOWN_COLOUR = 0.5
"""Linear grey of parts without a colour."""
ROUGHNESS = 0.6
LEAST_ROUGHNESS = 0.05
_OPAQUE = 0.999
_TRIMESH_DIFFUSE = (102, 102, 102)
"""Value that trimesh inserts for an absent ``Kd``."""


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


@dataclass(frozen=True, eq=False)
class Material:
    """One material, uniform except for its textures.

    Attributes:
        factor: Linear colour, or factor of the texture, shape (3,).
        texture: Display-encoded base colour, shape (H, W, 3) uint8, or None.
        metallic: Metalness, 0 to 1; the mean if there is a texture of it.
        roughness: Roughness of glTF's material model, > 0; the mean if there is a texture of it.
        specular: Reflectance at normal incidence of the non-metallic part.
        shiny: True if the material reflects a highlight.
        warnings: Ignored properties of the file's material, a sentence each.
        metallic_roughness: Texture of metalness and roughness times 255, shape (H, W, 2), or None.
        normal_map: Tangent-space normals of glTF, shape (H, W, 3) uint8, or None.
    """

    factor: Float64Array
    texture: npt.NDArray[np.uint8] | None
    metallic: float = 0.0
    roughness: float = 1.0
    specular: float = DIELECTRIC_SPECULAR
    shiny: bool = True
    warnings: tuple[str, ...] = ()
    metallic_roughness: npt.NDArray[np.uint8] | None = None
    normal_map: npt.NDArray[np.uint8] | None = None


def read_material(material: Any) -> Material:
    """Convert a material of trimesh."""
    if isinstance(material, PBRMaterial):
        return _read_gltf(material)
    if isinstance(material, SimpleMaterial):
        return _read_mtl(material)
    return _read_gltf(material.to_pbr())


def _read_gltf(source: PBRMaterial) -> Material:
    warnings = []
    # trimesh stores the file's linear values as multiples of 1/255.
    factor = np.ones(3) if source.baseColorFactor is None else np.asarray(source.baseColorFactor) / 255.0
    if source.alphaMode not in (None, "OPAQUE") and (factor[3:] < _OPAQUE).any():
        warnings.append("it is transparent, but is baked as opaque")
    if source.emissiveTexture is not None or np.any(source.emissiveFactor):
        warnings.append("it emits light, which is not baked")
    metallic = 0.0 if source.metallicFactor is None else float(source.metallicFactor)
    roughness = ROUGHNESS if source.roughnessFactor is None else float(source.roughnessFactor)
    texture = _pixels(source.metallicRoughnessTexture)
    if texture is not None:
        # If this texture exists, absent factors are 1; green is roughness, blue is metalness.
        factors = (1.0 if given is None else float(given) for given in (source.metallicFactor, source.roughnessFactor))
        values = np.clip(texture[..., [2, 1]] / 255.0 * (*factors,), (0.0, LEAST_ROUGHNESS), 1.0)
        texture, (metallic, roughness) = np.rint(255 * values).astype(np.uint8), values.mean(axis=(0, 1))
    return Material(
        factor[:3],
        _pixels(source.baseColorTexture, warnings),
        float(np.clip(metallic, 0.0, 1.0)),
        float(np.clip(roughness, LEAST_ROUGHNESS, 1.0)),
        warnings=tuple(warnings),
        metallic_roughness=texture,
        normal_map=_pixels(source.normalTexture),
    )


def _read_mtl(source: SimpleMaterial) -> Material:
    """Convert an MTL material from the file's own keys, because trimesh inserts dark grey for an absent ``Kd``."""
    keys: Mapping[str, Any] = source.kwargs
    warnings: list[str] = []
    texture = _pixels(source.image, warnings)
    diffuse = _numbers(keys, "kd")
    if diffuse is None and not np.array_equal(source.diffuse[:3], _TRIMESH_DIFFUSE):
        diffuse = np.asarray(source.diffuse[:3]) / 255.0
    if diffuse is not None:
        factor = decode_srgb(np.broadcast_to(np.clip(diffuse, 0, 1), 3))
    else:
        factor = np.ones(3) if texture is not None else np.full(3, UNKNOWN_COLOUR)
    opacity, transparency = _numbers(keys, "d"), _numbers(keys, "tr")
    if (opacity is not None and opacity[-1] < _OPAQUE) or (transparency is not None and transparency[0] > 1 - _OPAQUE):
        warnings.append("it is transparent, but is baked as opaque")
    emission = _numbers(keys, "ke")
    if "map_ke" in keys or (emission is not None and emission.any()):
        warnings.append("it emits light, which is not baked")
    left_out = sorted({"map_pr", "map_pm", "map_ks", "map_ns", "map_d", "map_bump", "bump", "norm"} & set(keys))
    if left_out:
        warnings.append(f"its {', '.join(left_out)} {'is' if len(left_out) == 1 else 'are'} left out")
    given_roughness, metallic = _numbers(keys, "pr"), _numbers(keys, "pm")
    highlight, illumination = _numbers(keys, "ks"), _numbers(keys, "illum")
    physical = given_roughness is not None or metallic is not None
    specular = 0.0 if highlight is None else min(MAX_SPECULAR, MAX_SPECULAR * float(highlight.mean()))
    if illumination is not None and illumination[0] < 2 and not physical:
        specular = 0.0
    if physical and highlight is None:
        specular = DIELECTRIC_SPECULAR
    roughness = ROUGHNESS
    if given_roughness is not None:
        roughness = float(given_roughness[0])
    elif (exponent := _numbers(keys, "ns")) is not None:
        # Phong's exponent, converted to the slope variance of a microfacet surface (Walter et al. 2007).
        roughness = (2.0 / (max(0.0, float(exponent[0])) + 2.0)) ** 0.25
    metal = 0.0 if metallic is None else float(np.clip(metallic[0], 0.0, 1.0))
    shiny = specular > 0 or metal > 0
    return Material(
        factor,
        texture,
        metal,
        float(np.clip(roughness, LEAST_ROUGHNESS, 1.0)) if shiny else 1.0,
        specular,
        shiny,
        tuple(warnings),
    )


def _numbers(keys: Mapping[str, Any], name: str) -> Float64Array | None:
    """Return the numbers of an MTL key, or None if it is absent or damaged."""
    try:
        found = np.atleast_1d(np.asarray(keys[name], dtype=np.float64))
    except (KeyError, ValueError):
        return None
    return found if len(found) and np.isfinite(found).all() else None


def _pixels(image: Image.Image | None, warnings: list[str] | None = None) -> npt.NDArray[np.uint8] | None:
    """Return the pixels (H, W, 3) of a texture; ``warnings`` gets a sentence about transparent texels."""
    if image is None:
        return None
    try:
        if warnings is not None and "A" in image.getbands() and np.asarray(image.getchannel("A")).min() < 250:
            warnings.append("its texture has transparent texels, which are baked as opaque")
        return np.array(eight_bit(image))
    except IMAGE_ERRORS as error:
        raise InputError(f"its texture cannot be read ({error})") from error


def check_textures(mesh: Path) -> None:
    """Refuse a mesh whose material file, materials or textures are missing, because it would be baked in grey.

    Raises:
        InputError: If a file that an OBJ, its MTL, a glTF or a PLY names is missing, outside of its folder, or no
            image.
    """
    kind = mesh.suffix.lower()
    if kind == ".obj":
        _check_obj(mesh)
    elif kind == ".gltf":
        _check_gltf(mesh)
    elif kind == ".ply":
        with mesh.open("rb") as file:
            header = file.read(_MAX_HEADER_BYTES).partition(b"end_header")[0].decode("utf-8", errors="replace")
        for texture in re.findall(r"^comment TextureFile (.+?)\s*$", header, re.MULTILINE):
            _check_texture(mesh, texture)


_MAX_HEADER_BYTES = 1 << 16
"""Maximum size of the header of a PLY file [bytes]."""


def _check_obj(mesh: Path) -> None:
    libraries = _values_of(mesh, "mtllib")
    known: list[str] = []
    for library in libraries:
        path = mesh.parent / library
        if not is_inside(mesh.parent, library):
            raise InputError(
                f"{mesh}: its material file {library} is outside of its folder; put it there, or give a colour"
            )
        if not path.is_file():
            if all((mesh.parent / word).is_file() for word in library.split()):
                raise InputError(f"{mesh}: must have one material file (got {library})")
            raise InputError(f"{mesh}: its material file {library} is missing; put it there, or give a colour")
        known += _values_of(path, "newmtl")
        for texture in _values_of(path, "map_kd"):
            if texture.startswith("-"):
                raise InputError(f"{path}: options of a texture are not supported: remove them (got map_Kd {texture})")
            _check_texture(path, texture)
    missing = sorted(set(_values_of(mesh, "usemtl")) - set(known)) if libraries else []
    if missing:
        raise InputError(
            f"{mesh}: its material {missing[0]} is not in {', '.join(libraries)}: add it, or give a colour"
        )


def _check_gltf(mesh: Path) -> None:
    try:
        stored = json.loads(mesh.read_text("utf-8"))
        images = [image.get("uri", "data:") for image in stored.get("images", [])]
        sources = [texture.get("source", 0) for texture in stored.get("textures", [])]
        for material in stored.get("materials", []):
            index = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {}).get("index")
            if index is not None and not (0 <= index < len(sources) and 0 <= sources[index] < len(images)):
                raise InputError(f"{mesh}: a material's texture {index} is missing; give a colour")
    except (OSError, ValueError, AttributeError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        return  # trimesh reports the error when it reads the file
    for uri in images:
        if not uri.startswith("data:"):
            _check_texture(mesh, unquote(uri))


def _check_texture(path: Path, texture: str) -> None:
    if not is_inside(path.parent, texture):  # trimesh would omit it
        raise InputError(f"{path}: its texture {texture} is outside of its folder; put it there, or give a colour")
    try:
        with Image.open(path.parent / texture) as image:
            image.load()
    except IMAGE_ERRORS as error:
        missing = not (path.parent / texture).is_file()
        fault = "is missing" if missing else f"cannot be read ({error})"
        raise InputError(f"{path}: its texture {texture} {fault}; put it there, or give a colour") from None


def _values_of(path: Path, key: str) -> list[str]:
    """Return the values of all lines of an OBJ or an MTL that begin with a key."""
    names = []
    for line in path.read_bytes().splitlines():
        words = line.split(maxsplit=1)
        if len(words) == 2 and words[0].lower() == key.encode():
            try:
                names.append(words[1].strip().decode("utf-8"))
            except UnicodeDecodeError:
                name = words[1].strip().decode("cp1252", errors="replace")
                raise InputError(f"{path}: names must be UTF-8: save it so, or rename it (got {key} {name})") from None
    return names
