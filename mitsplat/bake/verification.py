"""Verification of a bake: its splats compared with pictures of the mesh and with the textures of its file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.gaussians.spherical_harmonics import sh_to_rgb
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.progress import Progress
from mitsplat.renderer.layers import render_splats

PictureFunction = Callable[[Camera, int, int], tuple[Float64Array, Float64Array]]
"""Function of a camera, the rays per pixel and a seed that returns a linear picture (H, W, 3) and coverage (H, W)."""


class MeshPictures(NamedTuple):
    """Pictures of a mesh, to which its Gaussians are fitted and with which they are compared.

    Attributes:
        render: Function that renders the mesh.
        fit_samples, comparison_samples: Rays per pixel of the pictures for the fit and for the comparison.
    """

    render: PictureFunction
    fit_samples: int
    comparison_samples: int


_SAMPLES_PER_PART = 4000
_MAX_SIGMAS = 3.0
"""Distance to the next Gaussian, in its standard deviations, beyond which a point of the mesh counts as hidden."""
_MIN_SEEN = 100
"""Minimum number of visible samples of a part that is compared with its texture."""
_DARK = 0.01
"""Difference of linear colours that is not visible."""
_MIN_BRIGHTNESS, _MAX_BRIGHTNESS = 0.8, 1.25
"""Range of brightness relative to the textures that the size of the Gaussians can explain."""


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
    pictures: MeshPictures, splats: Splats, cameras: Sequence[Camera], seed: int, progress: Progress
) -> tuple[tuple[BakedView, ...], float, float]:
    """Compare the mesh and the splats in several views.

    Args:
        pictures: Pictures of the mesh.
        splats: Splats of the mesh.
        cameras: The views.
        seed: Seed of the pictures.
        progress: Progress callback.

    Returns:
        The views, the PSNR of whole images [dB], and the PSNR of the mesh's pixels alone [dB].
    """
    views, errors, on_object = [], [], []
    for number, camera in enumerate(cameras):
        progress(number, len(cameras), "comparing with the mesh")
        truth, cover = pictures.render(camera, pictures.comparison_samples, seed + number)
        mesh, shown = (np.clip(encode_srgb(rgb), 0, 1) for rgb in (truth, render_splats(splats, camera).rgb))
        error = (shown - mesh) ** 2
        errors.append(error.mean())
        on_object.append(error[cover > 0].mean() if cover.any() else np.nan)
        views.append(BakedView(mesh, shown, cover, psnr_of(float(error.mean()))))
    return tuple(views), psnr_of(float(np.mean(errors))), psnr_of(float(np.nanmean(on_object)))


def compare_with_textures(
    parts: Sequence[MeshPart], splats: Splats, owners: Int64Array
) -> tuple[float | None, dict[str, float]]:
    """Compare the brightness of the splats with that of the textures of a mesh at points of its surface.

    The textures are used without the factors of the materials.

    Args:
        parts: Parts of the mesh.
        splats: Splats with the base colours of the mesh.
        owners: Position of the part of each splat, shape (N,).

    Returns:
        The ratio of all parts, or None without textures; and the ratio of each visible part that differs, by its name.
    """
    tree, outward = KDTree(splats.means), Rotation.from_quat(splats.quats).as_matrix()[:, :, 2]
    reach, shown = _MAX_SIGMAS * splats.scales.max(axis=1), decode_srgb(sh_to_rgb(splats.sh[:, 0]))
    sums, different = np.zeros(2), {}
    for number, part in enumerate(parts):
        if part.texture is None or not part.mesh.area > 0:
            continue
        at, face = trimesh.sample.sample_surface(part.mesh, _SAMPLES_PER_PART, seed=0)
        barycentric = trimesh.triangles.points_to_barycentric(part.mesh.triangles[face], at)
        distance, nearest = tree.query(at)
        cosine = np.einsum("nd,nd->n", outward[nearest], part.mesh.face_normals[face])
        seen = (distance < reach[nearest]) & (cosine > 0.7) & (owners[nearest] == number)
        if np.count_nonzero(seen) < _MIN_SEEN:
            continue
        texture = decode_srgb(part.texture.at(face, barycentric) / 255.0)[seen]
        means = np.array([shown[nearest][seen].mean(), texture.mean()])
        sums += part.mesh.area * seen.mean() * means
        ratio = means[0] / max(means[1], _DARK)
        if np.ptp(means) > _DARK and not _MIN_BRIGHTNESS < ratio < _MAX_BRIGHTNESS:
            different[part.name] = float(ratio)
    return (float(sums[0] / sums[1]) if sums[1] > 0 else None), different
