"""Keys of the scene file for images: random variation, compositing and splat rendering."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, NonNegativeFloat, model_validator

from mitsplat.quality import KernelName, ResponseName
from mitsplat.storage.field_types import (
    BlurRange,
    JpegRange,
    Kelvin,
    KelvinRange,
    NonNegativeRange,
    Positive,
    PositiveRange,
    Range,
    Stops,
    StopsRange,
    StrictModel,
    Unit,
    optional_field,
)
from mitsplat.storage.yaml_input import FieldError

DAYLIGHT = 6504.0
"""Colour temperature of sRGB's white [K]."""


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
    white_balance: KelvinRange = Field(
        (DAYLIGHT, DAYLIGHT),
        description="Colour temperature that appears white [K]. With ``composite.white_balance: auto`` it is the error "
        "of the automatic white balance: neutral light looks as light of 6504 K does to a camera that is balanced for "
        "this temperature.",
    )
    iso: PositiveRange | None = Field(
        None,
        description="ISO sensitivity of the sensor, which determines its noise but not its exposure. No noise if "
        "absent.",
    )
    vignetting: NonNegativeRange = Field((0.0, 0.0), description="Loss of light in the corners of the image [stops].")
    chromatic_aberration: Range = Field(
        (0.0, 0.0),
        exclude_if=lambda aberration: aberration == (0.0, 0.0),
        description="Lateral chromatic aberration: shift of red outwards and of blue inwards in the corners of the "
        "image [px]. Green and the labels do not move.",
    )
    motion_blur: BlurRange = Field(
        (0.0, 0.0), description="Length of the motion blur in the image [px]. Its direction is drawn for every frame."
    )
    sharpening: NonNegativeRange = Field(
        (0.0, 0.0),
        exclude_if=lambda sharpening: sharpening == (0.0, 0.0),
        description="Strength of an unsharp mask: factor on the difference between the picture and its Gaussian blur "
        "of 1 px. It also amplifies noise.",
    )
    jpeg: JpegRange | None = Field(
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


def _check_exposure(exposure: object) -> object:
    """Refuse other words and numbers; otherwise pydantic would report one member of the union."""
    if isinstance(exposure, dict | CameraExposure) or exposure in ("auto", "fixed"):
        return exposure
    raise ValueError(f"must be auto, fixed, or a mapping with ev, or with aperture and shutter (got {exposure!r})")


def _check_white_balance(balance: object) -> object:
    """Refuse other words; otherwise pydantic would report one member of the union."""
    if balance == "auto" or (isinstance(balance, int | float) and not isinstance(balance, bool)):
        return balance
    raise ValueError(f"must be auto or a colour temperature in K (got {balance!r})")


class CameraExposure(StrictModel):
    """Exposure of a camera: ``ev``, or ``aperture``, ``shutter`` and ``iso``.

    A surface of luminance 1.2 * 2^EV [cd/m^2] has the picture value 1. This is the saturation-based speed of ISO 12232
    with a lens that transmits 65 % of the light. Radiance 1 W/(m^2 sr) has the luminance 179 cd/m^2.
    """

    ev: Stops | None = optional_field("Exposure value at ISO 100: log2(f-number^2 / shutter * 100 / ISO).")
    aperture: Positive | None = optional_field("f-number. It does not change the depth of field.")
    shutter: Positive | None = optional_field("Exposure time [s]. It does not blur moving objects.")
    iso: Positive = Field(100.0, description="ISO sensitivity. It adds no noise.")

    @model_validator(mode="after")
    def _check(self) -> CameraExposure:
        stated = self.model_fields_set & {"aperture", "shutter", "iso"}
        if self.ev is not None and stated:
            raise FieldError(min(stated), "must not be given together with ev")
        if self.ev is None and (self.aperture is None or self.shutter is None):
            raise FieldError("aperture" if self.aperture is None else "shutter", "is required if ev is absent")
        return self

    @property
    def value(self) -> float:
        """Exposure value at ISO 100."""
        if self.aperture is None or self.shutter is None:
            return self.ev or 0.0
        return math.log2(self.aperture**2 / self.shutter * 100.0 / self.iso)


class Composite(StrictModel):
    """Composition of an image: traced light, exposure and tone curve."""

    shadow: Literal["traced", "image", "none"] = Field(
        "traced",
        description="Shadow method: ``traced`` for shadow rays, ``image`` for the image-space approximation, "
        "``none`` for no shadow.",
    )
    shadow_error: float = Field(
        0.03,
        gt=0,
        lt=1,
        description="Target standard error of traced light that is half as bright as white. The target for other light "
        "is equal in perceived brightness. Smaller values take more rays for shadows and reflections: 0.03 takes 10 "
        "to 64 rays per pixel in penumbras and on objects.",
    )
    highlight: bool = Field(
        True,
        description="Adds reflections that do not have the colour of the surface: those of plastics, and those of "
        "metals at grazing angles.",
    )
    occluders: Literal["proxies", "splats"] = Field(
        "proxies",
        description="Occluders in traced shadows of objects: ``proxies`` for the meshes, ``splats`` for the splats "
        "of thin, porous objects.",
    )
    bounce: bool = Field(
        True,
        description="Adds indirect light: from surroundings and objects onto objects, and from objects onto surfaces.",
    )
    exposure: Annotated[
        Literal["auto", "fixed"] | CameraExposure,
        BeforeValidator(_check_exposure, json_schema_input_type=Literal["auto", "fixed"] | CameraExposure),
    ] = Field(
        "auto",
        description="``auto`` meters the picture: its mean encoded luminance is middle grey, 118 of 255. "
        "``fixed`` shows a radiance of 1 W/(m^2 sr) as white or, if the asset of the environment states ``white``, "
        "that of a white surface under this irradiance. A mapping is the exposure of a camera. "
        "``randomise.exposure`` is added in all cases.",
    )
    white_balance: Annotated[
        Kelvin | Literal["auto"], BeforeValidator(_check_white_balance, json_schema_input_type=Kelvin | Literal["auto"])
    ] = Field(
        DAYLIGHT,
        description="Colour temperature that appears white [K]. ``auto`` makes a white surface neutral at the bottom "
        "centre of ``region``, facing up without occlusion.",
    )
    tone: Literal["neutral", "filmic"] = Field(
        "neutral",
        description="Tone curve. ``neutral`` preserves the captured colours; ``filmic`` compresses highlights.",
    )


class Rendering(StrictModel):
    """Splat rendering, independent of the preset."""

    response: ResponseName = Field(
        "perspective",
        description="``perspective`` evaluates Gaussians along exact perspective rays. ``ewa`` uses parallel rays "
        "within the footprint of each Gaussian, as trainers do.",
    )
    kernel: KernelName | None = Field(
        None,
        description="Footprint of a Gaussian: ``exact`` for the Gaussian itself, ``mip`` for one widened by a pixel "
        "against aliasing, ``3dgs`` and ``gsplat`` for the dilation of those trainers. By default, ``mip`` if a splat "
        "file of the scene states that it was trained with antialiasing, else ``exact``.",
    )
    samples: Annotated[int, Field(ge=1, le=8)] | Literal["edges"] = Field(
        "edges",
        description="Rays per pixel along each axis; ``edges`` takes one. At borders of objects, ``edges`` and 2 take "
        "2 x 2 rays, and larger numbers 4 x 4.",
    )
    lens_rings: int = Field(
        2,
        ge=1,
        le=8,
        description="Rings of sample points on the aperture of a thin lens. 1, 2 and 3 rings need 7, 19 and 37 images.",
    )
