"""Material parameters of Gaussians, as in Mitsuba's BSDF ``principled``.

The base colour is the colour of the splats. It is display-encoded like every colour of splats, and does not depend on
the direction. The other parameters are those of ``principled``; its parameters that are not listed keep their defaults.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array
from mitsplat.errors import InputError

MAX_SPECULAR = 0.08
"""Reflectance of a dielectric at normal incidence with ``specular`` 1."""


@dataclass(frozen=True, eq=False)
class SplatMaterials:
    """Material parameters of N Gaussians; arrays are copied to float32 and made read-only.

    Attributes:
        metallic: 0 for dielectrics to 1 for metals, shape (N,).
        roughness: Square root of the GGX parameter alpha, in [0, 1], shape (N,).
        specular: Reflectance of dielectrics at normal incidence over 0.08, in [0, 1], shape (N,). 0 is matt.
        normals: Unit shading normals in the frame of the splats, shape (N, 3), or None for those of the mesh.

    Raises:
        InputError: If an array has a wrong shape or a value outside of its range.
    """

    metallic: Float32Array
    roughness: Float32Array
    specular: Float32Array
    normals: Float32Array | None = None

    def __post_init__(self) -> None:
        for name in ("metallic", "roughness", "specular"):
            values = np.array(getattr(self, name), dtype=np.float32)
            if values.shape != (len(self.metallic),):
                raise InputError(f"{name} must have shape {(len(self.metallic),)} (got {values.shape})")
            wrong = ~((values >= 0) & (values <= 1))
            if wrong.any():
                row = int(np.argmax(wrong))
                raise InputError(f"{name} must be in [0, 1] (got {values[row]:.6g} at row {row})")
            self._store(name, values)
        if self.normals is not None:
            normals = np.array(self.normals, dtype=np.float32)
            if normals.shape != (len(self.metallic), 3):
                raise InputError(f"normals must have shape {(len(self.metallic), 3)} (got {normals.shape})")
            lengths = np.linalg.norm(normals, axis=1)
            wrong = ~(np.abs(lengths - 1) < 1e-2)
            if wrong.any():
                row = int(np.argmax(wrong))
                raise InputError(f"normals must have length 1 (got {lengths[row]:.6g} at row {row})")
            self._store("normals", normals / lengths[:, None])

    def _store(self, name: str, values: Float32Array) -> None:
        values.flags.writeable = False
        object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.metallic)

    @classmethod
    def uniform(cls, count: int, *, metallic: float = 0.0, roughness: float = 0.5, specular: float = 0.5) -> Self:
        """Return the same material for ``count`` Gaussians; the defaults are those of ``principled``."""
        return cls(*[np.full(count, value, np.float32) for value in (metallic, roughness, specular)])

    def select(self, rows: slice | npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> SplatMaterials:
        """Return the materials of the selected Gaussians."""
        normals = None if self.normals is None else self.normals[rows]
        return SplatMaterials(self.metallic[rows], self.roughness[rows], self.specular[rows], normals)

    def rotated(self, rotation: npt.ArrayLike) -> SplatMaterials:
        """Return the materials with their normals rotated by ``rotation``, shape (3, 3)."""
        if self.normals is None:
            return self
        turned = self.normals.astype(np.float64) @ np.asarray(rotation, dtype=np.float64).T
        return SplatMaterials(self.metallic, self.roughness, self.specular, turned.astype(np.float32))


def specular_of(reflectance: float) -> float:
    """Return the parameter ``specular``, at most 1, of a reflectance at normal incidence."""
    return min(reflectance / MAX_SPECULAR, 1.0)
