"""Keys of the scene file for cameras: lens and viewpoints."""

from __future__ import annotations

from typing import Annotated, Literal, cast

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, NonNegativeFloat, model_validator

from mitsplat.arrays import Float64Array
from mitsplat.geometry.camera import NEAR
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.geometry.lens import Lens, distortion_coefficients, flat_coefficients, is_pinhole
from mitsplat.geometry.rigid import ROUNDED, nearest_rigid, rigid_matrix
from mitsplat.storage.field_types import (
    ElevationRange,
    Positive,
    PositiveRange,
    Range,
    StrictModel,
    Unit,
    Vec3,
    optional_field,
)
from mitsplat.storage.yaml_input import FieldError


def _flat_coefficients(values: object) -> object:
    """Convert a list or an array of OpenCV, such as (1, 5), to a tuple, which strict mode requires."""
    return flat_coefficients(values) if isinstance(values, list | tuple | np.ndarray) else values


def _check_sign(focal: object) -> object:
    """Refuse negative focal lengths."""
    if isinstance(focal, int | float) and focal < 0:
        raise ValueError(f"must be > 0 (got {focal:g}): is it of OpenGL or of an image with y upwards? Omit the sign")
    return focal


Focal = Annotated[Positive, BeforeValidator(_check_sign, json_schema_input_type=Positive)]


class Intrinsics(StrictModel):
    """OpenCV intrinsics with pixel centres at +0.5: either ``fov_x``, or ``fx`` with the other calibrated values."""

    fov_x: float | None = Field(None, gt=0, lt=180, description="Horizontal field of view [degrees].")
    fx: Focal | None = Field(None, description="Focal length along x [px].")
    fy: Focal | None = Field(None, description="Focal length along y [px]. Equal to ``fx`` if absent.")
    cx: float | None = Field(
        None,
        description="Principal point along x [px], with the centre of the first pixel at 0.5: add 0.5 to the value of "
        "``cv2.calibrateCamera``. The centre of the image if absent.",
    )
    cy: float | None = Field(
        None,
        description="Principal point along y [px], with the centre of the first pixel at 0.5: add 0.5 to the value of "
        "``cv2.calibrateCamera``. The centre of the image if absent.",
    )
    size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = Field(
        None,
        description="Image width and height to which ``fx``, ``fy``, ``cx`` and ``cy`` refer [px]. The size of the "
        "output if absent.",
    )
    distortion: Annotated[
        tuple[float, ...], BeforeValidator(_flat_coefficients, json_schema_input_type=tuple[float, ...])
    ] = Field(
        (),
        description="OpenCV distortion coefficients k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]], as "
        "``cv2.calibrateCamera`` returns them; k1, k2, k3, k4 of ``cv2.fisheye`` for a fisheye lens. Empty for a "
        "pinhole camera. The image must not extend beyond the angle at which the distortion stops growing.",
    )
    lens: Lens = Field("opencv", description="OpenCV camera model.")
    aperture: NonNegativeFloat = Field(0.0, description="Aperture radius of a thin lens [m]. 0 for a pinhole camera.")
    focus: Positive = Field(1.0, description="Focus depth of a thin lens [m].")

    @model_validator(mode="after")
    def _check(self) -> Intrinsics:
        if (self.fov_x is None) == (self.fx is None):
            raise FieldError((), f"must have either fov_x or fx (got {'neither' if self.fx is None else 'both'})")
        for key in ("fy", "cx", "cy", "size"):
            if self.fx is None and getattr(self, key) is not None:
                raise FieldError(key, "needs fx (got fov_x)")
        if self.aperture > 0 and self.focus <= NEAR:
            raise FieldError("focus", f"must be beyond the near clipping depth, {NEAR} m (got {self.focus})")
        if self.lens == "fisheye" and (self.fx is None or len(self.distortion) != 4):
            raise FieldError("lens", "fisheye needs fx and 4 distortion coefficients")
        try:
            distortion_coefficients(self.distortion, self.lens)
        except ValueError as error:
            raise FieldError("distortion", str(error)) from None
        return self

    @property
    def is_pinhole(self) -> bool:
        """True if the lens does not distort."""
        return is_pinhole(self.distortion, self.lens)

    def focal_lengths(self, size: tuple[int, int]) -> tuple[float, float]:
        """Return fx and fy [px] of images of a width and height [px]."""
        if self.fov_x is not None:
            fx = 0.5 * size[0] / float(np.tan(0.5 * np.radians(self.fov_x)))
            return fx, fx
        fx = cast(float, self.fx)
        return fx, self.fy or fx

    def principal_point(self, size: tuple[int, int]) -> tuple[float, float]:
        """Return cx and cy [px] of images of a width and height [px], with the centre of the first pixel at 0.5."""
        return size[0] / 2 if self.cx is None else self.cx, size[1] / 2 if self.cy is None else self.cy


class Motion(StrictModel):
    """Exposure time, during which the belt of the conveyor and the objects on it move."""

    exposure: PositiveRange = Field(description="Range of exposure times [s], drawn for every view.")


class CameraKeys(StrictModel):
    """Keys that all kinds of cameras have."""

    intrinsics: Intrinsics = Field(Intrinsics(fov_x=60), description="Lens and sensor geometry.")
    motion: Motion | None = optional_field(
        "Motion blur of all that the conveyor moves. Labels refer to the middle of the exposure. Needs a conveyor."
    )


def _check_directions(eye: Vec3 | None, target: Vec3 | None, up: Vec3) -> None:
    """Refuse points and a direction from which no pose follows."""
    if not any(up):
        raise FieldError("up", "must not be zero (got [0, 0, 0])")
    if eye == target:
        raise FieldError("target", f"must differ from eye (got {list(target or ())})")


class PoseKey(StrictModel):
    """Key pose of a camera path."""

    eye: Vec3 = Field(description="Centre of projection [m].")
    target: Vec3 = Field(description="Point in the centre of the image [m].")
    up: Vec3 = Field((0, 0, 1), description="Direction that appears upwards in the image.")

    @model_validator(mode="after")
    def _check(self) -> PoseKey:
        _check_directions(self.eye, self.target, self.up)
        return self


class CameraPath(CameraKeys):
    """Views evenly spaced in time on a smooth path through key poses, the same in every layout."""

    kind: Literal["path"] = Field("path", description="Path through key poses.")
    keys: tuple[PoseKey, ...] = Field(min_length=1, description="Key poses, evenly spaced in time.")
    jitter: NonNegativeFloat = Field(0.0, description="Random displacement of the eye, 1 sigma along each axis [m].")


Row = tuple[float, float, float, float]


def _rows(matrix: object) -> object:
    """Convert lists and arrays to tuples, which strict mode requires."""
    if isinstance(matrix, np.ndarray):
        matrix = matrix.tolist()
    return tuple(map(_rows, matrix)) if isinstance(matrix, list | tuple) else matrix


def _four_rows(matrix: object) -> object:
    """Convert lists and arrays to tuples, and refuse other forms of a matrix with the way to write it."""
    rows = _rows(matrix)
    if isinstance(rows, tuple):
        sizes = {len(row) if isinstance(row, tuple) else 0 for row in rows}
        if sizes == {0} and len(rows) in (12, 16):
            raise ValueError(f"must be four rows of four numbers (got {len(rows)} numbers): write each row as a list")
        if len(rows) == 3 and sizes == {4}:
            raise ValueError("must be four rows of four numbers (got 3 rows): add the row [0, 0, 0, 1]")
        if len(rows) == 3 and sizes == {3}:
            raise ValueError(
                "must be four rows of four numbers (got 3 rows of 3): append the centre of the camera to the rows of "
                "the rotation, and add the row [0, 0, 0, 1]"
            )
    return rows


def _rigid(matrix: tuple[Row, Row, Row, Row]) -> tuple[Row, Row, Row, Row]:
    """Refuse a matrix that is no rigid transform, and correct rounded entries of its rotation."""
    rows: tuple[Row, Row, Row, Row]
    rows = _rows(nearest_rigid(rigid_matrix(matrix, "world_from_camera", tolerance=ROUNDED)))  # type: ignore[assignment]
    return rows


class CameraFixed(CameraKeys):
    """Camera that stands still, such as one on a robot cell: the same view in every image, except for jitter."""

    kind: Literal["fixed"] = Field("fixed", description="Camera that stands still.")
    world_from_camera: Annotated[
        tuple[Row, Row, Row, Row] | None,
        AfterValidator(lambda matrix: matrix if matrix is None else _rigid(matrix)),
        BeforeValidator(_four_rows, json_schema_input_type=tuple[Row, Row, Row, Row] | None),
    ] = Field(
        None,
        description="Pose of the camera as the rows of a rigid 4x4 matrix [m]. Its columns are the camera's x axis "
        "(right in the image), y axis (down), z axis (into the scene), and its centre, in world coordinates. Either "
        "this key, or ``eye`` and ``target``.",
    )
    eye: Vec3 | None = Field(None, description="Centre of projection [m].")
    target: Vec3 | None = Field(None, description="Point in the centre of the image [m].")
    up: Vec3 = Field(
        (0, 0, 1),
        description="Direction that appears upwards in the image. If the view is parallel to it, such as straight "
        "down, +y of the world appears upwards (+z, if that is parallel too).",
    )
    jitter: NonNegativeFloat = Field(
        0.0, description="Random displacement of the eye, 1 sigma along each axis [m]. It is drawn for every image."
    )
    rotation_jitter: NonNegativeFloat = Field(
        0.0,
        le=30,
        description="Random rotation of the camera, 1 sigma about each of its axes [degrees]. It is drawn for every "
        "image.",
    )

    @model_validator(mode="after")
    def _check(self) -> CameraFixed:
        if self.world_from_camera is not None:
            for key, absent in (("eye", None), ("target", None), ("up", (0, 0, 1))):
                if getattr(self, key) != absent:  # stored scenes state all keys
                    raise FieldError(key, "must not be given together with world_from_camera")
            return self
        for key in ("eye", "target"):
            if getattr(self, key) is None:
                raise FieldError((), f"must have either world_from_camera, or eye and target (got no {key})")
        _check_directions(self.eye, self.target, self.up)
        return self

    @property
    def pose(self) -> Float64Array:
        """``world_from_camera`` without jitter, shape (4, 4)."""
        if self.eye is not None and self.target is not None:
            return look_at_pose(self.eye, self.target, self.up)
        return np.array(self.world_from_camera, dtype=np.float64)


class CameraOrbit(CameraKeys):
    """Views evenly spaced on a horizontal circle, the same in every layout."""

    kind: Literal["orbit"] = Field("orbit", description="Horizontal circle around a target.")
    target: Vec3 = Field(description="Point in the centre of every image [m]. The centre of the circle is above it.")
    radius: Positive = Field(description="Radius of the circle [m].")
    height: float = Field(description="Height of the circle above the target [m].")
    start: float = Field(0.0, description="First azimuth, 0 along +x, counter-clockwise seen from above [degrees].")
    sweep: float = Field(360.0, ge=-360, le=360, description="Azimuth range of the views of a layout [degrees].")
    jitter: NonNegativeFloat = Field(0.0, description="Random displacement of the eye, 1 sigma along each axis [m].")


TRIES = 16


class Acceptance(StrictModel):
    """Conditions of an accepted view. A view from inside a visible shape or an object is always rejected."""

    in_view: Unit = Field(
        0.0, description="Minimum share of the labelled objects that have at least half of their surface in the image."
    )
    clearance: NonNegativeFloat = Field(
        0.0,
        description="Minimum distance of the camera from objects, visible shapes and the mesh of the environment [m].",
    )


class Occlusion(StrictModel):
    """Partly hidden objects, of which other objects or shapes hide 10 to 80 %."""

    share: Unit = Field(description="Target share of partly hidden objects among the labelled objects in view.")


class Truncation(StrictModel):
    """Truncated objects, of which the border of the image cuts off 5 to 80 %."""

    share: Unit = Field(description="Target share of truncated objects among the labelled objects in view.")


class CameraHemisphere(CameraKeys):
    """Random views, uniform by area on spheres around a target."""

    kind: Literal["hemisphere"] = Field("hemisphere", description="Random views around a target.")
    target: Vec3 = Field(description="Point in the centre of the images [m].")
    radius: PositiveRange = Field(description="Range of distances from the target [m].")
    elevation: ElevationRange = Field((25.0, 80.0), description="Range of elevations above the horizon [degrees].")
    azimuth: Range = Field(
        (0.0, 360.0), description="Range of azimuths, 0 along +x, counter-clockwise seen from above [degrees]."
    )
    roll: Range = Field((0.0, 0.0), description="Range of rotations about the optical axis [degrees].")
    target_jitter: NonNegativeFloat = Field(
        0.0, description="Random displacement of the target, 1 sigma along each axis [m]."
    )
    look_at: Literal["target", "objects"] = Field(
        "target",
        exclude_if=lambda look_at: look_at == "target",
        description="Point in the centre of the image. ``target`` takes the target. ``objects`` takes the centre of "
        "a labelled object that is drawn for every view. Layouts without labelled objects use the target.",
    )
    coverage: Literal["random", "even"] = Field(
        "random",
        exclude_if=lambda coverage: coverage == "random",
        description="``random`` draws azimuth, sine of the elevation, and radius independently. ``even`` takes them "
        "from a low-discrepancy sequence over the frames, which leaves smaller gaps.",
    )
    accept: Acceptance | None = optional_field(
        "Conditions that every view must fulfil. Rejected views are drawn again."
    )
    occlusion: Occlusion | None = optional_field(
        "Target share of partly hidden objects. The candidate view nearest to it is selected."
    )
    truncation: Truncation | None = optional_field(
        "Target share of objects cut by the border. The candidate view nearest to it is selected. Every "
        "other candidate is turned so that the target is near the border."
    )
    tries: int = Field(
        TRIES,
        ge=1,
        le=1000,
        exclude_if=lambda tries: tries == TRIES,
        description="Maximum number of candidate views per frame.",
    )

    @property
    def selects_views(self) -> bool:
        """True if views are selected from several candidates, which depends on the objects of the layout."""
        return not (self.accept is None and self.occlusion is None and self.truncation is None)

    @model_validator(mode="after")
    def _check_tries(self) -> CameraHemisphere:
        if "tries" in self.model_fields_set and not self.selects_views:
            raise FieldError("tries", "needs accept, occlusion or truncation")
        return self


CameraSpec = Annotated[CameraFixed | CameraPath | CameraOrbit | CameraHemisphere, Field(discriminator="kind")]
