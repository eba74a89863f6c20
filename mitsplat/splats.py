"""Gaussian splats in memory: the one statement of mitsplat's conventions.

* World: right-handed, z up, metres, kilograms, seconds.
* Cameras: OpenCV (x right, y down, z forward); pixel centres at +0.5.
* ``a_from_b`` names a transform that takes b-coordinates to a-coordinates.
* Quaternions: xyzw in memory (as Mitsuba, Warp and SciPy), wxyz in 3DGS files.
* ``Splats`` holds activated values (scales in metres, opacities in [0, 1]); files hold logarithms and logits.
* Colours of splats are display-encoded: they are blended encoded and linearised afterwards.
* Spherical harmonics: real, with the Condon-Shortley phase, ordered ``(l, m) = (0, 0), (1, -1), (1, 0), (1, 1), ...``
  as in 3DGS, evaluated for the direction from the camera to the Gaussian.
* Instance ids: 0 is the environment, objects count from 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mitsplat.errors import InputError

FloatArray = npt.NDArray[np.float32]

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


@dataclass(frozen=True, eq=False)
class Splats:
    """A set of N anisotropic 3D Gaussians with view-dependent colour (Kerbl et al. 2023, 3DGS).

    Arrays are copied to contiguous float32 and frozen; quaternions are normalised.

    Attributes:
        means: Gaussian centres [m], shape (N, 3).
        quats: Orientations, xyzw unit quaternions, shape (N, 4).
        scales: Standard deviations along the local axes [m], shape (N, 3), > 0.
        opacities: Peak opacity in [0, 1], shape (N,).
        sh: Spherical-harmonic coefficients of the display-encoded colour in 3DGS order, shape (N, K, 3) with
            K = 1, 4, 9 or 16: colour = max(0, 0.5 + sum_k sh[k] Y_k(direction)), direction from camera to Gaussian.

    Raises:
        ValueError: If a shape is wrong or a value breaks its rule; the sentence names field, rule, value and row.
    """

    means: FloatArray
    quats: FloatArray
    scales: FloatArray
    opacities: FloatArray
    sh: FloatArray

    def __post_init__(self) -> None:
        with np.errstate(over="ignore"):  # beyond float32 becomes inf, which the rules below refuse
            arrays = {f.name: np.array(getattr(self, f.name), dtype=np.float32, order="C") for f in fields(self)}
        count = len(arrays["means"]) if arrays["means"].ndim else 0
        for name, row in (("means", (3,)), ("quats", (4,)), ("scales", (3,)), ("opacities", ())):
            if arrays[name].shape != (count, *row):
                raise InputError(f"{name} must have shape {(count, *row)} (got {arrays[name].shape})")
        if arrays["sh"].shape not in [(count, k, 3) for k in (1, 4, 9, 16)]:
            raise InputError(f"sh must have shape ({count}, 1, 4, 9 or 16, 3) (got {arrays['sh'].shape})")
        quats, scales, opacities = arrays["quats"], arrays["scales"], arrays["opacities"]
        for name in ("means", "quats", "sh"):
            _require(np.isfinite(arrays[name]), name, "finite", arrays[name])
        _require(np.isfinite(scales) & (scales > 0), "scales", "finite and > 0", scales)
        _require((opacities >= 0) & (opacities <= 1), "opacities", "in [0, 1]", opacities)
        norms = np.linalg.norm(quats.astype(np.float64), axis=1)
        _require(norms > 1e-12, "quats", "of non-zero length", norms)
        # Unit quaternions keep their bits, so that copying a splat any number of times changes nothing.
        norms[np.abs(norms - 1.0) < 1e-6] = 1.0
        arrays["quats"] = (quats / norms[:, None]).astype(np.float32)
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest coordinates of the centres [m], shape (2, 3).

        Raises:
            ValueError: If there are no Gaussians.
        """
        if not len(self):
            raise ValueError("bounds need at least one Gaussian (got 0)")
        return np.stack([self.means.min(axis=0), self.means.max(axis=0)])

    @classmethod
    def load(cls, path: str | PathLike[str], *, units: float = 1.0) -> Splats:
        """Read a file; :mod:`mitsplat.formats` says which formats there are and what each one keeps.

        Args:
            path: A ``.ply``, ``.compressed.ply``, ``.splat``, ``.ksplat``, ``.spz`` or ``.sog`` file.
            units: Metres per unit of the file.

        Raises:
            InputError: If the file is missing, of another kind, damaged, or holds a value that breaks a rule.
        """
        from mitsplat import formats  # it builds Splats, so it cannot be imported above

        splats = formats.read_splats(Path(path))
        return splats if units == 1.0 else splats.transformed(np.diag([units, units, units, 1.0]))

    def save(self, path: str | PathLike[str]) -> None:
        """Write a 3DGS ``.ply`` (lossless to float32 rounding), a ``.splat`` or an ``.spz`` (both quantised).

        Raises:
            InputError: If the suffix is another one, the format cannot hold these splats, or the file cannot be
                written; no partial file is left.
        """
        from mitsplat import formats

        formats.write_splats(self, Path(path))

    def select(self, index: Any) -> Splats:
        """The Gaussians that a Boolean mask (N,), an integer array or a slice picks, in its order."""
        rows = index if isinstance(index, slice) else np.atleast_1d(np.asarray(index))
        return Splats(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def transformed(self, matrix: npt.ArrayLike) -> Splats:
        """These splats after a similarity transform; colours turn with the object.

        Args:
            matrix: ``new_from_old``: rotation, uniform scale and translation [m], shape (4, 4).

        Raises:
            ValueError: If the matrix shears, mirrors, or scales unevenly, all of which would leave the set of
                Gaussians with orthonormal axes or of band-limited colours.
        """
        rotation, scale, translation = split_similarity(matrix)
        turn = Rotation.from_matrix(rotation)
        sh = np.tensordot(self.sh, sh_rotation(rotation, self.sh_degree).astype(np.float32), axes=([1], [1]))
        return Splats(
            means=(self.means.astype(np.float64) @ (scale * rotation).T + translation).astype(np.float32),
            quats=(turn * Rotation.from_quat(self.quats)).as_quat() if len(self) else self.quats,
            scales=(self.scales.astype(np.float64) * scale).astype(np.float32),
            opacities=self.opacities,
            sh=sh.transpose(0, 2, 1),
        )

    @staticmethod
    def concatenate(parts: Sequence[Splats]) -> Splats:
        """All Gaussians of ``parts`` in order; lower SH degrees are padded with zeros to the highest.

        Raises:
            ValueError: If ``parts`` is empty.
        """
        if not parts:
            raise ValueError("concatenate needs at least one Splats (got none)")
        width = max(part.sh.shape[1] for part in parts)
        padded = [np.pad(part.sh, ((0, 0), (0, width - part.sh.shape[1]), (0, 0))) for part in parts]
        joined = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Splats) if f.name != "sh"}
        return Splats(**joined, sh=np.concatenate(padded))


def sh_basis(directions: npt.ArrayLike, degree: int) -> npt.NDArray[np.float64]:
    """Real spherical harmonics in the order and with the signs of 3DGS.

    Constants and polynomials are those of 3DGS's ``eval_sh`` (Kerbl et al. 2023; after Sloan 2008, "Stupid Spherical
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


def evaluate_sh(sh: npt.ArrayLike, directions: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Display-encoded colours ``max(0, 0.5 + sum_k sh[k] Y_k(direction))``.

    Args:
        sh: Coefficients, shape (..., K, 3) with K = 1, 4, 9 or 16.
        directions: Unit vectors from the camera to the Gaussian, shape (..., 3); both broadcast.

    Returns:
        Colours, shape (..., 3).
    """
    coefficients = np.asarray(sh, dtype=np.float64)
    basis = sh_basis(directions, int(np.sqrt(coefficients.shape[-2])) - 1)
    colours: npt.NDArray[np.float64] = np.maximum(0.0, 0.5 + np.einsum("...k,...kc->...c", basis, coefficients))
    return colours


def sh_rotation(rotation: npt.ArrayLike, degree: int) -> npt.NDArray[np.float64]:
    """Matrix that turns SH coefficients with an object: ``sum_k (D sh)_k Y_k(R d) = sum_k sh_k Y_k(d)`` for every d.

    A rotation maps each band onto itself (Sloan 2008), so ``Y(R^T d)`` is an exact linear function of ``Y(d)``, and
    the least-squares fit over well-spread directions finds it to rounding; the result is block diagonal.

    Args:
        rotation: Rotation matrix ``new_from_old``, shape (3, 3).
        degree: Highest band, 0 to 3.

    Returns:
        Matrix of shape (K, K), K = (degree + 1)^2; the new coefficients are ``D @ sh``.
    """
    # Fibonacci sphere: 64 directions determine 16 functions with a condition number near 1.
    index = np.arange(64) + 0.5
    azimuth, z = index * np.pi * (1.0 + np.sqrt(5.0)), 1.0 - index / 32.0
    radius = np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    turned = sh_basis(directions @ np.asarray(rotation, dtype=np.float64), degree)
    solution = np.linalg.pinv(sh_basis(directions, degree)) @ turned
    return np.asarray(solution, dtype=np.float64)


def split_similarity(matrix: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], float, npt.NDArray[np.float64]]:
    """Rotation (3, 3), uniform scale and translation (3,) of a similarity transform (4, 4).

    Raises:
        ValueError: If the matrix is not finite, or not a rotation with a uniform scale and a translation.
    """
    matrix = np.asarray(matrix, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise ValueError("a transform must be a finite 4x4 matrix whose last row is 0 0 0 1")
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    if determinant <= 0:
        raise ValueError(f"a transform must neither mirror nor flatten (got determinant {determinant:.6g})")
    scale = float(np.cbrt(determinant))
    rotation = linear / scale
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > 1e-4:
        raise ValueError(f"a transform must scale uniformly and not shear (R R^T differs from 1 by {error:.3g})")
    u, _, vt = np.linalg.svd(rotation)  # nearest rotation: inputs are often float32
    return u @ vt, scale, matrix[:3, 3]


def _require(valid: npt.NDArray[np.bool_], name: str, rule: str, values: npt.NDArray[Any]) -> None:
    """Raise InputError that names the first row of ``values`` (N, ...) where ``valid`` (N, ...) does not hold."""
    if not valid.all():
        place = np.unravel_index(int(np.argmin(valid)), valid.shape)
        raise InputError(f"{name} must be {rule} (got {values[place]:.6g} at row {place[0]})")
