"""Keys of the scene file for materials of visible shapes and for the background."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from mitsplat.storage.field_types import PositiveRange, Range, StrictModel, UnitRange


class _Coloured(StrictModel):
    hue: Range = Field((0, 360), description="Range of hues [degrees]. Values beyond 360 wrap around.")
    saturation: UnitRange = Field((0, 0.6), description="Range of saturations (HSV of sRGB-encoded colours).")
    value: UnitRange = Field((0.2, 0.9), description="Range of values (HSV of sRGB-encoded colours).")


class _Patterned(_Coloured):
    contrast: UnitRange = Field(
        (0.1, 0.5),
        description="Range of contrasts: 1 minus the ratio of the HSV value of the second colour to that of the first.",
    )
    scale: PositiveRange = Field((0.02, 0.1), description="Range of sizes of the largest features of the pattern [m].")


class ColourMaterial(_Coloured):
    """Diffuse material of one colour."""

    kind: Literal["colour"] = Field("colour", description="Uniform colour.")


class NoiseMaterial(_Patterned):
    """Diffuse material with multi-scale noise of two colours, such as concrete, stone or stained cloth."""

    kind: Literal["noise"] = Field("noise", description="Noise of two colours.")


class WoodMaterial(_Patterned):
    """Diffuse material with curved grain lines along one direction."""

    kind: Literal["wood"] = Field("wood", description="Wood grain.")
    hue: Range = Field((18, 38), description="Range of hues [degrees].")
    saturation: UnitRange = Field((0.3, 0.65), description="Range of saturations.")
    value: UnitRange = Field((0.35, 0.85), description="Range of values.")
    scale: PositiveRange = Field((0.01, 0.03), description="Range of distances between grain lines [m].")


class CheckerMaterial(_Patterned):
    """Diffuse checkerboard of two colours."""

    kind: Literal["checker"] = Field("checker", description="Checkerboard.")
    contrast: UnitRange = Field((0.3, 0.9), description="Range of contrasts between neighbouring squares.")
    scale: PositiveRange = Field((0.02, 0.2), description="Range of edge lengths of a square [m].")


class StripesMaterial(_Patterned):
    """Diffuse parallel bands, each darker towards one edge, such as slats, planks or corrugated sheet."""

    kind: Literal["stripes"] = Field("stripes", description="Stripes.")
    contrast: UnitRange = Field((0.2, 0.7), description="Range of contrasts between a band and its dark edge.")
    scale: PositiveRange = Field((0.02, 0.12), description="Range of widths of a band [m].")


class ImageMaterial(StrictModel):
    """Diffuse material with a repeated image."""

    kind: Literal["image"] = Field("image", description="Image texture.")
    images: str | tuple[str, ...] = Field(
        description="Image file, folder of images, pattern such as ``textures/*.jpg``, or list of files, relative to "
        "the scene file. Of several images, one is drawn."
    )
    scale: PositiveRange = Field((0.3, 1.0), description="Range of widths of the image on the surface [m].")


Material = Annotated[
    ColourMaterial | NoiseMaterial | WoodMaterial | CheckerMaterial | StripesMaterial | ImageMaterial,
    Field(discriminator="kind"),
]


class Background(StrictModel):
    """Images behind the scene. They are visible where a ray hits nothing, have no label and emit no light.

    Every frame draws an image and a crop of it: one half to all of the largest crop with the aspect ratio of the
    output, rotated by at most 15 degrees, 0.7 to 1.3 times as bright.
    """

    images: str | tuple[str, ...] = Field(
        description="Folder of images, pattern such as ``photos/*.jpg``, or list of files, relative to the scene file."
    )
