"""Real spherical harmonics of 3DGS: basis functions, colours and rotation."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import AnyArray, Float32Array, Float64Array
from mitsplat.geometry.camera_poses import spiral
from mitsplat.images.colour import encode_srgb

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi))."""
_SH_C1 = 0.4886025119029199
_SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def rgb_to_sh(colours: AnyArray) -> AnyArray:
    """Return the constant coefficients (..., 3) of display-encoded colours (..., 3)."""
    return (colours - 0.5) / SH_C0


def sh_to_rgb(constant: AnyArray) -> AnyArray:
    """Return the display-encoded colours (..., 3) of constant coefficients (..., 3), without view dependence."""
    return 0.5 + SH_C0 * constant


def sh_basis(directions: npt.ArrayLike, degree: int) -> Float64Array:
    """Evaluate the real spherical harmonics in the order and with the signs of 3DGS.

    Constants and polynomials are those of ``eval_sh`` of 3DGS (Kerbl et al. 2023; after Sloan 2008, "Stupid Spherical
    Harmonics Tricks", appendix A2).

    Args:
        directions: Unit vectors, shape (..., 3).
        degree: Highest band, 0 to 3.

    Returns:
        ``Y_k(direction)``, shape (..., K) with K = (degree + 1)^2.

    Raises:
        ValueError: If the degree is not 0, 1, 2 or 3.
    """
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree must be 0, 1, 2 or 3 (got {degree})")
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        np.full_like(x, SH_C0),
        -_SH_C1 * y,
        _SH_C1 * z,
        -_SH_C1 * x,
        _SH_C2[0] * x * y,
        _SH_C2[1] * y * z,
        _SH_C2[2] * (2 * zz - xx - yy),
        _SH_C2[3] * x * z,
        _SH_C2[4] * (xx - yy),
        _SH_C3[0] * y * (3 * xx - yy),
        _SH_C3[1] * x * y * z,
        _SH_C3[2] * y * (4 * zz - xx - yy),
        _SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
        _SH_C3[4] * x * (4 * zz - xx - yy),
        _SH_C3[5] * z * (xx - yy),
        _SH_C3[6] * x * (xx - 3 * yy),
    ]
    return np.stack(bands[: (degree + 1) ** 2], axis=-1)


def evaluate_sh(sh: npt.ArrayLike, directions: npt.ArrayLike) -> Float64Array:
    """Compute display-encoded colours ``max(0, 0.5 + sum_k sh[k] Y_k(direction))``.

    Args:
        sh: Coefficients, shape (..., K, 3) with K = 1, 4, 9 or 16.
        directions: Unit vectors from the camera to the Gaussian, shape (..., 3); both broadcast.

    Returns:
        Colours, shape (..., 3).
    """
    coefficients = np.asarray(sh, dtype=np.float64)
    basis = sh_basis(directions, int(np.sqrt(coefficients.shape[-2])) - 1)
    colours: Float64Array = np.maximum(0.0, 0.5 + np.einsum("...k,...kc->...c", basis, coefficients))
    return colours


def sh_rotation(rotation: npt.ArrayLike, degree: int) -> Float64Array:
    """Return the matrix that rotates SH coefficients with an object.

    It fulfils ``sum_k (D sh)_k Y_k(R d) = sum_k sh_k Y_k(d)`` for every d. A rotation maps each band onto itself (Sloan
    2008), so ``Y(R^T d)`` is an exact linear function of ``Y(d)``. A least-squares fit over well-spread directions
    therefore finds the matrix to rounding precision; it is block diagonal.

    Args:
        rotation: Rotation matrix ``new_from_old``, shape (3, 3).
        degree: Highest band, 0 to 3.

    Returns:
        Matrix D of shape (K, K), K = (degree + 1)^2; the new coefficients are ``D @ sh``.
    """
    # 64 directions determine 16 functions with a condition number near 1.
    directions = spiral(1.0 - 2.0 * (np.arange(64) + 0.5) / 64)
    turned = sh_basis(directions @ np.asarray(rotation, dtype=np.float64), degree)
    solution = np.linalg.pinv(sh_basis(directions, degree)) @ turned
    return np.asarray(solution, dtype=np.float64)


def encode_sh(sh: Float32Array) -> Float32Array:
    """Return coefficients (N, K, 3) of display-encoded colours from those of linear colours.

    The constant band is exact. The others are multiplied by the slope of the encoding at the mean colour.
    """
    mean, step = np.maximum(sh_to_rgb(sh[:, :1].astype(np.float64)), 0.0), 1e-4
    slope = (encode_srgb(mean + step) - encode_srgb(np.maximum(mean - step, 0))) / (
        mean + step - np.maximum(mean - step, 0)
    )
    return np.concatenate([rgb_to_sh(encode_srgb(mean)), slope * sh[:, 1:]], axis=1).astype(np.float32)
