"""The scene file's models: what may be written, in which units, under which rules.

Lengths are metres, angles degrees, z is up; conventions are those of :mod:`mitsplat.splats`.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, NonNegativeFloat, model_validator

from mitsplat.camera import Lens
from mitsplat.quality import KernelName, PresetName, ResponseName
from mitsplat.yaml_input import FieldError

SCHEMA_VERSION = 1
"""Goes up when a scene file that was right is refused or means something else. Scene files, which people write, state
none: what is new to them are keys, and an unknown key is refused by its name."""


class StrictModel(BaseModel):
    """Immutable, without unknown keys, infinities or NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _ordered(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"must be [low, high] with low <= high (got {list(bounds)})")
    return bounds


def _count_range(count: Any) -> Any:
    """One number n as (n, n); a list as a tuple, since strict mode takes nothing else from here on."""
    if isinstance(count, int) and not isinstance(count, bool):
        if count < 1:
            raise ValueError(f"must be >= 1 (got {count})")
        return (count, count)
    if not isinstance(count, list | tuple) or len(count) != 2:
        shown = "nothing" if count is None else json.dumps(count, default=str)
        raise ValueError(f"must be a whole number, or [least, most] of them (got {shown})")
    return tuple(count)


def _scale_range(scale: Any) -> Any:
    """A list as a tuple, once it is known for a range: of a union, the error would be that of its other half."""
    if not isinstance(scale, list | tuple):
        return scale
    if len(scale) != 2 or not all(isinstance(n, int | float) and not isinstance(n, bool) and n > 0 for n in scale):
        raise ValueError(f"must be a number > 0, or [least, most] of them (got {json.dumps(scale, default=str)})")
    return _ordered((float(scale[0]), float(scale[1])))


def _some_colour(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(colour):
        raise ValueError("must not be black (got [0, 0, 0])")
    return colour


Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
Unit = Annotated[float, Field(ge=0, le=1)]
Range = Annotated[tuple[float, float], AfterValidator(_ordered)]
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(_ordered)]
NonNegativeRange = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_ordered)]
CountRange = Annotated[
    tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)]],
    AfterValidator(_ordered),
    BeforeValidator(_count_range, json_schema_input_type=int | tuple[int, int]),
]
Scale = Annotated[
    Positive | tuple[Positive, Positive],
    BeforeValidator(_scale_range, json_schema_input_type=Positive | tuple[Positive, Positive]),
]
Elevation = Annotated[float, Field(ge=-90, le=90)]
Kelvin = Annotated[float, Field(ge=1667, le=25000)]
JpegQuality = Annotated[float, Field(ge=1, le=100)]
EmittedColour = Annotated[
    tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat],
    AfterValidator(_some_colour),
    Field(description="Linear RGB factor on the emission."),
]


Arrangement = Literal["drop", "pile", "scatter", "stack", "upright"]


class Box(StrictModel):
    """A box, its axes along the world's before ``rotate``."""

    size: tuple[Positive, Positive, Positive] = Field(description="Full edge lengths [m].")
    position: Vec3 = Field((0, 0, 0), description="Centre [m].")
    rotate: Vec3 = Field((0, 0, 0), description="Euler angles about the fixed axes x, y, z, in this order [degrees].")


class Bin(StrictModel):
    """A box without lid, open upwards, that objects fall into."""

    size: tuple[Positive, Positive, Positive] = Field(description="Width, depth and height of its inside [m].")
    position: Vec3 = Field((0, 0, 0), description="Middle of its inner floor [m].")
    rotate_z: float = Field(0.0, description="Rotation about the vertical [degrees].")
    thickness: Positive = Field(0.004, description="Thickness of floor and walls [m].")


class Shape(StrictModel):
    """A box, a bin or a mesh that is rendered, collides or shades."""

    name: str = Field(min_length=1, description="Name, unique among the shapes.")
    box: Box | None = Field(None, description="The shape as a box.")
    bin: Bin | None = Field(None, description="Or as a bin.")
    mesh: str | None = Field(None, description="Or as a mesh file, relative to the scene file, in world space [m].")
    visible: bool = Field(False, description="Whether it is rendered.")
    collider: bool = Field(True, description="Whether objects rest on it and bounce off it.")
    proxy: bool = Field(
        False,
        description="Whether light is traced against it though it is not rendered: a table that only splats show.",
    )
    colour: tuple[Unit, Unit, Unit] = Field((0.6, 0.6, 0.6), description="Diffuse reflectance, sRGB-encoded.")
    friction: NonNegativeFloat = Field(
        0.6, description="Coulomb friction coefficient; what touches has the geometric mean of both sides'."
    )

    @model_validator(mode="after")
    def _check(self) -> Shape:
        if sum(form is not None for form in (self.box, self.bin, self.mesh)) != 1:
            raise FieldError("name", f"shape {self.name!r} must have either a box, a bin or a mesh")
        if not (self.visible or self.collider or self.proxy):
            raise FieldError("visible", f"shape {self.name!r} must be visible, a collider or a proxy")
        return self


class Region(StrictModel):
    """Axis-aligned box from whose inside objects are dropped."""

    min: Vec3 = Field(description="Lower corner [m].")
    max: Vec3 = Field(description="Upper corner [m].")

    @model_validator(mode="after")
    def _check(self) -> Region:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if not low < high:
                raise FieldError("max", f"must be above min along {axis} (got {high:g}, min is {low:g})")
        return self


class Enclosure(StrictModel):
    """Four invisible walls around the drop region, and a lid on it, that keep objects in.

    A layout in which an object comes to rest against one of them is drawn again.
    """

    margin: NonNegativeFloat | None = Field(
        None,
        description="Distance of the walls outside the region's sides [m]; if absent the size of the largest object, "
        "as far as there are colliders to lie on.",
    )
    floor: float = Field(0.0, description="Height of the walls' lower edge [m].")
    thickness: Positive = Field(0.05, description="Thickness of walls and lid [m].")


class ObjectPose(StrictModel):
    """Where an object starts."""

    position: Vec3 = Field(description="Origin of the asset [m].")
    rotate: Vec3 = Field((0, 0, 0), description="Euler angles about the fixed axes x, y, z, in this order [degrees].")


PRIMITIVES = "primitives"
"""The pool that needs no folder, see :mod:`mitsplat.scene.primitives`."""

NUM_PRIMITIVES = 15

SIZES = 5
"""How many sizes a range of scales has, evenly spaced in ratio: each is a rigid model of its own in every format."""


class ObjectSpec(StrictModel):
    """Objects of one asset, or of a pool that each layout draws from."""

    asset: str | None = Field(None, description="Asset folder, relative to the scene file; this or ``pool``.")
    pool: str | tuple[str, ...] | None = Field(
        None,
        exclude_if=lambda pool: pool is None,
        description="Asset folders that every object of the entry is drawn from, or a pattern such as ``assets/*`` "
        "that takes the objects among the folders that it matches, by name. Or ``primitives``: "
        f"{NUM_PRIMITIVES} boxes, cylinders, spheres, capsules and cones of 25 to 60 mm in random materials, which the "
        "seed decides and no folder holds.",
    )
    count: CountRange = Field((1, 1), description="How many in each layout: a number or an inclusive range.")
    weights: tuple[Positive, ...] = Field(
        (),
        exclude_if=lambda weights: not weights,
        description="How often each of the pool is drawn, relative to the others; alike if absent.",
    )
    balance: bool = Field(
        False,
        exclude_if=lambda balance: not balance,
        description="Whether classes of the pool are dealt out in turn, so that in each split none is ahead of another "
        "by more than one; weights then choose within a class.",
    )
    label: bool = Field(
        True,
        exclude_if=lambda label: label,
        description="Whether it is labelled. What is not hides, shadows and pushes what is, and is in no label file.",
    )
    size: Positive | None = Field(None, description="Longest extent [m], for an asset of unknown units only.")
    scale: Scale = Field(
        1.0,
        description="Uniform scale applied to the asset, its mass with its volume; or a range, of which each object "
        f"has one of {SIZES} sizes evenly spaced in ratio.",
    )
    class_name: str | None = Field(None, min_length=1, description="Class to label it as, if not the asset's own.")
    poses: tuple[ObjectPose, ...] = Field(
        (), description="Where each starts, instead of count; from there it settles like the others."
    )

    @model_validator(mode="after")
    def _check(self) -> ObjectSpec:
        if (self.asset is None) == (self.pool is None):
            raise FieldError((), "must have either an asset or a pool")
        if self.pool == ():
            raise FieldError("pool", "must name at least one asset (got [])")
        for key in ("weights", "balance"):
            if self.pool is None and getattr(self, key):
                raise FieldError(key, "needs a pool")
        if isinstance(self.pool, tuple) or self.pool == PRIMITIVES:
            self.check_weights(len(self.names))
        if self.pool == PRIMITIVES and self.size is not None:
            raise FieldError("size", "must not be given for primitives, which take a scale")
        if self.poses:
            for key in ("count", "pool"):
                if key in self.model_fields_set:
                    raise FieldError(key, "must not be given together with poses")
            if isinstance(self.scale, tuple):
                raise FieldError("scale", "must be one number together with poses")
        return self

    def check_weights(self, members: int) -> None:
        """Refuse weights of another number than the pool's members."""
        if self.weights and len(self.weights) != members:
            raise FieldError("weights", f"must be as many as the pool has assets, {members} (got {len(self.weights)})")

    @property
    def most(self) -> int:
        """The most objects of it that a layout can have."""
        return len(self.poses) or self.count[1]

    @property
    def names(self) -> tuple[str, ...]:
        """Asset folders, or primitives, that it draws from; a loaded scene has no pattern, but what it matched."""
        if self.asset is not None:
            return (self.asset,)
        if self.pool == PRIMITIVES:
            return tuple(f"{PRIMITIVES} {number}" for number in range(NUM_PRIMITIVES))
        return self.pool if isinstance(self.pool, tuple) else ()

    @property
    def scales(self) -> tuple[float, ...]:
        """Scales that each of them comes in."""
        if isinstance(self.scale, tuple):
            return tuple(np.geomspace(*self.scale, SIZES).tolist()) if self.scale[0] < self.scale[1] else self.scale[:1]
        return (self.scale,)


class Settle(StrictModel):
    """How objects are laid out and come to rest.

    ``drop``: random poses in the region. ``pile``: the same above a bin, in a column as high as it takes, poured in at
    1 m/s. ``scatter``: apart, so that none touches another. ``stack``: all of one asset above one another on their
    largest face. ``upright``: put down as the asset stands, turned about the vertical.
    """

    arrangement: Arrangement = Field("drop", description="Random drop, pile, sparse scatter, stacks or upright.")
    max_time: Positive = Field(6.0, description="Simulated time within which a layout must come to rest [s].")
    attempts: int = Field(5, ge=1, description="Redraws before a layout is given up.")
    timestep: Positive = Field(0.002, description="Time step of the simulation [s].")
    stepper: Literal["warp", "mujoco"] = Field(
        "warp", description="Newton's MuJoCo solver on Warp, or MuJoCo in C: double precision and nothing to compile."
    )


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
    elevation: Annotated[tuple[Elevation, Elevation], AfterValidator(_ordered)] = Field(
        (25.0, 80.0), description="Range above the horizon [degrees]."
    )
    azimuth: Range = Field((0.0, 360.0), description="Range, 0 along +x, counter-clockwise from above [degrees].")
    roll: Range = Field((0.0, 0.0), description="Range of rotations about the line of sight [degrees].")
    target_jitter: NonNegativeFloat = Field(0.0, description="Random displacement of the target, 1 sigma [m].")


CameraSpec = Annotated[CameraPath | CameraOrbit | CameraHemisphere, Field(discriminator="kind")]


class LightKey(StrictModel):
    """State of a light at one time of its path; what is absent stays as the light itself has it."""

    position: Vec3 | None = Field(None, description="Position [m].")
    intensity: Positive | None = Field(None, description="Intensity [W/sr], or an area light's radiance [W/(m^2 sr)].")
    temperature: Kelvin | None = Field(None, description="Colour temperature [K]; needs that of the light.")

    @model_validator(mode="after")
    def _check(self) -> LightKey:
        if self.position is None and self.intensity is None and self.temperature is None:
            raise FieldError((), "must have a position, an intensity or a temperature")
        return self


class LocalLight(StrictModel):
    """What every light at a place has."""

    position: Vec3 = Field(description="Position [m].")
    colour: EmittedColour = (1, 1, 1)
    temperature: Kelvin | None = Field(
        None, description="Temperature of the black body whose colour multiplies that of the light [K]."
    )
    path: tuple[LightKey, ...] = Field(
        (),
        description="Keys evenly spaced over a layout's views, linear in between (temperatures in 1/K); "
        "empty for a light at rest.",
    )

    @model_validator(mode="after")
    def _check_temperature(self) -> LocalLight:
        for number, key in enumerate(self.path):
            if key.temperature is not None and self.temperature is None:
                raise FieldError(("path", number, "temperature"), "needs a temperature of the light itself")
        return self


class AimedLight(LocalLight):
    """What every light that faces something has."""

    target: Vec3 = Field((0, 0, 0), description="Point that it faces [m].")

    @model_validator(mode="after")
    def _check(self) -> AimedLight:
        for position in (self.position, *(key.position for key in self.path)):
            if position == self.target:
                raise FieldError("target", f"must differ from the light's positions (got {list(self.target)})")
        return self


class AreaLight(AimedLight):
    """A rectangle that emits from the face turned to its target."""

    kind: Literal["area"] = Field("area", description="A rectangle.")
    size: tuple[Positive, Positive] = Field((0.5, 0.5), description="Width and height [m].")
    radiance: Positive = Field(10.0, description="Emitted radiance [W/(m^2 sr)].")


class SpotLight(AimedLight):
    """A point that emits into a cone."""

    kind: Literal["spot"] = Field("spot", description="A cone.")
    cone: float = Field(30.0, gt=0, lt=90, description="Half angle of the cone [degrees].")
    intensity: Positive = Field(10.0, description="Radiant intensity [W/sr].")


class PointLight(LocalLight):
    """A point that emits in all directions."""

    kind: Literal["point"] = Field("point", description="A point.")
    intensity: Positive = Field(10.0, description="Radiant intensity [W/sr].")


class EnvironmentLight(StrictModel):
    """A constant sky, or an equirectangular image of it (z up)."""

    kind: Literal["environment"] = Field("environment", description="A sky all around.")
    radiance: Positive = Field(1.0, description="Radiance [W/(m^2 sr)], or the factor on the image.")
    colour: EmittedColour = (1, 1, 1)
    image: str | None = Field(None, description="HDR or EXR file, relative to the scene file.")
    rotate_z: float = Field(0.0, description="Rotation about the vertical [degrees].")


LightSpec = Annotated[AreaLight | SpotLight | PointLight | EnvironmentLight, Field(discriminator="kind")]


class Randomise(StrictModel):
    """Ranges drawn from uniformly, anew for every frame unless stated; a range of equal ends fixes the value."""

    exposure: Range = Field((0.0, 0.0), description="Exposure [stops].")
    hue: Range = Field((0.0, 0.0), description="Hue shift [degrees].")
    saturation: NonNegativeRange = Field((1.0, 1.0), description="Factor on saturation.")
    white_balance: Annotated[tuple[Kelvin, Kelvin], AfterValidator(_ordered)] = Field(
        (6504.0, 6504.0), description="Correlated colour temperature that is shown as white [K]."
    )
    iso: PositiveRange | None = Field(None, description="Sensitivity of the sensor, hence its noise; none if absent.")
    vignetting: NonNegativeRange = Field((0.0, 0.0), description="Loss of light in the image's corners [stops].")
    motion_blur: NonNegativeRange = Field(
        (0.0, 0.0), description="Length of the camera's motion in the image, in a direction drawn anew [px]."
    )
    jpeg: Annotated[tuple[JpegQuality, JpegQuality], AfterValidator(_ordered)] | None = Field(
        None, description="Quality of a JPEG compression before the image is written; none if absent."
    )
    friction: PositiveRange = Field(
        (1.0, 1.0),
        description="Factor on the friction of each entry of objects, drawn once for a layout; its square root "
        "is the factor on contacts with the table.",
    )
    light_intensity: PositiveRange = Field((1.0, 1.0), description="Factor on each light, drawn once for a layout.")


class Sensor(StrictModel):
    """What makes noise of ``randomise.iso``."""

    full_well: Positive = Field(20000.0, description="Electrons of display white at ISO 100.")
    read_noise: NonNegativeFloat = Field(3.0, description="Electrons, 1 sigma.")


class ImageShadow(StrictModel):
    """Parameters of the published image-space shadow (Niżeniec and Iwanowski, section 4.2).

    The shadow map is normalised, blurred, bent by a sigmoid and multiplied; where it is brightest, light is added.
    """

    blur: Positive = Field(5.0, description="Standard deviation of the Gaussian blur [px at a width of 1280].")
    slope: Positive = Field(10.0, description="Steepness of the sigmoid.")
    midpoint: Unit = Field(0.5, description="Value of the normalised map that the sigmoid takes to one half.")
    darkest: Unit = Field(0.35, description="Factor in full shadow.")
    highlight_start: float = Field(
        0.85, ge=0, lt=1, description="Value of the normalised map above which the highlight starts."
    )
    highlight_gain: NonNegativeFloat = Field(0.06, description="Linear value that the highlight adds at most.")


class Composite(StrictModel):
    """How layers become a picture."""

    shadow: Literal["traced", "image", "none"] = Field(
        "traced", description="Shadow rays, the image-space approximation, or no shadow."
    )
    shadow_error: float = Field(
        0.03, gt=0, lt=1, description="Standard error of traced light for which shadow rays are spent."
    )
    image_shadow: ImageShadow = Field(ImageShadow(), description="Parameters of shadow: image.")
    highlight: bool = Field(True, description="Whether highlights of the scene's lights are added.")
    occluders: Literal["proxies", "splats"] = Field(
        "proxies", description="What casts traced shadows of objects: their meshes, or the splats of thin, porous ones."
    )
    bounce: bool = Field(True, description="Whether objects get the light that the environment reflects to them.")
    tone: Literal["neutral", "filmic"] = Field("neutral", description="Tone curve; neutral keeps captured colours.")
    sensor: Sensor = Field(Sensor(), description="Noise of the sensor.")


FormatName = Literal[
    "yolo",
    "yolo-detect",
    "yolo-obb",
    "yolo-pose",
    "coco",
    "amodal",
    "panoptic",
    "poses",
    "voc",
    "label-studio",
    "bop",
    "colmap",
    "depth",
    "normals",
    "instances",
    "semantic",
    "flow",
    "exr",
]
FORMATS: tuple[str, ...] = get_args(FormatName)


class Output(StrictModel):
    """What is written."""

    width: int = Field(1280, ge=1, le=16384, description="Image width [px].")
    height: int = Field(720, ge=1, le=16384, description="Image height [px].")
    layouts: int = Field(4, ge=1, description="How many times the objects are dropped.")
    views: int = Field(10, ge=1, description="Images of each layout.")
    formats: tuple[FormatName, ...] = Field(
        ("yolo",), min_length=1, description="Label formats, and exr for every layer."
    )
    image: Literal["png", "jpg"] = Field("png", description="Image file format.")
    jpeg_quality: int = Field(95, ge=1, le=100, description="Quality of jpg images.")
    validation: Unit = Field(
        0.2, description="Share of layouts for validation; the second layout is the first of the smaller split."
    )


class Rendering(StrictModel):
    """How splats are drawn, whatever the preset; see :class:`mitsplat.quality.Quality`."""

    response: ResponseName = Field(
        "perspective",
        description="Every ray's exact perspective, or parallel rays within a Gaussian as in trainers.",
    )
    kernel: KernelName = Field(
        "exact",
        description="The Gaussian itself, widened by a pixel so that nothing sparkles, or as those trainers dilate it.",
    )
    samples: int = Field(1, ge=1, le=8, description="Rays per pixel along each axis: 2 smooths silhouettes.")
    lens_rings: int = Field(2, ge=1, le=8, description="Rings of points on a thin lens: 1, 2, 3 take 7, 19, 37 images.")


class LabelRules(StrictModel):
    """What is labelled, see :mod:`mitsplat.labels.labels`."""

    source: Literal["splats", "proxies"] = Field(
        "splats", description="Where masks come from: what the image shows, or the proxy meshes."
    )
    min_pixels: int = Field(16, ge=1, description="Instances with fewer visible pixels are not labelled.")
    min_fragment: int = Field(8, ge=1, description="Connected parts with fewer pixels are dropped from a mask.")
    min_visible: Unit = Field(0.05, description="Visible fraction below which an instance is occluded.")
    min_agreement: Unit = Field(
        0.5, description="IoU of the masks by splats and by proxies below which an instance is disagreeing."
    )
    below_threshold: Literal["drop", "mark"] = Field(
        "mark", description="Whether occluded and disagreeing instances are not labelled, or labelled and marked."
    )


class SceneSpec(StrictModel):
    """A scene file. Lengths in metres, angles in degrees, z up; paths are relative to the file."""

    name: str = Field(min_length=1, description="Name of the dataset.")
    environment: str | None = Field(None, description="Asset folder of the surroundings, relative to the scene file.")
    environment_collides: bool = Field(
        False,
        description="Whether objects also rest on the environment's mesh, whose convex pieces take minutes to make.",
    )
    shapes: tuple[Shape, ...] = Field((), description="Tabletop, walls and other things that do not move.")
    objects: tuple[ObjectSpec, ...] = Field((), description="What is dropped and labelled.")
    empty: Unit = Field(
        0.0,
        exclude_if=lambda empty: empty == 0,
        description="Share of layouts, in each split, that nothing which is labelled lies in.",
    )
    region: Region = Field(description="Where objects are dropped from.")
    enclosure: Enclosure | None = Field(None, description="Invisible walls around the region.")
    settle: Settle = Field(Settle(), description="How objects come to rest.")
    camera: CameraSpec = Field(description="Where images are taken from.")
    lights: tuple[LightSpec, ...] = Field((), description="Light sources.")
    randomise: Randomise = Field(Randomise(), description="What varies from image to image.")
    composite: Composite = Field(Composite(), description="Shadows, highlights and tone.")
    labels: LabelRules = Field(LabelRules(), description="What is labelled.")
    output: Output = Field(Output(), description="Number, size and formats of the images.")
    quality: PresetName = Field("balanced", description="Rendering preset.")
    rendering: Rendering = Field(Rendering(), description="How splats are drawn.")
    seed: int = Field(0, ge=0, description="Decides, with the frame's index, everything that is random.")

    @model_validator(mode="after")
    def _check(self) -> SceneSpec:
        seen: set[str] = set()
        for position, shape in enumerate(self.shapes):
            if shape.name in seen:
                raise FieldError(("shapes", position, "name"), f"must be unique (got {shape.name!r} again)")
            seen.add(shape.name)
        skies = [position for position, light in enumerate(self.lights) if isinstance(light, EnvironmentLight)]
        if len(skies) > 1:
            raise FieldError(("lights", skies[1], "kind"), "must not be a second environment light")
        if self.enclosure is not None and self.enclosure.floor >= self.region.max[2]:
            raise FieldError(
                ("enclosure", "floor"),
                f"must be below the region's top at {self.region.max[2]:g} m (got {self.enclosure.floor:g})",
            )
        return self
