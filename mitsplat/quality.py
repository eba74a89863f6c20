"""Presets that trade speed against accuracy in the splat renderer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from mitsplat.errors import InputError

KernelName = Literal["exact", "mip", "3dgs", "gsplat"]
ResponseName = Literal["perspective", "ewa"]
PresetName = Literal["fast", "balanced", "exact"]
Order = Literal["tile", "window", "ray"]
Samples = int | Literal["edges"]


@dataclass(frozen=True)
class Kernel:
    """How a Gaussian's footprint on the image differs from the Gaussian itself.

    Attributes:
        variance: What is added to the footprint's covariance [px^2].
        keeps_light: Whether opacity falls as the footprint grows, so that the light of small Gaussians stays the same.
        alpha_max: Highest opacity of one Gaussian along a ray.
    """

    variance: float
    keeps_light: bool
    alpha_max: float


KERNELS: dict[KernelName, Kernel] = {
    "exact": Kernel(0.0, True, 1.0),
    "mip": Kernel(1.0 / 12.0, True, 1.0),
    "3dgs": Kernel(0.3, False, 0.99),
    "gsplat": Kernel(0.3, False, 0.999),
}


@dataclass(frozen=True)
class Quality:
    """What the renderer computes for one ray; every field that is cheaper is also less exact.

    Attributes:
        response: Gaussians along every perspective ray (``perspective``), or along rays that are parallel within one
            Gaussian's footprint, as trainers linearise the projection (``ewa``; Zwicker et al. 2002).
        kernel: ``exact`` evaluates the Gaussian itself at the pixel's centre. ``mip`` widens footprints by the variance
            of a pixel, so that small Gaussians do not sparkle (2-D Mip filter, Yu et al. 2024). ``3dgs`` and ``gsplat``
            dilate and limit opacity as those trainers do.
        tolerance: Error of a display-encoded colour that the order of blending may make. Infinite: Gaussians are
            blended in the order of their peaks along one ray of every tile of 8 x 4 pixels. 0: along every pixel's own
            ray. Between: along one ray with an estimate of the error, nearly along every ray in tiles where that
            exceeds the tolerance, and quite so where it still does; a few pixels err by more.
        alpha_min: A Gaussian is cut where its opacity along a ray falls below this. 3DGS trains with 1/255.
        transmittance_min: A ray ends when less than this share of the light behind would still be seen.
        extends: Whether what a ray has not seen because it ended counts as the mean of what it has seen, and not as
            nothing, by which it mostly is nearer to a ray that goes on.
        amends: Whether, where the tolerance is infinite, a Gaussian that comes later in its tile's order than along the
            ray takes its share of the colour from what it hides, as far as a few sums tell what that is. Opacities,
            depths and instances stay those of the tile's order.
        sh_degree: Highest spherical-harmonic band that is evaluated.
        samples: Rays per pixel along each axis (n x n on a regular grid, box-filtered); ``edges`` for one, and 2 x 2
            where instances border on each other, see :mod:`mitsplat.renderer.splatting.antialiasing`.
        lens_rings: Rings of points around the centre of a thin lens that are looked through: 1, 2, 3 take 7, 19, 37
            images. Where blur is wide, its points stand apart, and more rings make it smooth.
    """

    response: ResponseName = "perspective"
    kernel: KernelName = "exact"
    tolerance: float = math.inf
    alpha_min: float = 1.0 / 255.0
    transmittance_min: float = 1e-3
    extends: bool = False
    amends: bool = False
    sh_degree: int = 3
    samples: Samples = 1
    lens_rings: int = 2

    def __post_init__(self) -> None:
        if self.response not in ("perspective", "ewa"):
            raise InputError(f"quality: response must be 'perspective' or 'ewa' (got {self.response!r})")
        if self.kernel not in KERNELS:
            raise InputError(f"quality: kernel must be one of {', '.join(KERNELS)} (got {self.kernel!r})")
        if not self.tolerance >= 0.0:
            raise InputError(f"quality: tolerance must be at least 0 (got {self.tolerance})")
        if not 0.0 < self.alpha_min < 1.0:
            raise InputError(f"quality: alpha_min must be between 0 and 1 (got {self.alpha_min})")
        if not 0.0 <= self.transmittance_min < 1.0:
            raise InputError(f"quality: transmittance_min must be in [0, 1) (got {self.transmittance_min})")
        if self.sh_degree not in (0, 1, 2, 3):
            raise InputError(f"quality: sh_degree must be 0, 1, 2 or 3 (got {self.sh_degree})")
        if self.samples != "edges" and (type(self.samples) is not int or not 1 <= self.samples <= 8):
            raise InputError(f"quality: samples must be from 1 to 8, or 'edges' (got {self.samples!r})")
        if type(self.lens_rings) is not int or not 1 <= self.lens_rings <= 8:
            raise InputError(f"quality: lens_rings must be from 1 to 8 (got {self.lens_rings})")

    @property
    def grid(self) -> int:
        """Rays of every pixel along each axis."""
        return 1 if self.samples == "edges" else self.samples

    @property
    def order(self) -> Order:
        """How rays walk the lists of their tiles before any are repaired."""
        return "ray" if self.tolerance == 0 else "tile" if math.isinf(self.tolerance) else "window"


PRESETS: dict[PresetName, Quality] = {
    "fast": Quality(alpha_min=3e-3, transmittance_min=2e-2, extends=True, amends=True, sh_degree=2),
    "balanced": Quality(tolerance=1.5e-2, alpha_min=1e-3, transmittance_min=5e-3, extends=True),
    "exact": Quality(tolerance=0.0, alpha_min=1e-5, transmittance_min=1e-6),
}


def resolve_quality(quality: str | Quality) -> Quality:
    """A preset by name, or the value itself.

    Raises:
        InputError: If no preset has that name.
    """
    if isinstance(quality, Quality):
        return quality
    for name, preset in PRESETS.items():
        if name == quality:
            return preset
    raise InputError(f"quality must be one of {', '.join(sorted(PRESETS))} (got {quality!r})")
