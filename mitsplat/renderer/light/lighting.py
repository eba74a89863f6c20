"""Input of the stages of traced light."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from mitsplat.renderer.emitters.emitter_sampling import Emitters
from mitsplat.renderer.interreflection.reflectors import Reflectors
from mitsplat.renderer.light.lit_surface import VisibleSurfaces
from mitsplat.renderer.occluders.proxies import Proxies
from mitsplat.renderer.rays.camera_rays import CameraView

FIRST_RAYS = 0.3
"""Product of the wanted error and the number of rays per point before the first estimate: what most points need.

With fewer rays the estimates are so rough that rays go to the wrong points, and penumbras count as even light.
"""

MIN_FIRST_RAYS = 4
"""Smallest number of these rays."""

PLANE_FACTOR = 2
"""Factor of the number of rays at a point that represents four pixels of a plane. With factor 1, its error would be a
quarter larger than with rays at each pixel. With this factor the error is the same.
"""


@dataclass(frozen=True)
class Accuracy:
    """Target error and limits of shadow rays.

    Attributes:
        error: Target standard error of mid-grey irradiance, scaled perceptually elsewhere; 0 spends ``most``
            everywhere.
        most: Largest number of rays per pixel.
        metered: True if automatic exposure normalises the mean brightness of the picture to mid-grey.
    """

    error: float
    most: int
    metered: bool = False

    @property
    def first(self) -> int:
        """Rays per point before the first error estimate."""
        wanted = max(MIN_FIRST_RAYS, round(FIRST_RAYS / self.error)) if self.error > 0 else self.most
        return min(wanted, self.most)

    @property
    def dense(self) -> int:
        """Rays per point that represents four pixels of a plane, before the first error estimate."""
        return min(PLANE_FACTOR * self.first, self.most)


@dataclass(frozen=True, eq=False)
class Lighting:
    """Input of the stages of :func:`mitsplat.renderer.light.light.light_factor`.

    Attributes:
        emitters: Emitters of the scene.
        proxies: Occluders.
        visible: Surface points of the camera's pixels, row by row.
        accuracy: Target error and limits of shadow rays.
        seed: Offset into the low-discrepancy sequence.
        white: Irradiance (Color3f) at which a uniformly captured object keeps its colours.
        reflectors: Surfaces that reflect light onto others.
    """

    emitters: Emitters
    proxies: Proxies
    visible: VisibleSurfaces
    accuracy: Accuracy
    seed: int
    white: mi.Color3f
    reflectors: Reflectors

    @property
    def view(self) -> CameraView:
        """Camera."""
        return self.visible.view

    @property
    def pixels(self) -> int:
        """Number of pixels of the image."""
        return self.view.width * self.view.height
