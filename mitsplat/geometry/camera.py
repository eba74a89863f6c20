"""Cameras in OpenCV convention: pinhole, distorted or fisheye.

For conventions see :mod:`mitsplat.gaussians.splat_cloud`: x right, y down, z forward in the camera; pixel centres at
+0.5.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from mitsplat.arguments import check_number, checks_arguments, describe
from mitsplat.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from mitsplat.errors import InputError
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.geometry.lens import (
    Lens,
    distortion_coefficients,
    fisheye_radius,
    is_pinhole,
    largest_slope,
    lens_fault,
    undistort,
)
from mitsplat.geometry.rigid import (
    OPENCV_FROM_OPENGL,
    homogeneous_matrix,
    points_of,
    rigid_matrix,
    split_similarity,
    transform_points,
)
from mitsplat.storage.files import JsonObject

MAX_IMAGE_SIDE = 16384
"""Maximum side length of an image [px]."""

NEAR = 0.01
"""Near clipping depth of cameras in scene files [m]."""


@checks_arguments
@dataclass(frozen=True, eq=False)
class Camera:
    """OpenCV camera: intrinsics [px], lens distortion and pose.

    Attributes:
        width, height: Image size [px].
        fx, fy: Focal lengths [px].
        cx, cy: Principal point [px], pixel centres at +0.5 (the centre of an image is ``width / 2``). Add 0.5 to the
            values of ``cv2.calibrateCamera``.
        world_from_camera: Rigid transform of camera coordinates to world coordinates [m], shape (4, 4).
        distortion: OpenCV coefficients ``k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]]``, or empty for a pinhole
            camera; ``k1, k2, k3, k4`` for a fisheye lens. Also the array of `cv2.calibrateCamera` or
            `cv2.fisheye.calibrate`, such as (1, 5).
        near: Near clipping depth [m].
        lens: ``opencv``, or ``fisheye`` for OpenCV's fisheye model (Kannala and Brandt 2006).
        aperture_radius: Aperture radius of a thin lens [m]; 0 for a pinhole camera, which has no defocus blur.
        focus_distance: Focus depth of a thin lens along z [m].

    Raises:
        ValueError: If a size is below 1, a focal length is not positive, or the pose is not rigid; if the distortion
            has another number of coefficients; if the image needs rays that the lens model does not have, because its
            distortion folds inside the image or a fisheye lens shows more than 85 degrees to any side of its axis; or
            if the aperture is negative or the focus is not beyond ``near``.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: Float64Array
    distortion: tuple[float, ...] = ()
    near: float = NEAR
    lens: Lens = "opencv"
    aperture_radius: float = 0.0
    focus_distance: float = 1.0

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "near", "aperture_radius", "focus_distance"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
                raise ValueError(f"{name} must be a number (got {describe(value)})")
            object.__setattr__(self, name, float(value))  # numbers of few bits would overflow later
        sides = self.width, self.height
        if not all(
            isinstance(side, int | np.integer) and side is not True and 1 <= side <= MAX_IMAGE_SIDE for side in sides
        ):
            raise ValueError(
                f"camera size must be whole numbers of 1 to {MAX_IMAGE_SIDE} px (got {sides[0]}x{sides[1]})"
            )
        for name in ("width", "height"):
            object.__setattr__(self, name, int(getattr(self, name)))
        if not np.isfinite([self.cx, self.cy]).all():
            raise ValueError(f"the principal point must be finite (got cx={self.cx}, cy={self.cy})")
        if not (self.fx > 0 and self.fy > 0 and np.isfinite([self.fx, self.fy]).all()):
            raise ValueError(f"focal lengths must be finite and > 0 (got fx={self.fx}, fy={self.fy})")
        if not self.near > 0:
            raise ValueError(f"near must be > 0 (got {self.near})")
        if not 0 <= self.aperture_radius < np.inf:
            raise ValueError(f"aperture_radius must be finite and >= 0 (got {self.aperture_radius})")
        if self.aperture_radius > 0 and not self.near < self.focus_distance < np.inf:
            raise ValueError(f"focus_distance must be finite and > near, {self.near} (got {self.focus_distance})")
        if self.lens not in ("opencv", "fisheye"):
            raise ValueError(f"lens must be opencv or fisheye (got {self.lens!r})")
        try:
            object.__setattr__(self, "distortion", distortion_coefficients(self.distortion, self.lens))
        except ValueError as error:
            raise ValueError(f"distortion {error}") from None
        if fault := lens_fault(self.size, (self.fx, self.fy), (self.cx, self.cy), self.distortion, self.lens):
            raise ValueError(fault)
        try:
            pose = rigid_matrix(self.world_from_camera, "world_from_camera")
        except ValueError as error:
            raise ValueError(f"world_from_camera {error}") from None
        pose.flags.writeable = False
        object.__setattr__(self, "world_from_camera", pose)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image [px]."""
        return self.width, self.height

    @property
    def is_pinhole(self) -> bool:
        """True if the lens does not distort."""
        return is_pinhole(self.distortion, self.lens)

    @classmethod
    def look_at(
        cls,
        eye: npt.ArrayLike,
        target: npt.ArrayLike,
        *,
        up: npt.ArrayLike = (0.0, 0.0, 1.0),
        width: int,
        height: int,
        fov_x: float,
        distortion: npt.ArrayLike = (),
        near: float = NEAR,
    ) -> Camera:
        """Create a camera at ``eye`` (3,) [m] that faces ``target`` (3,) [m], with ``up`` (3,) upwards in the image.

        The horizontal field of view is ``fov_x`` [degrees]. The other arguments are those of :class:`Camera`.

        Raises:
            ValueError: If ``eye`` equals ``target`` or ``fov_x`` is not between 0 and 180.
        """
        check_number(fov_x, "fov_x")
        if not 0.0 < fov_x < 180.0:
            raise ValueError(f"fov_x must be between 0 and 180 degrees (got {fov_x})")
        if fov_x < np.pi:
            text = f"fov_x is {fov_x:g} degrees: is it in radians? Then it is {np.degrees(fov_x):.3g} degrees"
            warnings.warn(text, stacklevel=2)
        focal = 0.5 * width / np.tan(0.5 * np.radians(fov_x))
        return cls(
            width=width,
            height=height,
            fx=float(focal),
            fy=float(focal),
            cx=0.5 * width,
            cy=0.5 * height,
            world_from_camera=look_at_pose(eye, target, up),
            distortion=distortion,  # type: ignore[arg-type]  # converted by __post_init__
            near=near,
        )

    @classmethod
    def from_opengl(
        cls,
        world_from_camera: npt.ArrayLike,
        *,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        distortion: npt.ArrayLike = (),
        near: float = NEAR,
    ) -> Camera:
        """Create a camera from a pose in OpenGL's axes (x right, y up, z backwards), as in Blender and NeRF datasets.

        ``world_from_camera`` is a rigid transform (4, 4). The intrinsics are those of :class:`Camera`: in pixels, with
        y downwards.

        Raises:
            ValueError: As for :class:`Camera`. A matrix in OpenGL's column-major order must be transposed first.
        """
        try:
            pose = rigid_matrix(world_from_camera, "world_from_camera")
        except ValueError as error:
            raise ValueError(f"world_from_camera {error}") from None
        return cls(
            *(width, height, fx, fy, cx, cy),
            world_from_camera=pose @ OPENCV_FROM_OPENGL,
            distortion=distortion,  # type: ignore[arg-type]  # converted by __post_init__
            near=near,
        )

    @classmethod
    def from_json(cls, stored: JsonObject) -> Camera:
        """Return the camera from the values of :meth:`to_json`.

        Raises:
            ValueError: If the values are invalid.
        """
        if np.array(stored["intrinsics"], dtype=object).shape != (3, 3):  # rows may have unequal lengths
            raise InputError(f"intrinsics must have shape (3, 3) (got {describe(stored['intrinsics'])})")
        ((fx, skew, cx), (lower, fy, cy), last) = stored["intrinsics"]
        if (skew, lower, *last) != (0, 0, 0, 0, 1):
            raise InputError(
                f"intrinsics must have the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (got {stored['intrinsics']}): "
                "pixels with a skew are not supported"
            )
        same = ("width", "height", "world_from_camera", "near", "lens", "aperture_radius", "focus_distance")
        known = {key: stored[key] for key in same}
        return cls(fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(stored["distortion"]), **known)

    def to_json(self) -> JsonObject:
        """Return the camera as JSON values, as in datasets. Floats survive the round trip exactly."""
        return {
            "width": self.width,
            "height": self.height,
            "intrinsics": self.intrinsics.tolist(),
            "distortion": list(self.distortion),
            "lens": self.lens,
            "aperture_radius": self.aperture_radius,
            "focus_distance": self.focus_distance,
            "near": self.near,
            "world_from_camera": self.world_from_camera.tolist(),
        }

    @property
    def intrinsics(self) -> Float64Array:
        """Intrinsic matrix K for pixel centres at +0.5, shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def camera_from_world(self) -> Float64Array:
        """Extrinsics: rigid inverse of ``world_from_camera``, shape (4, 4)."""
        rotation, centre = self.world_from_camera[:3, :3], self.world_from_camera[:3, 3]
        return homogeneous_matrix(rotation.T, -rotation.T @ centre)

    @property
    def centre(self) -> Float64Array:
        """Centre of projection in the world [m], shape (3,)."""
        return self.world_from_camera[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """Return the same camera with another pixel grid over the same image area."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def fitted(self, size: float) -> Camera:
        """Return the same camera with a longest edge of at most ``size`` px."""
        if not size > 0:
            raise InputError(f"size must be > 0 (got {size})")
        scale = min(1.0, size / max(self.size))
        return self.resized(max(1, round(self.width * scale)), max(1, round(self.height * scale)))

    def transformed(self, matrix: npt.ArrayLike) -> Camera:
        """Return the camera after a similarity transform (4, 4). The near distance is scaled.

        Raises:
            InputError: If the matrix shears, mirrors or scales unevenly.
        """
        rotation, scale, translation = split_similarity(matrix)
        pose = homogeneous_matrix(
            rotation @ self.world_from_camera[:3, :3], scale * rotation @ self.centre + translation
        )
        return replace(self, world_from_camera=pose, near=self.near * scale)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Return the camera of a part of the image. The part begins at a pixel and may reach beyond the border."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def project(self, points: npt.ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Project world points (N, 3): return distorted pixel positions (N, 2) and depths along z [m] (N,).

        A point at or behind the camera plane has pixel position NaN. A point beyond the angle at which the distortion
        stops growing (or 85 degrees, for a fisheye lens) also has NaN, because its polynomial may place the point
        inside the image, where no ray shows it.
        """
        local = transform_points(self.camera_from_world, points_of(points, "points"))
        depth = local[:, 2]
        front = depth > 0
        if not self.distortion:
            depths = np.where(front, depth, np.nan)
            return local[:, :2] / depths[:, None] * (self.fx, self.fy) + (self.cx, self.cy), depth
        pixels = np.full((len(local), 2), np.nan)
        slopes = local[front, :2] / depth[front, None]
        slope = np.linalg.norm(slopes, axis=1)
        if self.lens == "fisheye":
            shown = slopes * (fisheye_radius(np.arctan(slope), self.distortion) / np.maximum(slope, 1e-12))[:, None]
            pixels[front] = shown * (self.fx, self.fy) + (self.cx, self.cy)
        elif front.any():
            projected, _ = cv2.projectPoints(
                local[front], np.zeros(3), np.zeros(3), self.intrinsics, np.array(self.distortion)
            )
            pixels[front] = projected.reshape(-1, 2)
        pixels[np.flatnonzero(front)[slope >= largest_slope(self.distortion, self.lens)]] = np.nan
        return pixels, depth

    def visible_pixels(self, points: npt.ArrayLike) -> tuple[Int64Array, Int64Array, Int64Array]:
        """Return the indices of the world points (N, 3) inside the image, and the columns and rows of their pixels."""
        pixels, _ = self.project(points)
        inside = np.flatnonzero(self.contains(pixels))
        x, y = pixels[inside].astype(np.int64).T
        return inside, x, y

    def contains(self, pixels: Float64Array) -> BoolArray:
        """Return True for each pixel position (..., 2) inside the image."""
        return np.asarray(((pixels >= 0) & (pixels < self.size)).all(axis=-1))

    def sample(self, image: AnyArray, points: npt.ArrayLike, missing: float) -> Float64Array:
        """Return the pixel values (N,) of an image at world points (N, 3); ``missing`` for points outside the image."""
        self._check_image(image)
        values = np.full(len(np.atleast_2d(points)), missing)
        inside, x, y = self.visible_pixels(points)
        values[inside] = image[y, x]
        return values

    def _check_image(self, image: AnyArray) -> None:
        if image.shape[1::-1] != self.size:
            size = "x".join(map(str, image.shape[1::-1]))
            raise InputError(f"image must have the size of the camera, {self.width}x{self.height} px (got {size})")

    def undistorted(self, image: npt.NDArray[np.uint8]) -> tuple[npt.NDArray[np.uint8], Camera]:
        """Return an image of this camera resampled for a pinhole camera, and that pinhole camera.

        The pinhole camera shows nothing beyond the border of the image.

        Args:
            image: Shape (H, W, C).
        """
        self._check_image(image)
        if image.dtype != np.uint8 or image.ndim not in (2, 3):
            raise InputError(f"image must have 8 bits and the shape (H, W, C) (got {image.dtype}, {image.shape})")
        side = np.linspace(0, 1, 65)
        left, right, top, bottom = (
            self.ray_slopes(np.stack([x * self.width, y * self.height], axis=1))
            for x, y in ((0 * side, side), (0 * side + 1, side), (side, 0 * side), (side, 0 * side + 1))
        )
        low = np.array([left[:, 0].max(), top[:, 1].max()])
        fx, fy = self.size / (np.array([right[:, 0].min(), bottom[:, 1].min()]) - low)
        cx, cy = (-low * (fx, fy)).tolist()
        pinhole = replace(self, fx=float(fx), fy=float(fy), cx=cx, cy=cy, distortion=(), lens="opencv")
        columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        at_origin = replace(self, world_from_camera=np.eye(4))
        at, _ = at_origin.project(pinhole.rays(np.stack([columns.ravel(), rows.ravel()], axis=1)))
        # OpenCV has pixel centres at whole numbers.
        x, y = (at - 0.5).astype(np.float32).T.reshape(2, self.height, self.width)
        pixels = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(pixels, dtype=np.uint8), pinhole

    def ray_slopes(self, pixels: npt.ArrayLike) -> Float64Array:
        """Return undistorted ray slopes ``(x / z, y / z)`` in camera space, shape (N, 2), of pixel positions (N, 2).

        Positions outside the image for which the lens has no ray are NaN.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        if pixels.shape[-1:] != (2,):
            raise InputError(f"pixels must have shape (N, 2) (got {pixels.shape})")
        pixels = pixels.reshape(-1, 2)
        slopes = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.distortion or not len(slopes):
            return slopes
        return undistort(slopes, self.distortion, self.lens)

    def rays(self, pixels: npt.ArrayLike) -> Float64Array:
        """Return ray directions ``(x / z, y / z, 1)`` in camera space, shape (N, 3), of pixel positions (N, 2)."""
        slopes = self.ray_slopes(pixels)
        return np.column_stack([slopes, np.ones(len(slopes))])

    def unproject(self, pixels: npt.ArrayLike, depth: npt.ArrayLike) -> Float64Array:
        """Return the world points [m], shape (N, 3), at pixel positions (N, 2) and depths along z [m], shape (N,).

        This is the inverse of :meth:`project`. Points are NaN for positions for which the lens has no ray.
        """
        rays, depths = self.rays(pixels), np.reshape(depth, (-1, 1))
        if len(depths) != len(rays):
            raise InputError(f"depth must have one value for each pixel (got {len(depths)} for {len(rays)} pixels)")
        return transform_points(self.world_from_camera, rays * depths)
