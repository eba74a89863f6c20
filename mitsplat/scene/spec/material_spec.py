"""Keys of a scene file about what visible shapes are made of, and what is behind everything."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from mitsplat.storage.field_types import PositiveRange, Range, StrictModel, UnitRange, ordered

Share = Annotated[float, Field(gt=0, le=1)]
Turn = Annotated[Range, Field(description="Rotation of the pattern on the surface [degrees], drawn from this range.")]


class _Coloured(StrictModel):
    hue: Range = Field((0, 360), description="Hue [degrees], drawn from this range; beyond 360 it goes on from 0.")
    saturation: UnitRange = Field((0, 0.6), description="Saturation (HSV, of sRGB-encoded colours), drawn likewise.")
    value: UnitRange = Field((0.2, 0.9), description="Value (HSV, of sRGB-encoded colours), drawn likewise.")


class _Patterned(_Coloured):
    contrast: UnitRange = Field(
        (0.1, 0.5), description="How much darker the second colour is than the first, a share of its value, drawn."
    )
    scale: PositiveRange = Field((0.02, 0.1), description="Size of the pattern's largest features [m], drawn.")
    rotate: Turn = (0, 360)


class ColourMaterial(_Coloured):
    """One diffuse colour."""

    kind: Literal["colour"] = Field("colour", description="One colour.")


class NoiseMaterial(_Patterned):
    """Diffuse, two colours in clouds of all sizes: concrete, stone, stained cloth."""

    kind: Literal["noise"] = Field("noise", description="Clouds of two colours.")


class WoodMaterial(_Patterned):
    """Diffuse, bent lines of grain along one direction."""

    kind: Literal["wood"] = Field("wood", description="Grain.")
    hue: Range = Field((18, 38), description="Hue [degrees], drawn.")
    saturation: UnitRange = Field((0.3, 0.65), description="Saturation, drawn.")
    value: UnitRange = Field((0.35, 0.85), description="Value, drawn.")
    scale: PositiveRange = Field((0.01, 0.03), description="Distance of the lines of grain [m], drawn.")


class BrushedMetalMaterial(_Patterned):
    """Metal with scratches along one direction. It is path traced, which takes longer than all diffuse materials."""

    kind: Literal["brushed_metal"] = Field("brushed_metal", description="Metal with scratches.")
    hue: Range = Field((20, 230), description="Hue [degrees], drawn.")
    saturation: UnitRange = Field((0, 0.08), description="Saturation, drawn.")
    value: UnitRange = Field((0.7, 0.9), description="Value, drawn.")
    contrast: UnitRange = Field((0.03, 0.15), description="How much darker scratches are, drawn.")
    scale: PositiveRange = Field((0.05, 0.2), description="Length of scratches [m], drawn.")
    roughness: UnitRange = Field(
        (0.15, 0.35), description="Roughness (GGX) across the scratches, drawn; along them it is a third of that."
    )


class CheckerMaterial(_Patterned):
    """Diffuse squares of two colours."""

    kind: Literal["checker"] = Field("checker", description="Squares.")
    contrast: UnitRange = Field((0.3, 0.9), description="How much darker every second square is, drawn.")
    scale: PositiveRange = Field((0.02, 0.2), description="Edge of a square [m], drawn.")


class StripesMaterial(_Patterned):
    """Diffuse, straight bands side by side, each darker towards one edge: slats, planks, corrugated sheet."""

    kind: Literal["stripes"] = Field("stripes", description="Bands.")
    contrast: UnitRange = Field((0.2, 0.7), description="How much darker a band's edge is, drawn.")
    scale: PositiveRange = Field((0.02, 0.12), description="Width of a band [m], drawn.")


class ImageMaterial(StrictModel):
    """Diffuse, an image side by side with itself."""

    kind: Literal["image"] = Field("image", description="An image.")
    images: str | tuple[str, ...] = Field(
        description="Image file, folder of images, pattern such as ``textures/*.jpg``, or a list of files, relative to "
        "the scene file; of several, one is drawn."
    )
    scale: PositiveRange = Field((0.3, 1.0), description="Width of the image on the surface [m], drawn.")
    rotate: Turn = (0, 360)
    gain: PositiveRange = Field((1.0, 1.0), description="Factor on the image's linear colours, drawn.")


Material = Annotated[
    ColourMaterial
    | NoiseMaterial
    | WoodMaterial
    | BrushedMetalMaterial
    | CheckerMaterial
    | StripesMaterial
    | ImageMaterial,
    Field(discriminator="kind"),
]


class Background(StrictModel):
    """Images behind everything, which are seen where nothing of the scene is: in no label, and no source of light."""

    images: str | tuple[str, ...] = Field(
        description="Folder of images, pattern such as ``photos/*.jpg``, or a list of files, relative to the scene "
        "file, one of which is drawn."
    )
    per: Literal["frame", "layout"] = Field("frame", description="Whether each image or each layout draws one.")
    crop: Annotated[tuple[Share, Share], AfterValidator(ordered)] = Field(
        (0.5, 1.0),
        description="Size of what is shown of it, relative to the largest part that has the picture's proportions, "
        "drawn.",
    )
    rotate: Range = Field((-15, 15), description="Rotation [degrees], drawn; turned parts stay inside of the image.")
    gain: PositiveRange = Field((0.7, 1.3), description="Factor on its linear colours, drawn.")
