"""Keys of a scene file about the picture: what varies, how it is composed and drawn."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, NonNegativeFloat

from mitsplat.quality import KernelName, ResponseName
from mitsplat.storage.field_types import (
    BlurRange,
    JpegQuality,
    Kelvin,
    NonNegativeRange,
    Positive,
    PositiveRange,
    Range,
    StopsRange,
    StrictModel,
    Unit,
    ordered,
)


class Randomise(StrictModel):
    """Ranges drawn from uniformly, anew for every frame unless stated; a range of equal ends fixes the value."""

    exposure: StopsRange = Field((0.0, 0.0), description="Exposure [stops].")
    hue: Range = Field((0.0, 0.0), description="Hue shift [degrees].")
    saturation: NonNegativeRange = Field((1.0, 1.0), description="Factor on saturation.")
    chroma_stretch: PositiveRange = Field(
        (1.0, 1.0),
        exclude_if=lambda stretch: stretch == (1.0, 1.0),
        description="How many times farther from grey the camera shows a hue and its opposite, and nearer the hues "
        "between: cameras show colours each in its own way, and greys alike.",
    )
    chroma_angle: Range = Field(
        (0.0, 180.0),
        exclude_if=lambda angle: angle == (0.0, 180.0),
        description="Angle of that hue from red, towards green [degrees]: at 0 blue is seen nearer to cyan, and orange "
        "to red.",
    )
    white_balance: Annotated[tuple[Kelvin, Kelvin], AfterValidator(ordered)] = Field(
        (6504.0, 6504.0), description="Correlated colour temperature that is shown as white [K]."
    )
    iso: PositiveRange | None = Field(None, description="Sensitivity of the sensor, hence its noise; none if absent.")
    vignetting: NonNegativeRange = Field((0.0, 0.0), description="Loss of light in the image's corners [stops].")
    chromatic_aberration: Range = Field(
        (0.0, 0.0),
        exclude_if=lambda aberration: aberration == (0.0, 0.0),
        description="How far the lens shifts red outwards, and blue inwards, in the image's corners [px]; green stays, "
        "and so do labels.",
    )
    motion_blur: BlurRange = Field(
        (0.0, 0.0), description="Length of the camera's motion in the image, in a direction drawn anew [px]."
    )
    sharpening: NonNegativeRange = Field(
        (0.0, 0.0),
        exclude_if=lambda sharpening: sharpening == (0.0, 0.0),
        description="How many times the camera adds what the picture has beyond its blur of 1 px, noise too.",
    )
    jpeg: Annotated[tuple[JpegQuality, JpegQuality], AfterValidator(ordered)] | None = Field(
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


class StereoSensor(StrictModel):
    """Depth by disparity between the camera and one like it to its right."""

    kind: Literal["stereo"] = Field("stereo", description="Disparity to a second camera.")
    baseline: Positive = Field(0.055, description="Distance of the two cameras [m].")
    noise: NonNegativeFloat = Field(0.1, description="Error of a disparity [px], 1 sigma.")
    step: Positive = Field(0.125, description="Steps that disparities are measured in [px].")
    shift: NonNegativeFloat = Field(0.5, description="Error of where it is measured [px], 1 sigma, which frays edges.")
    contrast: Unit = Field(0.0, description="Least standard deviation of 9x9 pixels, of 1; 0 with a projected pattern.")
    range: PositiveRange = Field((0.1, 10.0), description="Depths that are measured [m].")


class TimeOfFlightSensor(StrictModel):
    """Depth by the phase of modulated light."""

    kind: Literal["tof"] = Field("tof", description="Time of flight.")
    noise: NonNegativeFloat = Field(0.002, description="Error of a white surface that faces it at 1 m [m], 1 sigma.")
    ambient: NonNegativeFloat = Field(0.0, description="Ambient light, relative to what such a surface returns.")
    blur: NonNegativeFloat = Field(0.6, description="Light of a pixel that its neighbours get [px], 1 sigma.")
    modulation: Positive = Field(20.0, description="Frequency [MHz]; distances wrap around at c / 2 of it, here 7.5 m.")
    min_signal: Positive = Field(0.004, description="Least light that is measured, relative to the same.")


DepthSensor = Annotated[StereoSensor | TimeOfFlightSensor, Field(discriminator="kind")]


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
        0.03,
        gt=0,
        lt=1,
        description="Standard error, where half of the light arrives, for which shadow rays are spent; elsewhere as "
        "much to the eye.",
    )
    image_shadow: ImageShadow = Field(ImageShadow(), description="Parameters of shadow: image.")
    highlight: bool = Field(True, description="Whether highlights of the scene's lights are added.")
    occluders: Literal["proxies", "splats"] = Field(
        "proxies", description="What casts traced shadows of objects: their meshes, or the splats of thin, porous ones."
    )
    bounce: bool = Field(
        True, description="Whether objects get the light that the environment and visible shapes reflect to them."
    )
    exposure: Literal["fixed", "auto"] = Field(
        "fixed",
        description="As lights are given, or as a camera that exposes by itself: every picture as bright on average. "
        "randomise.exposure is added.",
    )
    tone: Literal["neutral", "filmic"] = Field("neutral", description="Tone curve; neutral keeps captured colours.")
    sensor: Sensor = Field(Sensor(), description="Noise of the sensor.")


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
    samples: Annotated[int, Field(ge=1, le=8)] | Literal["edges"] = Field(
        "edges",
        description="Rays per pixel along each axis; `edges` for one, and 2 x 2 where objects border on each other.",
    )
    lens_rings: int = Field(2, ge=1, le=8, description="Rings of points on a thin lens: 1, 2, 3 take 7, 19, 37 images.")
