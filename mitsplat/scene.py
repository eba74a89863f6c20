"""Scene files: YAML to :class:`SceneSpec`, with errors that name file, line, key, rule and value."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Box(_Strict):
    """A box, axes along the world's before ``rotate``."""

    size: tuple[Positive, Positive, Positive] = Field(description="Full edge lengths [m].")
    position: Vec3 = Field((0, 0, 0), description="Centre [m].")
    rotate: Vec3 = Field((0, 0, 0), description="Euler angles about x, y, z (extrinsic) [degrees].")


class Shape(_Strict):
    """A simple shape: visible (rendered), a collider, or both. Neither visible nor collider is an error."""

    name: str
    box: Box | None = None
    mesh: str | None = Field(None, description="Mesh file relative to the scene file [m].")
    visible: bool = False
    collider: bool = True
    colour: tuple[float, float, float] = Field((0.6, 0.6, 0.6), description="Diffuse sRGB-encoded reflectance.")
    friction: float = Field(0.6, ge=0)


class ObjectSpec(_Strict):
    """Objects of one class."""

    asset: str = Field(description="Asset folder relative to the scene file.")
    count: int | tuple[int, int] = Field(1, description="How many per layout, or an inclusive range.")
    scale: Positive = Field(1.0, description="Uniform scale applied to the asset.")
    class_name: str | None = Field(None, description="Class, if other than the asset's.")


class Region(_Strict):
    """Axis-aligned box from whose inside objects are dropped [m]."""

    min: Vec3
    max: Vec3


class Settle(_Strict):
    max_time: Positive = Field(6.0, description="Simulated seconds within which a layout must come to rest.")
    attempts: int = Field(5, ge=1, description="Redraws before a layout is given up.")
    timestep: Positive = Field(0.002, description="[s]")


class Intrinsics(_Strict):
    """Either ``fov_x`` or ``fx`` (with ``fy, cx, cy``); pixel centres at +0.5."""

    fov_x: float | None = Field(None, gt=0, lt=180, description="Horizontal field of view [degrees].")
    fx: Positive | None = None
    fy: Positive | None = None
    cx: float | None = None
    cy: float | None = None
    distortion: tuple[float, ...] = ()
    near: Positive = 0.01


class PoseKey(_Strict):
    eye: Vec3
    target: Vec3
    up: Vec3 = (0, 0, 1)


class CameraPath(_Strict):
    kind: Literal["path"] = "path"
    keys: list[PoseKey] = Field(min_length=1)
    intrinsics: Intrinsics = Intrinsics(fov_x=60)
    jitter: float = Field(0.0, ge=0, description="Random displacement of the eye, 1 sigma [m].")


class CameraOrbit(_Strict):
    kind: Literal["orbit"] = "orbit"
    target: Vec3
    radius: Positive
    height: float
    start: float = Field(0.0, description="First azimuth [degrees], 0 along +x.")
    sweep: float = Field(360.0, description="Azimuth swept over all views [degrees].")
    intrinsics: Intrinsics = Intrinsics(fov_x=60)
    jitter: float = Field(0.0, ge=0)


class CameraHemisphere(_Strict):
    kind: Literal["hemisphere"] = "hemisphere"
    target: Vec3
    radius: tuple[Positive, Positive]
    elevation: tuple[float, float] = Field((25.0, 80.0), description="Range above the horizon [degrees].")
    azimuth: tuple[float, float] = (0.0, 360.0)
    roll: tuple[float, float] = (0.0, 0.0)
    target_jitter: float = Field(0.0, ge=0, description="Random displacement of the target, 1 sigma [m].")
    intrinsics: Intrinsics = Intrinsics(fov_x=60)


CameraSpec = Annotated[CameraPath | CameraOrbit | CameraHemisphere, Field(discriminator="kind")]


class LightKey(_Strict):
    """State of a light at one time of its path; unset values keep the light's own."""

    position: Vec3
    intensity: Positive | None = None


class AreaLight(_Strict):
    """A rectangle that emits from its front."""

    kind: Literal["area"] = "area"
    position: Vec3
    target: Vec3 = (0, 0, 0)
    size: tuple[Positive, Positive] = (0.5, 0.5)
    radiance: Positive = Field(10.0, description="[W/(m^2 sr)], relative units.")
    colour: Vec3 = (1, 1, 1)
    path: list[LightKey] = []


class SpotLight(_Strict):
    kind: Literal["spot"] = "spot"
    position: Vec3
    target: Vec3 = (0, 0, 0)
    cone: float = Field(30.0, gt=0, lt=90, description="Half angle of the cone [degrees].")
    intensity: Positive = Field(10.0, description="[W/sr]")
    colour: Vec3 = (1, 1, 1)
    path: list[LightKey] = []


class PointLight(_Strict):
    kind: Literal["point"] = "point"
    position: Vec3
    intensity: Positive = Field(10.0, description="[W/sr]")
    colour: Vec3 = (1, 1, 1)
    path: list[LightKey] = []


class EnvironmentLight(_Strict):
    """A constant sky, or an equirectangular image (z up)."""

    kind: Literal["environment"] = "environment"
    radiance: Positive = Field(1.0, description="Radiance, or the factor on the image.")
    colour: Vec3 = (1, 1, 1)
    image: str | None = Field(None, description="HDR or EXR file relative to the scene file.")
    rotate_z: float = Field(0.0, description="[degrees]")


LightSpec = Annotated[AreaLight | SpotLight | PointLight | EnvironmentLight, Field(discriminator="kind")]

Range = tuple[float, float]


class Randomise(_Strict):
    """Drawn anew for every frame from (seed, frame); a range of equal ends fixes the value."""

    exposure: Range = Field((0.0, 0.0), description="Stops.")
    hue: Range = Field((0.0, 0.0), description="Shift [degrees].")
    saturation: Range = (1.0, 1.0)
    white_balance: Range = Field((6504.0, 6504.0), description="Correlated colour temperature [K].")
    noise: Range = Field((0.0, 0.0), description="Read noise, 1 sigma of the encoded range [0, 1].")
    light_intensity: Range = Field((1.0, 1.0), description="Factor on every light, per layout.")


class Composite(_Strict):
    shadow: Literal["traced", "image", "none"] = "traced"
    highlight: bool = True
    tone: Literal["neutral", "filmic"] = "neutral"


class Output(_Strict):
    width: int = Field(1280, ge=1, le=16384)
    height: int = Field(720, ge=1, le=16384)
    layouts: int = Field(4, ge=1)
    views: int = Field(10, ge=1, description="Views per layout.")
    formats: list[Literal["yolo", "coco", "bop", "exr"]] = ["yolo"]
    image: Literal["png", "jpg"] = "png"
    jpeg_quality: int = Field(95, ge=1, le=100)
    validation: float = Field(0.2, ge=0, le=1, description="Share of layouts that go to the validation split.")
    min_pixels: int = Field(16, ge=1, description="Instances with fewer visible pixels are dropped.")
    min_fragment: int = Field(8, ge=1, description="Connected parts with fewer pixels are dropped.")


class SceneSpec(_Strict):
    """A scene file. Lengths in metres, angles in degrees, z up."""

    name: str
    environment: str | None = Field(None, description="Asset folder relative to the scene file.")
    shapes: list[Shape] = []
    objects: list[ObjectSpec] = []
    region: Region
    settle: Settle = Settle()
    camera: CameraSpec
    lights: list[LightSpec] = []
    randomise: Randomise = Randomise()
    composite: Composite = Composite()
    output: Output = Output()
    quality: Literal["fast", "balanced", "exact"] = "balanced"
    seed: int = Field(0, ge=0)
