"""Cut-outs: faces without the texels whose alpha is below the cutoff of their material."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.mesh_files.mesh_file import FilePart, Texture

_COARSE, _FINE = 8.0, 1.0
"""Longest edges of a face [texels] at which it may be kept or dropped as a whole, and at which it is not split."""
_MAX_FACES = 200_000
"""Number of faces of a part above which faces are not split any more."""
_STEPS = 5
_GRID = np.array([(i, j, _STEPS - i - j) for i in range(_STEPS + 1) for j in range(_STEPS + 1 - i)]) / _STEPS
"""Barycentric coordinates of the tested points of a face, shape (21, 3)."""
_QUARTERS = np.array(
    [
        [[2, 0, 0], [1, 1, 0], [1, 0, 1]],
        [[1, 1, 0], [0, 2, 0], [0, 1, 1]],
        [[1, 0, 1], [0, 1, 1], [0, 0, 2]],
        [[1, 1, 0], [0, 1, 1], [1, 0, 1]],
    ]
) / 2  # fmt: skip
"""Corners of the four parts of a face in its barycentric coordinates."""


_PLAIN = 32
"""Size of the texture of parts whose colours alone have an opacity [texels]."""


def opaque_texture(count: int) -> Texture:
    """Return an opaque texture of alpha for ``count`` faces, which gives each face a grid of texels."""
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], (count, 1, 1))
    return Texture(np.full((_PLAIN, _PLAIN, 1), 255, dtype=np.uint8), uv)


def cut_out(part: FilePart, alpha: Texture, threshold: float, opacity: Float64Array | None = None) -> FilePart:
    """Return a part without the places where its alpha is below a threshold.

    Faces at a border are split until their edges are at most a texel long.

    Args:
        part: The part.
        alpha: Texture of alpha times 255, one channel.
        threshold: Alpha times 255.
        opacity: Factor of the alpha at the face corners, shape (F, 3), or None for 1.
    """
    owner, corners = np.arange(len(part.faces)), np.tile(np.eye(3), (len(part.faces), 1, 1))
    size = np.array(alpha.pixels.shape[1::-1], dtype=np.float64)
    owners, kept = [owner[:0]], [corners[:0]]
    while len(owner):
        uv = corners @ alpha.uv[owner]
        length = np.linalg.norm((uv - np.roll(uv, 1, axis=1)) * size, axis=2).max(axis=1)
        points = (0.9 * _GRID + 0.1 / 3) @ corners
        values = alpha.at(np.repeat(owner, len(_GRID)), points.reshape(-1, 3)).reshape(len(owner), -1)
        if opacity is not None:
            values = values * np.einsum("fgk,fk->fg", points, opacity[owner])
        share = (values >= threshold).mean(axis=1)
        is_last = (length <= _FINE) | (sum(map(len, owners)) + 4 * len(owner) > _MAX_FACES)
        is_last |= (length <= _COARSE) & ((share == 0) | (share == 1))
        keep = is_last & (share >= 0.5)
        owners.append(owner[keep])
        kept.append(corners[keep])
        owner, corners = np.repeat(owner[~is_last], 4), (_QUARTERS @ corners[~is_last, None]).reshape(-1, 3, 3)
    owner, corners = np.concatenate(owners), np.concatenate(kept)

    def select(values: Float64Array) -> Float64Array:
        return np.asarray(corners @ values[owner])

    def select_texture(texture: Texture | None) -> Texture | None:
        return None if texture is None else replace(texture, uv=select(texture.uv))

    material = part.material
    return replace(
        part,
        vertices=select(part.vertices[part.faces]).reshape(-1, 3),
        faces=np.arange(3 * len(owner)).reshape(-1, 3),
        colours=None if part.colours is None else select(part.colours),
        normals=None if part.normals is None else select(part.normals),
        material=replace(
            material,
            texture=select_texture(material.texture),
            metallic_roughness=select_texture(material.metallic_roughness),
            normal_map=select_texture(material.normal_map),
        ),
    )
