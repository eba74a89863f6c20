"""Keys of the scene file for images: random variation, compositing and splat rendering."""

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
    check_order,
)


class Randomise(StrictModel):
    """Ranges of uniformly distributed values, drawn for every frame unless stated otherwise.

    A range with equal ends fixes the value.
    """

    exposure: StopsRange = Field((0.0, 0.0), description="Exposure [stops].")
    hue: Range = Field((0.0, 0.0), description="Hue shift [degrees].")
    saturation: NonNegativeRange = Field((1.0, 1.0), description="Factor on saturation.")
    chroma_stretch: PositiveRange = Field(
        (1.0, 1.0),
        exclude_if=lambda stretch: stretch == (1.0, 1.0),
        description="Factor on chroma along one hue axis, the direction ``chroma_angle`` and its opposite. Chroma "
        "along the perpendicular axis is divided by the factor; greys stay unchanged. This models "
        "cameras that reproduce colours differently but greys alike.",
    )
    chroma_angle: Range = Field(
        (0.0, 180.0),
        exclude_if=lambda angle: angle == (0.0, 180.0),
        description="Angle of the hue axis of ``chroma_stretch`` from red towards green [degrees]. At 0, blue moves "
        "towards cyan and orange towards red.",
    )
    white_balance: Annotated[tuple[Kelvin, Kelvin], AfterValidator(check_order)] = Field(
        (6504.0, 6504.0), description="Correlated colour temperature that appears white [K]."
    )
    iso: PositiveRange | None = Field(
        None, description="ISO sensitivity of the sensor, which determines its noise. No noise if absent."
    )
    vignetting: NonNegativeRange = Field((0.0, 0.0), description="Loss of light in the corners of the image [stops].")
    chromatic_aberration: Range = Field(
        (0.0, 0.0),
        exclude_if=lambda aberration: aberration == (0.0, 0.0),
        description="Lateral chromatic aberration: shift of red outwards and of blue inwards in the corners of the "
        "image [px]. Green and the labels do not move.",
    )
    motion_blur: BlurRange = Field(
        (0.0, 0.0),
        description="Length of the motion blur in the image [px]. Its direction is drawn for every frame.",
    )
    sharpening: NonNegativeRange = Field(
        (0.0, 0.0),
        exclude_if=lambda sharpening: sharpening == (0.0, 0.0),
        description="Strength of an unsharp mask: factor on the difference between the picture and its Gaussian blur "
        "of 1 px. It also amplifies noise.",
    )
    jpeg: Annotated[tuple[JpegQuality, JpegQuality], AfterValidator(check_order)] | None = Field(
        None, description="JPEG quality of a compression before the image is written. No compression if absent."
    )


class StereoSensor(StrictModel):
    """Depth from the disparity between the camera and an identical camera to its right."""

    kind: Literal["stereo"] = Field("stereo", description="Disparity between two cameras.")
    baseline: Positive = Field(0.055, description="Distance between the two cameras [m].")
    noise: NonNegativeFloat = Field(0.1, description="Noise of the disparity [px], 1 sigma.")
    step: Positive = Field(0.125, description="Quantisation step of the disparity [px].")
    shift: NonNegativeFloat = Field(
        0.5, description="Random shift of the pixel at which the disparity is read [px], 1 sigma. It frays edges."
    )
    contrast: Unit = Field(
        0.0,
        description="Minimum standard deviation of the intensity in a window of 9x9 pixels, in [0, 1], for a "
        "disparity to be found. 0 models a projected pattern.",
    )
    range: PositiveRange = Field((0.1, 10.0), description="Range of measurable depths [m].")


class TimeOfFlightSensor(StrictModel):
    """Depth from the phase of modulated light."""

    kind: Literal["tof"] = Field("tof", description="Time of flight.")
    noise: NonNegativeFloat = Field(
        0.002, description="Noise of the distance of a white surface at 1 m that faces the sensor [m], 1 sigma."
    )
    ambient: NonNegativeFloat = Field(
        0.0, description="Ambient light, relative to the signal of a white surface at 1 m that faces the sensor."
    )
    blur: NonNegativeFloat = Field(
        0.6, description="Spread of light between neighbouring pixels [px], 1 sigma of a Gaussian."
    )
    modulation: Positive = Field(
        20.0, description="Modulation frequency f [MHz]. Distances wrap around at c / (2 f), which is 7.5 m at 20 MHz."
    )
    min_signal: Positive = Field(
        0.004,
        description="Minimum measurable signal, relative to that of a white surface at 1 m that faces the sensor.",
    )


DepthSensor = Annotated[StereoSensor | TimeOfFlightSensor, Field(discriminator="kind")]


class ImageShadow(StrictModel):
    """Parameters of the published image-space shadow (Niżeniec and Iwanowski, section 4.2).

    The shadow map is normalised, blurred, mapped by a sigmoid and multiplied with the image. Where the map is
    brightest, a highlight is added.
    """

    blur: Positive = Field(5.0, description="Standard deviation of the Gaussian blur [px at a width of 1280].")
    slope: Positive = Field(10.0, description="Steepness of the sigmoid.")
    midpoint: Unit = Field(0.5, description="Value of the normalised map at which the sigmoid is one half.")
    darkest: Unit = Field(0.35, description="Factor in full shadow.")
    highlight_start: float = Field(
        0.85, ge=0, lt=1, description="Value of the normalised map above which the highlight starts."
    )
    highlight_gain: NonNegativeFloat = Field(0.06, description="Maximum linear value that the highlight adds.")


class Composite(StrictModel):
    """Composition of the layers into an image."""

    shadow: Literal["traced", "image", "none"] = Field(
        "traced",
        description="Shadow method: ``traced`` for shadow rays, ``image`` for the image-space approximation, "
        "``none`` for no shadow.",
    )
    shadow_error: float = Field(
        0.03,
        gt=0,
        lt=1,
        description="Target standard error of the traced light where half of the light arrives. It determines the "
        "number of shadow rays. Elsewhere the target is perceptually equal.",
    )
    image_shadow: ImageShadow = Field(ImageShadow(), description="Parameters of ``shadow: image``.")
    highlight: bool = Field(True, description="Adds specular highlights of the lights of the scene.")
    occluders: Literal["proxies", "splats"] = Field(
        "proxies",
        description="Occluders in traced shadows of objects: ``proxies`` for the meshes, ``splats`` for the splats "
        "of thin, porous objects.",
    )
    bounce: bool = Field(
        True, description="Adds the light that the environment and visible shapes reflect onto objects."
    )
    exposure: Literal["fixed", "auto"] = Field(
        "fixed",
        description="``fixed`` uses the given light intensities. ``auto`` models auto-exposure: every picture has "
        "the same mean brightness. ``randomise.exposure`` is added in both cases.",
    )
    tone: Literal["neutral", "filmic"] = Field(
        "neutral",
        description="Tone curve. ``neutral`` preserves the captured colours; ``filmic`` compresses highlights.",
    )


class Rendering(StrictModel):
    """Options of the splat renderer that do not depend on the preset, see :class:`mitsplat.quality.Quality`."""

    response: ResponseName = Field(
        "perspective",
        description="``perspective`` evaluates Gaussians along exact perspective rays. ``ewa`` uses parallel rays "
        "within the footprint of each Gaussian, as trainers do.",
    )
    kernel: KernelName = Field(
        "exact",
        description="Footprint of a Gaussian: ``exact`` for the Gaussian itself, ``mip`` for one widened by a pixel "
        "against aliasing, ``3dgs`` and ``gsplat`` for the dilation of those trainers.",
    )
    samples: Annotated[int, Field(ge=1, le=8)] | Literal["edges"] = Field(
        "edges",
        description="Rays per pixel along each axis. ``edges`` takes one ray per pixel, and 2 x 2 rays where objects "
        "border on each other.",
    )
    lens_rings: int = Field(
        2,
        ge=1,
        le=8,
        description="Rings of sample points on the aperture of a thin lens. 1, 2 and 3 rings need 7, 19 and 37 images.",
    )
