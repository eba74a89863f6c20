"""Gaussian splats in memory, and the conventions of mitsplat.

* World: right-handed, z up, metres, kilograms, seconds.
* Cameras: OpenCV (x right, y down, z forward); pixel centres at +0.5.
* Transforms: ``a_from_b`` maps b-coordinates to a-coordinates.
* Quaternions: xyzw in memory (as in Mitsuba, Warp and SciPy), wxyz in 3DGS files.
* ``Splats`` holds activated values (scales in metres, opacities in [0, 1]); files hold logarithms and logits.
* Colours of splats are display-encoded: they are blended encoded and linearised afterwards.
* Spherical harmonics: real, with the Condon-Shortley phase, ordered ``(l, m) = (0, 0), (1, -1), (1, 0), (1, 1), ...``
  as in 3DGS, evaluated for the direction from the camera to the Gaussian.
* Instance ids: 0 is the environment, objects count from 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mitsplat.arguments import checks_arguments, describe, path_of, real_array
from mitsplat.arrays import AnyArray, BoolArray, Float32Array
from mitsplat.errors import InputError
from mitsplat.gaussians.material_files import read_materials
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh, sh_rotation, sh_to_rgb
from mitsplat.gaussians.splat_arrays import SplatArrays
from mitsplat.gaussians.splat_files import read_splats, write_splats
from mitsplat.gaussians.splat_materials import MAX_SPECULAR, SplatMaterials
from mitsplat.geometry.rigid import scaling, split_similarity
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.quality import KernelName


@checks_arguments
@dataclass(frozen=True, eq=False, repr=False)
class Splats:
    """Set of N anisotropic 3D Gaussians with view-dependent colour (Kerbl et al. 2023, 3DGS).

    Arrays are copied to contiguous float32 and made read-only; quaternions are normalised.

    Attributes:
        means: Gaussian centres [m], shape (N, 3).
        quats: Orientations, xyzw unit quaternions, shape (N, 4).
        scales: Standard deviations along the local axes [m], shape (N, 3), > 0.
        opacities: Peak opacity in [0, 1], shape (N,).
        sh: Spherical-harmonic coefficients of the display-encoded colour in 3DGS order, shape (N, K, 3) with K = 1, 4,
            9 or 16: colour = max(0, 0.5 + sum_k sh[k] Y_k(direction)), direction from camera to Gaussian.
        materials: Material parameters; ``sh`` then holds the base colour. None if ``sh`` holds captured radiance.
        kernel: Kernel with which the splats were trained (:class:`mitsplat.Quality`), if their file states it.

    Raises:
        ValueError: If an array has a wrong shape or an invalid value. The message names field, rule, value and row.
    """

    means: Float32Array
    quats: Float32Array
    scales: Float32Array
    opacities: Float32Array
    sh: Float32Array
    materials: SplatMaterials | None = None
    kernel: KernelName | None = None

    def __post_init__(self) -> None:
        arrays: dict[str, Float32Array] = {}
        for name in SplatArrays._fields:
            try:
                with np.errstate(over="ignore"):  # values beyond float32 become inf, which is refused below
                    arrays[name] = real_array(getattr(self, name), np.float32)
            except (TypeError, ValueError):
                raise InputError(f"{name} must be an array of numbers (got {describe(getattr(self, name))})") from None
        count = len(arrays["means"]) if arrays["means"].ndim else 0
        for name, row in (("means", (3,)), ("quats", (4,)), ("scales", (3,)), ("opacities", ())):
            if arrays[name].shape != (count, *row):
                raise InputError(f"{name} must have shape {(count, *row)} (got {arrays[name].shape})")
        if arrays["sh"].shape not in [(count, k, 3) for k in (1, 4, 9, 16)]:
            raise InputError(f"sh must have shape ({count}, 1, 4, 9 or 16, 3) (got {arrays['sh'].shape})")
        if self.materials is not None and len(self.materials) != count:
            raise InputError(f"materials must have {count} rows, one per Gaussian (got {len(self.materials)})")
        quats, scales, opacities = arrays["quats"], arrays["scales"], arrays["opacities"]
        for name in ("means", "quats", "sh"):
            _require(np.isfinite(arrays[name]), name, "finite", arrays[name])
        _require(np.isfinite(scales) & (scales > 0), "scales", "finite and > 0", scales)
        _require((opacities >= 0) & (opacities <= 1), "opacities", "in [0, 1]", opacities)
        norms = np.linalg.norm(quats.astype(np.float64), axis=1)
        _require(norms > 1e-12, "quats", "of non-zero length", norms)
        # Unit quaternions are not normalised again, so that repeated copies are bit-identical.
        norms[np.abs(norms - 1.0) < 1e-6] = 1.0
        arrays["quats"] = (quats / norms[:, None]).astype(np.float32)
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        colours = f"captured colours of degree {self.sh_degree}" if self.materials is None else "materials"
        return f"Splats({len(self)} Gaussians, {colours})"

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return int(np.sqrt(self.sh.shape[1])) - 1

    @property
    def bounds(self) -> Float32Array:
        """Minimum and maximum coordinates of the centres [m], shape (2, 3).

        Raises:
            ValueError: If there are no Gaussians.
        """
        if not len(self):
            raise ValueError("bounds need at least one Gaussian (got 0)")
        return np.stack([self.means.min(axis=0), self.means.max(axis=0)])

    @classmethod
    def load(
        cls, path: str | PathLike[str], *, units: float = 1.0, materials: str | PathLike[str] | None = None
    ) -> Splats:
        """Read a splat file. :mod:`mitsplat.gaussians.splat_files` lists the formats and their precision.

        Args:
            path: A ``.ply``, ``.compressed.ply``, ``.splat``, ``.ksplat``, ``.spz`` or ``.sog`` file.
            units: Metres per unit of the file.
            materials: File of the materials of the Gaussians (:mod:`mitsplat.gaussians.material_files`), if any.

        Raises:
            InputError: If a file is missing, of another kind, or damaged, or if it holds an invalid value; or if splats
                with materials have view-dependent colours.
        """
        arrays, kernel = read_splats(path_of(path, "path"))
        try:
            splats = cls(**arrays._asdict(), kernel=kernel)
        except ValueError as error:
            remedy = ": remove such Gaussians, as SuperSplat and splat-transform do" if " at row " in str(error) else ""
            raise InputError(f"{path}: {error}{remedy}") from error
        if materials is not None:
            splats = replace(splats, materials=read_materials(Path(materials), len(splats)))
            if splats.sh_degree:
                raise InputError(f"{path}: splats with materials must have SH degree 0 (got {splats.sh_degree})")
        return splats if units == 1.0 else splats.transformed(scaling(units))

    def save(self, path: str | PathLike[str]) -> None:
        """Write a 3DGS ``.ply`` (lossless to float32 rounding), a ``.splat`` or an ``.spz`` (both quantised).

        Raises:
            InputError: If the suffix is unknown, the format cannot hold these splats, or the file cannot be written. No
                partial file remains.
        """
        arrays = SplatArrays(self.means, self.quats, self.scales, self.opacities, self.sh)
        write_splats(arrays, path_of(path, "path"), self.kernel)

    def select(self, index: slice | npt.ArrayLike) -> Splats:
        """Return the Gaussians selected by a Boolean mask (N,), an integer array or a slice, in its order."""
        rows = index if isinstance(index, slice) else _rows_of(index, len(self))
        arrays = {name: getattr(self, name)[rows] for name in SplatArrays._fields}
        materials = None if self.materials is None else self.materials.select(rows)
        return Splats(**arrays, materials=materials, kernel=self.kernel)

    def transformed(self, matrix: npt.ArrayLike) -> Splats:
        """Return the splats after a similarity transform. Their view-dependent colours rotate with them.

        Args:
            matrix: ``new_from_old``: rotation, uniform scale and translation [m], shape (4, 4).

        Raises:
            ValueError: If the matrix shears, mirrors or scales non-uniformly. Gaussians with orthonormal axes and
                band-limited colours cannot represent the result.
        """
        rotation, scale, translation = split_similarity(matrix)
        turn = Rotation.from_matrix(rotation)
        return Splats(
            means=(self.means.astype(np.float64) @ (scale * rotation).T + translation).astype(np.float32),
            quats=(turn * Rotation.from_quat(self.quats)).as_quat() if len(self) else self.quats,
            scales=(self.scales.astype(np.float64) * scale).astype(np.float32),
            opacities=self.opacities,
            sh=sh_rotation(rotation, self.sh_degree).astype(np.float32) @ self.sh,
            materials=None if self.materials is None else self.materials.rotated(rotation),
            kernel=self.kernel,
        )

    def with_material(self, *, metallic: float = 0.0, roughness: float = 0.5, specular: float = 0.5) -> Splats:
        """Return the splats with one material, whose base colours follow from their colours without view dependence.

        Captured colours contain the uniform light that dielectrics mirror, about their reflectance at normal incidence.

        Raises:
            InputError: If a parameter is outside of [0, 1].
        """
        materials = SplatMaterials.uniform(len(self), metallic=metallic, roughness=roughness, specular=specular)
        sh, mirrored = self.sh[:, :1], (1 - metallic) * MAX_SPECULAR * specular
        if mirrored > 0:
            sh = rgb_to_sh(encode_srgb(decode_srgb(sh_to_rgb(sh)) - mirrored)).astype(np.float32)
        return replace(self, sh=sh, materials=materials)

    @staticmethod
    def concatenate(parts: Sequence[Splats]) -> Splats:
        """Return all Gaussians of ``parts`` in order, without materials.

        Lower SH degrees are padded with zeros to the highest. The kernel is that of all parts, or None if they differ.

        Raises:
            ValueError: If ``parts`` is empty.
        """
        if not parts:
            raise ValueError("concatenate needs at least one Splats (got none)")
        width = max(part.sh.shape[1] for part in parts)
        padded = [np.pad(part.sh, ((0, 0), (0, width - part.sh.shape[1]), (0, 0))) for part in parts]
        names = [name for name in SplatArrays._fields if name != "sh"]
        joined: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        kernels = {part.kernel for part in parts}
        return Splats(**joined, sh=np.concatenate(padded), kernel=kernels.pop() if len(kernels) == 1 else None)


def _rows_of(index: npt.ArrayLike, count: int) -> AnyArray:
    """Return a mask or whole numbers that select among ``count`` rows.

    Raises:
        InputError: If it is another array, or has another length, or selects a missing row.
    """
    rows = np.atleast_1d(np.asarray(index))
    if np.ma.is_masked(index):
        raise InputError(f"index must have no masked values (got {describe(index)})")
    if not rows.size:
        return np.zeros(0, dtype=np.int64)
    if rows.dtype.kind not in "biu":
        raise InputError(f"index must be a mask, whole numbers or a slice (got {describe(index)})")
    if rows.dtype.kind == "b":
        if rows.shape != (count,):
            raise InputError(f"a mask must have shape ({count},) (got {rows.shape})")
    elif not -count <= rows.min() <= rows.max() < count:
        raise InputError(f"index must be in 0 to {count - 1} (got {rows.min()} to {rows.max()})")
    return rows


def _require(valid: BoolArray, name: str, rule: str, values: AnyArray) -> None:
    """Raise an InputError that names the first row of ``values`` (N, ...) for which ``valid`` (N, ...) is false."""
    if not valid.all():
        place = np.unravel_index(int(np.argmin(valid)), valid.shape)
        raise InputError(f"{name} must be {rule} (got {values[place]:.6g} at row {place[0]})")
