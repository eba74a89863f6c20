"""Keys of a scene file about the camera: its lens, and where it looks from."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, model_validator

from mitsplat.geometry.camera import Lens
from mitsplat.storage.field_types import (
    ElevationRange,
    NonNegativeRange,
    Positive,
    PositiveRange,
    Range,
    StrictModel,
    Unit,
    UnitRange,
    Vec3,
)
from mitsplat.storage.yaml_input import FieldError


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


class Stereo(StrictModel):
    """A second camera beside the first, alike and parallel to it: a rectified pair."""

    baseline: Positive = Field(description="Distance of the right camera from the left one, along its x axis [m].")


class Handheld(StrictModel):
    """Motion of the hand that holds a camera: smooth from view to view of a layout, and another in every layout."""

    position: NonNegativeFloat = Field(0.0, description="Displacement along each axis, 1 sigma [m].")
    rotation: NonNegativeFloat = Field(0.0, description="Rotation about each axis, 1 sigma [degrees].")


class Defocus(StrictModel):
    """A thin lens that is drawn anew for every view, in place of the intrinsics' own."""

    aperture: NonNegativeRange = Field(description="Radius of the aperture [m]; 0 for a pinhole.")
    focus: PositiveRange = Field(description="Depth that is sharp [m].")


class Motion(StrictModel):
    """Steady motion of the camera while its shutter is open, drawn anew for every view in its own frame."""

    exposure: PositiveRange = Field(description="How long the shutter is open [s].")
    speed: NonNegativeRange = Field(
        (0.0, 0.0), description="Speed [m/s], in a direction that is uniform on the sphere."
    )
    rotation: NonNegativeRange = Field(
        (0.0, 0.0), description="Rate of rotation [degrees/s], about an axis that is uniform on the sphere."
    )
    readout: NonNegativeRange = Field(
        (0.0, 0.0),
        exclude_if=lambda readout: readout == (0.0, 0.0),
        description="How long after the first row the last one is exposed [s]; 0 for all rows at once.",
    )

    @property
    def moves(self) -> bool:
        """Whether it is more than an open shutter."""
        return bool(self.speed[1] or self.rotation[1])


class Viewpoint(StrictModel):
    """What every kind of camera has."""

    intrinsics: Intrinsics = Field(Intrinsics(fov_x=60), description="Lens and sensor.")
    zoom: PositiveRange = Field(
        (1.0, 1.0),
        exclude_if=lambda zoom: zoom == (1.0, 1.0),
        description="Factor on the focal lengths, drawn anew for every view.",
    )
    handheld: Handheld | None = Field(
        None, exclude_if=lambda handheld: handheld is None, description="Smooth random motion on top of the pose."
    )
    defocus: Defocus | None = Field(
        None,
        exclude_if=lambda defocus: defocus is None,
        description="Aperture and focus, drawn anew for every view.",
    )
    motion: Motion | None = Field(
        None,
        exclude_if=lambda motion: motion is None,
        description="Motion that blurs the picture, near things more than far ones. Pose and labels are those of the "
        "exposure's middle.",
    )
    stereo: Stereo | None = Field(
        None,
        exclude_if=lambda stereo: stereo is None,
        description="Takes every view twice, from the left and then from the right; these are two of output.views.",
    )

    @model_validator(mode="after")
    def _check_defocus(self) -> Viewpoint:
        if self.defocus is not None:
            if self.intrinsics.aperture:
                raise FieldError("defocus", "must not be given together with an aperture of the intrinsics")
            if self.defocus.focus[0] <= self.intrinsics.near:
                text = f"must be beyond near, {self.intrinsics.near:g} (got {self.defocus.focus[0]:g})"
                raise FieldError(("defocus", "focus"), text)
        return self


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


TRIES = 16


class Acceptance(StrictModel):
    """What a view must show and keep off. A camera inside of a visible shape or an object is never accepted."""

    in_view: Unit = Field(
        0.0, description="Least share of the labelled objects of which half of the surface or more is in the image."
    )
    extent: NonNegativeFloat = Field(
        0.0, description="Least longer side of the box around each labelled object that is in view [px]."
    )
    clearance: NonNegativeFloat = Field(
        0.0, description="Least distance of the camera from objects, visible shapes and the environment's mesh [m]."
    )


class Occlusion(StrictModel):
    """How many of the labelled objects in view should be partly hidden."""

    share: Unit = Field(description="Share of the objects in view that is aimed at.")
    visible: UnitRange = Field((0.2, 0.9), description="Range of visible fractions that counts as partly hidden.")


class Truncation(StrictModel):
    """How many of the labelled objects in view the image's border should cut."""

    share: Unit = Field(description="Share of the objects in view that is aimed at.")
    cut: UnitRange = Field((0.05, 0.8), description="Range of shares beyond the border that counts as cut.")


class CameraHemisphere(Viewpoint):
    """Views drawn at random, uniform by area on spheres around a target."""

    kind: Literal["hemisphere"] = Field("hemisphere", description="Random views around a target.")
    target: Vec3 = Field(description="Point in the middle of the views [m].")
    radius: PositiveRange = Field(description="Range of distances from the target [m].")
    elevation: ElevationRange = Field((25.0, 80.0), description="Range above the horizon [degrees].")
    azimuth: Range = Field((0.0, 360.0), description="Range, 0 along +x, counter-clockwise from above [degrees].")
    roll: Range = Field((0.0, 0.0), description="Range of rotations about the line of sight [degrees].")
    target_jitter: NonNegativeFloat = Field(0.0, description="Random displacement of the target, 1 sigma [m].")
    look_at: Literal["target", "objects", "clusters"] = Field(
        "target",
        exclude_if=lambda look_at: look_at == "target",
        description="What is in the middle of a view: the target, or the middle of a labelled object that is drawn "
        "anew for every view, alone or with the two nearest to it. Layouts without one are seen at the target.",
    )
    coverage: Literal["random", "even"] = Field(
        "random",
        exclude_if=lambda coverage: coverage == "random",
        description="Whether azimuth, sine of the elevation and radius are drawn independently, or follow a sequence "
        "of low discrepancy over the frames, which leaves smaller gaps between them.",
    )
    accept: Acceptance | None = Field(
        None,
        exclude_if=lambda accept: accept is None,
        description="What every view must fulfil; others are drawn again.",
    )
    occlusion: Occlusion | None = Field(
        None,
        exclude_if=lambda occlusion: occlusion is None,
        description="Share of partly hidden objects, for which one of the tries is chosen.",
    )
    truncation: Truncation | None = Field(
        None,
        exclude_if=lambda truncation: truncation is None,
        description="Share of objects cut by the border, for which one of the tries is chosen; every other try looks "
        "past what it would look at, so that it is near the border.",
    )
    tries: int = Field(
        TRIES,
        ge=1,
        le=1000,
        exclude_if=lambda tries: tries == TRIES,
        description="How many views are drawn for a frame at most, to accept or choose from.",
    )

    @property
    def chosen(self) -> bool:
        """Whether a frame's view is one of several tries, which depends on what lies there."""
        return not (self.accept is None and self.occlusion is None and self.truncation is None)

    @model_validator(mode="after")
    def _check_tries(self) -> CameraHemisphere:
        if "tries" in self.model_fields_set and not self.chosen:
            raise FieldError("tries", "needs accept, occlusion or truncation")
        return self


class CameraWalk(Viewpoint):
    """A video of each layout: a smooth path around the target, through places drawn at random as on a hemisphere.

    Azimuth, sine of the elevation and radius are interpolated by monotone cubics, and so never leave their ranges.
    """

    kind: Literal["walk"] = Field("walk", description="A smooth random path around a target, for videos.")
    target: Vec3 = Field(description="Point in the middle of the views [m].")
    radius: PositiveRange = Field(description="Range of distances from the target [m].")
    elevation: ElevationRange = Field((25.0, 80.0), description="Range above the horizon [degrees].")
    azimuth: Range = Field((0.0, 360.0), description="Range, 0 along +x, counter-clockwise from above [degrees].")
    places: int = Field(4, ge=2, le=1000, description="How many places are drawn, evenly spaced in time.")


CameraSpec = Annotated[CameraPath | CameraOrbit | CameraHemisphere | CameraWalk, Field(discriminator="kind")]
