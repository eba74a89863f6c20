"""Keys of a scene file about the camera: its lens, and where it looks from."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, NonNegativeFloat, model_validator

from mitsplat.camera import Lens
from mitsplat.scene.spec_types import Elevation, Positive, PositiveRange, Range, StrictModel, Vec3, ordered
from mitsplat.yaml_input import FieldError


class Intrinsics(StrictModel):
    """OpenCV intrinsics, pixel centres at +0.5: either ``fov_x``, or ``fx`` with what else was calibrated."""

    fov_x: float | None = Field(None, gt=0, lt=180, description="Horizontal field of view [degrees].")
    fx: Positive | None = Field(None, description="Focal length along x [px].")
    fy: Positive | None = Field(None, description="Focal length along y [px]; fx if absent.")
    cx: float | None = Field(None, description="Principal point [px]; the image's middle if absent.")
    cy: float | None = Field(None, description="Principal point [px]; the image's middle if absent.")
    size: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = Field(
        None, description="Width and height that fx, fy, cx and cy refer to [px]; the output's if absent."
    )
    distortion: tuple[float, ...] = Field(
        (), description="OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty for a pinhole. A fisheye's k1, k2, k3, k4."
    )
    lens: Lens = Field("opencv", description="Which of OpenCV's camera models.")
    aperture: NonNegativeFloat = Field(0.0, description="Radius of a thin lens's aperture [m]; 0 for a pinhole.")
    focus: Positive = Field(1.0, description="Depth that a thin lens sees sharp [m].")
    near: Positive = Field(0.01, description="Nearest depth at which anything is seen [m].")

    @model_validator(mode="after")
    def _check(self) -> Intrinsics:
        if (self.fov_x is None) == (self.fx is None):
            raise FieldError((), "must have either fov_x or fx")
        for key in ("fy", "cx", "cy", "size"):
            if self.fx is None and getattr(self, key) is not None:
                raise FieldError(key, "needs fx")
        if self.aperture > 0 and self.focus <= self.near:
            raise FieldError("focus", f"must be beyond near, {self.near} (got {self.focus})")
        if self.lens == "fisheye":
            if self.fx is None or len(self.distortion) != 4:
                raise FieldError("lens", "fisheye needs fx and 4 coefficients of distortion")
        elif len(self.distortion) not in (0, 4, 5, 8):
            raise FieldError("distortion", f"must have 0, 4, 5 or 8 coefficients (got {len(self.distortion)})")
        return self


class Viewpoint(StrictModel):
    """What every kind of camera has."""

    intrinsics: Intrinsics = Field(Intrinsics(fov_x=60), description="Lens and sensor.")


class PoseKey(StrictModel):
    """One pose on a camera path."""

    eye: Vec3 = Field(description="Centre of projection [m].")
    target: Vec3 = Field(description="Point in the middle of the view [m].")
    up: Vec3 = Field((0, 0, 1), description="Direction that points up in the image.")

    @model_validator(mode="after")
    def _check(self) -> PoseKey:
        if self.eye == self.target:
            raise FieldError("target", f"must differ from eye (got {list(self.target)})")
        if not any(self.up):
            raise FieldError("up", "must not be zero (got [0, 0, 0])")
        return self


class CameraPath(Viewpoint):
    """Views evenly spaced in time on a smooth path through key poses, the same in every layout."""

    kind: Literal["path"] = Field("path", description="A path through key poses.")
    keys: tuple[PoseKey, ...] = Field(min_length=1, description="Key poses, evenly spaced in time.")
    jitter: NonNegativeFloat = Field(0.0, description="Random displacement of the eye, 1 sigma [m].")


class CameraOrbit(Viewpoint):
    """Views evenly spaced on a horizontal circle, the same in every layout."""

    kind: Literal["orbit"] = Field("orbit", description="A horizontal circle.")
    target: Vec3 = Field(description="Point in the middle of every view; the circle is centred above it [m].")
    radius: Positive = Field(description="Radius of the circle [m].")
    height: float = Field(description="Height of the circle above the target [m].")
    start: float = Field(0.0, description="First azimuth, 0 along +x, counter-clockwise from above [degrees].")
    sweep: float = Field(360.0, ge=-360, le=360, description="Azimuth swept over a layout's views [degrees].")
    jitter: NonNegativeFloat = Field(0.0, description="Random displacement of the eye, 1 sigma [m].")


class CameraHemisphere(Viewpoint):
    """Views drawn at random, uniform by area on spheres around a target."""

    kind: Literal["hemisphere"] = Field("hemisphere", description="Random views around a target.")
    target: Vec3 = Field(description="Point in the middle of the views [m].")
    radius: PositiveRange = Field(description="Range of distances from the target [m].")
    elevation: Annotated[tuple[Elevation, Elevation], AfterValidator(ordered)] = Field(
        (25.0, 80.0), description="Range above the horizon [degrees]."
    )
    azimuth: Range = Field((0.0, 360.0), description="Range, 0 along +x, counter-clockwise from above [degrees].")
    roll: Range = Field((0.0, 0.0), description="Range of rotations about the line of sight [degrees].")
    target_jitter: NonNegativeFloat = Field(0.0, description="Random displacement of the target, 1 sigma [m].")


CameraSpec = Annotated[CameraPath | CameraOrbit | CameraHemisphere, Field(discriminator="kind")]
