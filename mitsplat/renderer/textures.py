"""Mitsuba materials of visible shapes; patterns are seamless tileable images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import ByteImage, Float64Array
from mitsplat.images.colour import decode_srgb
from mitsplat.renderer.rays.device_arrays import plain_mesh, wrapped
from mitsplat.renderer.scene_emitters import MitsubaDict
from mitsplat.scene.planning.layout_surroundings import MaterialDraw
from mitsplat.scene.spec.shape_spec import Shape
from mitsplat.scene.walls import pose_matrix

SIZE = 1024
"""Edge of a pattern's image [px]."""

FEATURES = 12
"""Number of the largest features across the image; wood has twice as many grain lines."""


def texture_image(finish: MaterialDraw, images: Mapping[str, Path]) -> ByteImage | None:
    """Return the tile image (H, W, 3) of a finish, sRGB-encoded; None for a single colour.

    Args:
        finish: The finish.
        images: Image files by the names that finishes use.
    """
    if finish.image is not None:
        return read_image(images[finish.image])
    if finish.kind == "colour":
        return None
    share = _PATTERNS[finish.kind](np.random.default_rng(finish.seed))[..., None]
    first, second = np.array(finish.colours)
    encoded: ByteImage = np.rint(255 * (first + share * (second - first))).astype(np.uint8)
    return encoded


def repeat_width(finish: MaterialDraw) -> float:
    """Return the width of a finish's image on a surface [m]."""
    repeats = {"image": 1, "checker": 2, "wood": 2 * FEATURES}
    return finish.scale * repeats.get(finish.kind, FEATURES)


def read_image(path: Path) -> ByteImage:
    """Read an image file as sRGB-encoded bytes, shape (H, W, 3)."""
    bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    return np.array(bitmap)


def material(finish: MaterialDraw, texture: MitsubaDict | None) -> MitsubaDict:
    """Return Mitsuba's material of a finish.

    Args:
        finish: The finish.
        texture: Mitsuba's texture of :func:`texture_image`; None for a single colour.
    """
    colour = texture or {"type": "rgb", "value": decode_srgb(np.array(finish.colours[0])).tolist()}
    return {"type": "diffuse", "reflectance": colour}


def bitmap_texture(image: ByteImage) -> MitsubaDict:
    """Return Mitsuba's texture of an sRGB-encoded image (H, W, 3)."""
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "wrap_mode": "repeat"}


def finished_mesh(
    mesh: trimesh.Trimesh,
    shape: Shape,
    finish: MaterialDraw,
    image: ByteImage | None,
    bsdf: mi.BSDF | None = None,
    travel: float = 0.0,
    motion: Float64Array | None = None,
) -> mi.Mesh:
    """Create Mitsuba's shape of a mesh with texture coordinates.

    Args:
        mesh: Mesh of ``shape`` at its place in the scene file [m].
        shape: Shape of the scene file.
        finish: Finish of the shape.
        image: Image of the finish.
        bsdf: Loaded Mitsuba material; None for Mitsuba's default.
        travel: Distance that the surface has moved along the shape's own x axis [m], for example of a belt.
        motion: Transform (4, 4) of the mesh together with its texture, see :mod:`mitsplat.scene.planning.shape_poses`.
    """
    props = mi.Properties()
    if bsdf is not None:
        props["bsdf"] = bsdf
    placed = mesh if motion is None else mesh.copy().apply_transform(motion)
    if image is None:
        return plain_mesh(placed, props)
    corners = np.asarray(placed.triangles).reshape(-1, 3)
    split = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    uv = box_projection(mesh, pattern_axes(shape), finish, image.shape[0] / image.shape[1], travel)
    made = mi.Mesh("mesh", len(corners), len(split.faces), has_vertex_texcoords=True, props=props)
    params = mi.traverse(made)
    params["vertex_positions"] = wrapped(mi.Float, np.asarray(split.vertices, dtype=np.float32))
    params["vertex_texcoords"] = wrapped(mi.Float, uv.astype(np.float32))
    params["faces"] = wrapped(mi.UInt32, np.asarray(split.faces, dtype=np.uint32))
    params.update()
    return made


def pattern_axes(shape: Shape) -> Float64Array:
    """Return the axes of a pattern's box projection as columns (3, 3): those of a box, otherwise world axes."""
    return np.eye(3) if shape.box is None else pose_matrix(shape.box)[:3, :3]


def box_projection(
    mesh: trimesh.Trimesh, axes: Float64Array, finish: MaterialDraw, aspect: float, travel: float = 0.0
) -> Float64Array:
    """Return texture coordinates (3 F, 2) of all triangle corners; each face is projected along its nearest axis.

    Args:
        mesh: Mesh in world space [m], F triangles.
        axes: Projection axes as columns (3, 3).
        finish: Finish that sets ``repeat_width``, rotation and offset.
        aspect: Height of the image over its width.
        travel: Distance that the image has moved along the first axis [m].
    """
    local = np.asarray(mesh.triangles) @ axes - [travel, 0.0, 0.0]
    normals = np.asarray(mesh.face_normals) @ axes
    along = np.argmax(np.abs(normals), axis=1)
    # Along x the image spans y and z, along y it spans x and z, along z it spans x and y. Its rows go down, and it is
    # not mirrored on any side.
    plane = np.array([[1, 2], [0, 2], [0, 1]])[along]
    facing = np.where(np.take_along_axis(normals, along[:, None], axis=1) < 0, -1.0, 1.0)
    right = facing * np.array([1.0, -1.0, 1.0])[along][:, None]
    uv = np.take_along_axis(local, plane[:, None], axis=2) * np.stack([right, -np.ones_like(right)], axis=2)
    uv = uv.reshape(-1, 2)
    turn = np.radians(finish.rotate)
    uv = uv @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.asarray(uv / (repeat_width(finish) * np.array([1.0, aspect])) + finish.offset)


def _clouds(rng: np.random.Generator, x: float, y: float, fall: float = 1.6) -> Float64Array:
    """Return periodic noise in [0, 1] by spectral synthesis.

    Amplitudes fall as 1/f^``fall`` from ``x`` and ``y`` periods on; different ``x`` and ``y`` stretch the noise.
    Source: Peitgen and Saupe (1988), The Science of Fractal Images, section 2.6.
    """
    fy, fx = np.meshgrid(np.fft.fftfreq(SIZE, 1 / SIZE), np.fft.rfftfreq(SIZE, 1 / SIZE), indexing="ij")
    frequency = np.hypot(fx / x, fy / y)
    amplitude = np.where(frequency > 0, np.maximum(frequency, 1.0) ** -fall, 0.0)
    amplitude *= np.minimum(frequency, 1.0)
    phase = np.exp(2j * np.pi * rng.random(amplitude.shape))
    waves = np.fft.irfft2(amplitude * phase, s=(SIZE, SIZE))
    return np.asarray(np.clip(0.5 + waves / (5 * waves.std()), 0.0, 1.0))


def _noise(rng: np.random.Generator) -> Float64Array:
    return _clouds(rng, FEATURES, FEATURES)


def _wood(rng: np.random.Generator) -> Float64Array:
    """Return wood grain: lines along x, distorted by noise that is stretched in x, and overlaid with fibres.

    Early wood fades in, and late wood ends abruptly.
    """
    height = np.arange(SIZE)[:, None] / SIZE
    bend = 6.0 * (_clouds(rng, 1, 3, 2.5) - 0.5)
    rings = (2 * FEATURES * height + bend) % 1.0
    edge = 0.12  # share of a ring in which late wood ends
    lines = np.where(rings < 1 - edge, (rings / (1 - edge)) ** 2, (1 - rings) / edge)
    return np.asarray(np.clip(0.75 * lines + 0.5 * (_clouds(rng, 6, 200, 1.0) - 0.25), 0.0, 1.0))


def _checks(rng: np.random.Generator) -> Float64Array:
    half = np.arange(SIZE) < SIZE // 2
    return np.asarray((half[:, None] ^ half), dtype=np.float64)


def _stripes(_: np.random.Generator) -> Float64Array:
    """Return stripes like slats: each band darkens like a side that faces away from the light, then restarts."""
    across = (FEATURES * np.arange(SIZE) / SIZE) % 1.0
    return np.repeat(across[:, None] ** 3, SIZE, axis=1)


_PATTERNS = {"noise": _noise, "wood": _wood, "checker": _checks, "stripes": _stripes}
