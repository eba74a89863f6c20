"""Conversion of Mitsuba sensors to the camera of the splat renderer."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from mitsplat.errors import InputError
from mitsplat.renderer.rays.camera_rays import CameraView

SMALLEST_APERTURE = 1e-6
"""Radius up to which a lens counts as a pinhole [m]."""

_PERSPECTIVE = ("PerspectiveCamera", "ThinLensCamera")


def view_of(sensor: mi.Sensor) -> CameraView:
    """Return the camera of a sensor: ``opencv_camera``, or Mitsuba's ``perspective`` or ``thinlens``.

    Raises:
        InputError: If the sensor is of another kind.
    """
    if hasattr(sensor, "view"):
        return cropped(sensor.view(), sensor.film())
    kind = str(sensor.class_name())
    if kind not in _PERSPECTIVE:
        raise InputError(
            f"integrator 'splat_proxy': the sensor must be 'opencv_camera', 'perspective' or 'thinlens' (got {kind})"
        )
    width, height = (int(n) for n in sensor.film().size())
    params = mi.traverse(sensor)

    def number(name: str, default: float = 0.0) -> float:
        return float(np.array(params[name]).ravel()[0]) if name in params else default

    focal = 0.5 * width / np.tan(0.5 * np.radians(number("x_fov")))
    # Mitsuba adds the offset to the position of a pixel, so that the principal point moves the other way.
    centre = [width * (0.5 - number("principal_point_offset_x")), height * (0.5 - number("principal_point_offset_y"))]
    # Mitsuba replaces an aperture radius of 0 by its smallest float.
    radius = number("aperture_radius")
    pose = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    view = CameraView(
        width,
        height,
        fx=focal,
        fy=focal,
        cx=centre[0],
        cy=centre[1],
        world_from_camera=pose,
        near=number("near_clip"),
        aperture_radius=radius if radius > SMALLEST_APERTURE else 0.0,
        focus_distance=number("focus_distance", 1.0),
    )
    return cropped(view, sensor.film())


def cropped(view: CameraView, film: mi.Film) -> CameraView:
    """Return the part of a view inside the crop window of a film."""
    (width, height), (x, y) = film.crop_size(), film.crop_offset()
    return replace(view, width=int(width), height=int(height), cx=view.cx - int(x), cy=view.cy - int(y))
