"""Gaussian splats in memory: the one statement of mitsplat's conventions.

* World: right-handed, z up, metres, kilograms, seconds.
* Cameras: OpenCV (x right, y down, z forward); pixel centres at +0.5.
* ``a_from_b`` names a transform that takes b-coordinates to a-coordinates.
* Quaternions: xyzw in memory (as Mitsuba, Warp and SciPy), wxyz in 3DGS files.
* ``Splats`` holds activated values (scales in metres, opacities in [0, 1]); files hold logarithms and logits.
* Colours of splats are display-encoded: they are blended encoded and linearised afterwards.
* Instance ids: 0 is the environment, objects count from 1.
"""

from __future__ import annotations
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic, 1 / (2 sqrt(pi))."""


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
