"""Verification of a bake: its splats compared with pictures of the mesh and with the textures of its file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.progress import Progress
from mitsplat.renderer.layers import render_splats

PictureFunction = Callable[[Camera, int, int], tuple[Float64Array, Float64Array]]
"""Function of a camera, the rays per pixel and a seed that returns a linear picture (H, W, 3) and coverage (H, W)."""
_SAMPLES_PER_PART = 4000
_MAX_SIGMAS = 3.0
"""Distance to the next Gaussian, in its standard deviations, beyond which a point of the mesh counts as hidden."""


@dataclass(frozen=True, eq=False)
class BakedView:
    """One view of the mesh and of its splats.

    Attributes:
        mesh: Picture of the mesh, display-encoded, with black background, shape (H, W, 3).
        splats: Picture of the splats in the same encoding, shape (H, W, 3).
        cover: Fraction of each pixel that the mesh covers, shape (H, W).
        psnr: PSNR of the whole picture [dB].
    """

    mesh: Float64Array
    splats: Float64Array
    cover: Float64Array
    psnr: float


def compare_views(
    picture: PictureFunction,
    splats: Splats,
    cameras: Sequence[Camera],
    samples: int,
    seed: int,
    progress: Progress,
) -> tuple[tuple[BakedView, ...], float, float]:
    """Compare the mesh and the splats in several views.

    Args:
        picture: Function that renders the mesh.
        splats: Splats of the mesh.
        cameras: The views.
        samples: Rays per pixel of the pictures.
        seed: Seed of the pictures.
        progress: Progress callback.

    Returns:
        The views, the PSNR of whole images [dB], and the PSNR of the mesh's pixels alone [dB].
    """
    views, errors, on_object = [], [], []
    for number, camera in enumerate(cameras):
        progress(number, len(cameras), "comparing with the mesh")
        truth, cover = picture(camera, samples, seed + number)
        mesh, shown = (np.clip(encode_srgb(rgb), 0, 1) for rgb in (truth, render_splats(splats, camera).rgb))
        error = (shown - mesh) ** 2
        errors.append(error.mean())
        on_object.append(error[cover > 0].mean() if cover.any() else np.nan)
        views.append(BakedView(mesh, shown, cover, psnr_of(float(error.mean()))))
    return tuple(views), psnr_of(float(np.mean(errors))), psnr_of(float(np.nanmean(on_object)))


def compare_with_textures(parts: Sequence[MeshPart], splats: Splats) -> float | None:
    """Return the brightness of the splats relative to the textures of a mesh at points of its surface.

    The textures are used without the factors of the materials.

    Args:
        parts: Parts of the mesh.
        splats: Splats with the base colours of the mesh.

    Returns:
        The ratio, or None without textures.
    """
    points, normals, colours = [], [], []
    for part in parts:
        if part.texture is None or not part.mesh.area > 0:
            continue
        at, face = trimesh.sample.sample_surface(part.mesh, _SAMPLES_PER_PART, seed=0)
        barycentric = trimesh.triangles.points_to_barycentric(part.mesh.triangles[face], at)
        points.append(at)
        normals.append(part.mesh.face_normals[face])
        colours.append(decode_srgb(part.texture.at(face, barycentric) / 255.0))
    if not points:
        return None
    place, normal, texture = (np.concatenate(values) for values in (points, normals, colours))
    distance, nearest = KDTree(splats.means).query(place)
    outward = Rotation.from_quat(splats.quats[nearest]).as_matrix()[:, :, 2]
    seen = (distance < _MAX_SIGMAS * splats.scales[nearest].max(axis=1)) & (
        np.einsum("nd,nd->n", outward, normal) > 0.7
    )
    baked = 0.5 + SH_C0 * splats.sh[nearest, 0]
    expected = texture[seen].mean() if seen.any() else 0.0
    return float(decode_srgb(baked)[seen].mean() / expected) if expected > 0 else None
