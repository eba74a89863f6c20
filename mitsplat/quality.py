"""Quality presets of the splat renderer: speed against accuracy."""

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
    """Change of a Gaussian's footprint on the image.

    Attributes:
        variance: Variance added to the footprint's covariance [px^2].
        conserves_light: True if opacity decreases as the footprint grows, so that small Gaussians emit the same light.
        alpha_max: Largest opacity of one Gaussian along a ray.
    """

    variance: float
    conserves_light: bool
    alpha_max: float


KERNELS: dict[KernelName, Kernel] = {
    "exact": Kernel(0.0, True, 1.0),
    "mip": Kernel(1.0 / 12.0, True, 1.0),
    "3dgs": Kernel(0.3, False, 0.99),
    "gsplat": Kernel(0.3, False, 0.999),
}


@dataclass(frozen=True)
class Quality:
    """Accuracy settings of the renderer; every cheaper value is less exact.

    Attributes:
        response: ``perspective`` evaluates Gaussians along every perspective ray. ``ewa`` uses parallel rays within the
            footprint of one Gaussian, as trainers linearise the projection (Zwicker et al. 2002).
        kernel: ``exact`` evaluates the Gaussian itself at the pixel's centre. ``mip`` widens footprints by the variance
            of a pixel, so that small Gaussians do not flicker (2-D Mip filter, Yu et al. 2024). ``3dgs`` and ``gsplat``
            dilate footprints and limit opacity as those trainers do.
        tolerance: Tolerated error of a display-encoded colour due to the blending order. Infinite: Gaussians are
            blended in the order of their peaks along one ray per tile of 8 x 4 pixels. 0: in the order along every
            pixel's own ray. Between: in the order per tile with an error estimate. Tiles above the tolerance are
            repeated with a sorting window, and those still above it in the exact order. A few pixels exceed the
            tolerance.
        alpha_min: Opacity along a ray below which a Gaussian is cut off. 3DGS trains with 1/255.
        transmittance_min: Transmittance at which a ray ends.
        normalise_ended_rays: True if the remaining transmittance of an ended ray takes the mean colour of the ray
            instead of black. This is mostly closer to the result of a longer ray.
        correct_late_gaussians: True if out-of-order Gaussians are corrected where the tolerance is infinite. Such a
            Gaussian takes its share of the colour from those that it occludes, as estimated from a few sums. Opacities,
            depths and instances stay those of the tile's order.
        sh_degree: Highest spherical-harmonic degree that is evaluated.
        samples: Rays per pixel along each axis (n x n on a regular grid, box-filtered), which share the light of the
            pixel's centre. ``edges`` takes one ray. At borders between instances or meshes, all values but 1 take
            several rays, each with the light of its own side, see :mod:`mitsplat.renderer.instances.antialiasing`.
        lens_rings: Rings of sample points around the centre of a thin lens: 1, 2, 3 take 7, 19, 37 images. Wide blur
            shows single points, and more rings make it smooth.
    """

    response: ResponseName = "perspective"
    kernel: KernelName = "exact"
    tolerance: float = math.inf
    alpha_min: float = 1.0 / 255.0
    transmittance_min: float = 1e-3
    normalise_ended_rays: bool = False
    correct_late_gaussians: bool = False
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
    def rays_per_axis(self) -> int:
        """Rays per pixel along each axis."""
        return 1 if self.samples == "edges" else self.samples

    @property
    def rays_at_borders(self) -> int:
        """Rays per pixel along each axis at borders between instances: 1, 2 or 4, because blocks of them are tiles."""
        rays = 2 if self.samples == "edges" else self.samples
        return rays if rays <= 2 else 4

    @property
    def order(self) -> Order:
        """Order of the colours: of the tile, of a window along each ray, or of each ray.

        With ``window``, only tiles whose estimated error exceeds the tolerance are blended in this order.
        """
        return "ray" if self.tolerance == 0 else "tile" if math.isinf(self.tolerance) else "window"


PRESETS: dict[PresetName, Quality] = {
    "fast": Quality(
        alpha_min=3e-3, transmittance_min=2e-2, normalise_ended_rays=True, correct_late_gaussians=True, sh_degree=2
    ),
    "balanced": Quality(tolerance=1.5e-2, alpha_min=1e-3, transmittance_min=5e-3, normalise_ended_rays=True),
    "exact": Quality(tolerance=0.0, alpha_min=1e-5, transmittance_min=1e-6),
}


def resolve_quality(quality: str | Quality) -> Quality:
    """Return a preset by name, or the given value itself.

    Raises:
        InputError: If no preset has that name.
    """
    if isinstance(quality, Quality):
        return quality
    for name, preset in PRESETS.items():
        if name == quality:
            return preset
    raise InputError(f"quality must be one of {', '.join(sorted(PRESETS))} (got {quality!r})")
