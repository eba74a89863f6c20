"""Statements of splat files about their training, and the kernel that renders the splats as they were trained.

====================  ==========================================================================================
writer                statement
====================  ==========================================================================================
Mip-Splatting, GOF    PLY column ``filter_3D``: standard deviation of the 3D filter (Yu et al. 2024)
Brush, splat-         PLY comment ``SplatRenderMode:`` ``mip`` or ``default``, also in ``.compressed.ply``
transform, gsplat
Postshot              PLY comment ``antialiased 1`` or ``antialiased 0``
SPZ                   bit 0x1 of the flags: trained with antialiasing
SOG                   ``model: antialiased`` or ``antialias: true`` in ``meta.json``
====================  ==========================================================================================

Antialiasing means that the trainer widened footprints by a filter of constant light, as kernel ``mip`` does. A file
that denies it was trained with dilated footprints, as kernel ``gsplat`` has. ``.splat`` and ``.ksplat`` state nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array
from mitsplat.quality import KernelName

SPZ_ANTIALIASED = 0x1
"""Flag of SPZ files."""
SPZ_FLAGS_OFFSET = 14
"""Offset of the flags in the header of SPZ files [bytes], in all versions."""

_STATEMENT = re.compile(
    r"(?:splat_?render_?mode|rasterize_?mode|train_flags|antialias(?:ed|ing)?|anti-alias(?:ed|ing)?)\b[ \t]*[:=]?"
    r"[ \t]*(\w+)"
)
_KERNELS: dict[str, KernelName] = {
    **dict.fromkeys(("mip", "antialiased", "antialiasing", "1", "true", "yes", "on"), "mip"),
    **dict.fromkeys(("default", "classic", "0", "false", "no", "off"), "gsplat"),
    "2dgs": "exact",
}
_COMMENTS: dict[KernelName, str] = {"mip": "mip", "3dgs": "default", "gsplat": "default"}


def ply_kernel(header: bytes) -> KernelName | None:
    """Return the kernel that the comments of a PLY header state; None if they state none. The last statement counts."""
    found: KernelName | None = None
    for line in header.decode("ascii", "replace").lower().splitlines():
        word, _, text = line.strip().partition(" ")
        if word in ("comment", "obj_info") and (statement := _STATEMENT.match(text.strip())):
            found = _KERNELS.get(statement[1], found)
    return found


def ply_comment(kernel: KernelName | None) -> str:
    """Return the comment line of a PLY header that states a kernel, in the words of Brush; empty if it states none."""
    return f"comment SplatRenderMode: {_COMMENTS[kernel]}\n" if kernel in _COMMENTS else ""


def spz_kernel(header: bytes) -> KernelName | None:
    """Return the kernel that the header of an SPZ file states; without the flag it is unknown, as writers omit it."""
    is_set = len(header) > SPZ_FLAGS_OFFSET and header[SPZ_FLAGS_OFFSET] & SPZ_ANTIALIASED
    return "mip" if is_set else None


def merge_filter(
    scales: npt.NDArray[np.floating], opacities: npt.NDArray[np.floating], deviations: npt.NDArray[np.floating]
) -> tuple[Float32Array, Float32Array]:
    """Convolve Gaussians with isotropic ones of the same integral: the 3D filter of Mip-Splatting (Yu et al. 2024).

    Args:
        scales: Standard deviations, shape (N, 3).
        opacities: Peak opacities, shape (N,).
        deviations: Standard deviations of the filter in the units of ``scales``, shape (N,).

    Returns:
        Scales sqrt(s^2 + f^2), and opacities times the product of s / sqrt(s^2 + f^2).
    """
    scales = scales.astype(np.float64)
    with np.errstate(all="ignore"):  # invalid values are refused by Splats
        filtered = np.hypot(scales, deviations.astype(np.float64)[:, None])
        return filtered.astype(np.float32), (opacities * (scales / filtered).prod(axis=1)).astype(np.float32)


def trained_kernel(stated: Iterable[KernelName | None]) -> KernelName:
    """Return the kernel of a scene that states none: ``mip`` if splats were trained with antialiasing, else ``exact``.

    ``mip`` keeps the light of all splats, so other splats of the scene may share it. The dilation of ``3dgs`` and
    ``gsplat`` depends on the resolution of the training, and is used only where a scene states it.
    """
    return "mip" if "mip" in stated else "exact"
