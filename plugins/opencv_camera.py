"""Sensor plugin ``opencv_camera``: OpenCV intrinsics with lens distortion, or a fisheye lens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import SIMILAR, rigid_matrix
from mitsplat.plugins.parameters import Parameters
from mitsplat.renderer.rays.camera_rays import CameraView


class OpenCVCamera(mi.Sensor):
    r"""OpenCV camera (:monosp:`opencv_camera`).

    .. pluginparameters::

     * - fx, fy
       - |float|
       - Focal lengths [px].

     * - cx, cy
       - |float|
       - Principal point [px], pixel centres at +0.5: add 0.5 to the values of ``cv2.calibrateCamera``. (Default: centre
         of the film)

     * - distortion
       - |string|
       - Coefficients ``k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]``, or ``k1 k2 k3 k4`` of a fisheye. (Default: none)

     * - lens
       - |string|
       - ``opencv``, or ``fisheye`` for OpenCV's fisheye model. (Default: ``opencv``)

     * - to_world
       - |transform|
       - Pose in Mitsuba's camera axes (x left, y up, z forward), as ``lookat`` gives it; ``mi.traverse`` can change it.
         (Default: none)

     * - aperture_radius
       - |float|
       - Aperture radius of a thin lens [m]; 0 for a pinhole. (Default: 0)

     * - focus_distance
       - |float|
       - Depth of the plane in focus of a thin lens, along the optical axis [m]. (Default: 1)

     * - near_clip
       - |float|
       - Smallest depth at which splats are visible [m]. (Default: 0.01)

    Rays are generated through the distorted lens, so that no image is warped afterwards. Other integrators can use the
    sensor too.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.to_world: mi.AffineTransform4f | None = None
        self._place(props.get("to_world", mi.ScalarTransform4f()))
        given = Parameters(props, "sensor 'opencv_camera'")
        width, height = self.film().size()
        self.fx, self.fy = given.positive("fx", None), given.positive("fy", None)
        self.cx = given.number("cx", width / 2)
        self.cy = given.number("cy", height / 2)
        self.near = given.positive("near_clip", 0.01)
        text = props.get("distortion", "")
        try:
            self.distortion = tuple(float(v) for v in str(text).replace(",", " ").split())
        except ValueError:
            raise InputError(f"sensor 'opencv_camera': 'distortion' must be numbers (got {text!r})") from None
        self.lens = given.choice("lens", "opencv", "fisheye")
        self.aperture_radius = given.number("aperture_radius", 0.0)
        self.focus_distance = given.positive("focus_distance", 1.0)
        self.m_needs_sample_3 = self.aperture_radius > 0
        try:
            Camera(world_from_camera=np.eye(4), **self._optics)
        except ValueError as error:
            raise InputError(f"sensor 'opencv_camera': {error}") from None

    def _place(self, to_world: mi.AffineTransform4f) -> None:
        """Set the pose."""
        pose = np.array(to_world.matrix, dtype=np.float64).reshape(4, 4)
        try:
            self.world_from_mitsuba = rigid_matrix(pose, "to_world", tolerance=SIMILAR)
        except ValueError as error:
            raise InputError(f"sensor 'opencv_camera': 'to_world' {error}") from None

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Offer ``to_world`` to ``mi.traverse``, besides the parameters of all sensors."""
        super().traverse(callback)
        if self.to_world is None:
            self.to_world = mi.AffineTransform4f(mi.Matrix4f(self.world_from_mitsuba.tolist()))
        callback.put("to_world", self.to_world, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Move the camera to a changed ``to_world``."""
        super().parameters_changed(list(keys))
        if self.to_world is not None:
            self._place(self.to_world)

    @property
    def _optics(self) -> dict[str, Any]:
        """All values of the camera except its pose, by the names that :class:`Camera` and :class:`CameraView` share."""
        width, height = (int(n) for n in self.film().size())
        names = "fx", "fy", "cx", "cy", "distortion", "near", "lens", "aperture_radius", "focus_distance"
        return {"width": width, "height": height} | {name: getattr(self, name) for name in names}

    def view(self) -> CameraView:
        """Return the camera of the splat renderer."""
        return CameraView(world_from_camera=self.world_from_mitsuba @ np.diag([-1.0, -1.0, 1.0, 1.0]), **self._optics)

    def sample_ray(  # noqa: D102 - Mitsuba's interface
        self, time: mi.Float, wavelength: mi.Float, position: mi.Point2f, aperture: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.Ray3f, mi.Color3f]:
        film = self.film()
        at = mi.Point2f(film.crop_offset()) + position * mi.Vector2f(film.crop_size())
        u, v = self.view().slopes(at.x, at.y)
        ray = dr.zeros(mi.Ray3f, dr.width(position))
        matrix = mi.Matrix4f(self.world_from_mitsuba.tolist())
        dr.make_opaque(matrix)  # another pose reuses the compiled kernels
        to_world = mi.Transform4f(matrix)
        radius, focus = self.aperture_radius, self.focus_distance
        point = radius * mi.warp.square_to_uniform_disk_concentric(aperture) if radius else mi.Point2f(0)
        ray.o = to_world @ mi.Point3f(point.x, point.y, 0)
        ray.d = dr.normalize(to_world @ mi.Vector3f(-u - point.x / focus, -v - point.y / focus, 1))
        ray.time = time
        ray.maxt = dr.inf
        return ray, mi.Color3f(1)

    def sample_ray_differential(  # noqa: D102 - Mitsuba's interface
        self, time: mi.Float, wavelength: mi.Float, position: mi.Point2f, aperture: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.RayDifferential3f, mi.Color3f]:
        ray, weight = self.sample_ray(time, wavelength, position, aperture, active)
        return mi.RayDifferential3f(ray), weight

    def to_string(self) -> str:
        """Return the description that Mitsuba prints."""
        return f"OpenCVCamera[f = ({self.fx}, {self.fy}), c = ({self.cx}, {self.cy}), distortion = {self.distortion}]"


mi.register_sensor("opencv_camera", lambda props: OpenCVCamera(props))
