"""Where a layout lies, beside its objects: which environment, of what its visible shapes are made, what is behind all.

The seed and the layout's index decide it, and the frame's index what changes from frame to frame.
"""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsplat.scene.spec.material_spec import Background, BrushedMetalMaterial, ColourMaterial, ImageMaterial, Material
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.splits import draw_environment
from mitsplat.scene.streams import random_stream
from mitsplat.scene.walls import finish_name

if TYPE_CHECKING:
    from mitsplat.asset import Asset
    from mitsplat.scene.scene import Scene

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class MaterialDraw:
    """A material as one layout has it.

    Attributes:
        kind: As in the scene file.
        colours: Of its pattern, sRGB-encoded: one, two, or none of an image.
        scale: Size of its largest features, or width of the image [m].
        rotate: Rotation on the surface [degrees].
        offset: Shift on the surface, in shares of a repetition.
        roughness: Across the scratches of metal, GGX.
        gain: Factor on the image's linear colours.
        image: Name of the image file.
        seed: Of its pattern.
    """

    kind: str
    colours: tuple[Colour, ...] = ()
    scale: float = 1.0
    rotate: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    roughness: float | None = None
    gain: float | None = None
    image: str | None = None
    seed: int = 0

    def to_json(self) -> dict[str, Any]:
        """The finish as JSON values, without what its kind has none of."""
        return {name: value for name, value in vars(self).items() if value not in (None, ())}


@dataclass(frozen=True)
class BackgroundDraw:
    """An image behind everything, as one frame shows it.

    Attributes:
        image: Name of the file.
        crop: Size of what is shown, relative to the largest part of the picture's proportions, turned as it is.
        place: Where that lies, in shares of the room that it has, from the left and from the top.
        rotate: Rotation [degrees].
        gain: Factor on its linear colours.
    """

    image: str
    crop: float
    place: tuple[float, float]
    rotate: float
    gain: float

    def to_json(self) -> dict[str, Any]:
        """The same as JSON values."""
        return dict(vars(self))


@dataclass(frozen=True)
class LayoutSurroundings:
    """What was drawn for the surroundings of a frame.

    Attributes:
        environment: Position among the scene's environments; 0 without any.
        finishes: Materials of visible shapes that draw one by their names, and of all walls of a backdrop.
        background: What is behind everything, if it is an image.
    """

    environment: int = 0
    finishes: Mapping[str, MaterialDraw] = field(default_factory=dict)
    background: BackgroundDraw | None = None

    def finish_of(self, shape: str) -> MaterialDraw | None:
        """Material of a shape by its name, if it draws one."""
        return self.finishes.get(finish_name(shape))

    def to_json(self, spec: SceneSpec) -> dict[str, Any]:
        """What the scene file leaves open, as JSON values; empty if that is nothing."""
        told: dict[str, Any] = {}
        if isinstance(spec.environment, tuple):
            told["environment"] = {"number": self.environment, "name": spec.environment[self.environment]}
        if self.finishes:
            told["materials"] = {name: finish.to_json() for name, finish in self.finishes.items()}
        if self.background is not None:
            told["background"] = self.background.to_json()
        return told


def draw_place(spec: SceneSpec, index: int, layout: int | None = None) -> LayoutSurroundings:
    """The place of frame ``index``, of a layout of one's own where its number is given."""
    layout = index // spec.output.views if layout is None else layout
    materials = {finish_name(shape.name): shape.materials for shape in spec.shapes if shape.materials}
    finishes = {name: draw_finish(among, spec.seed, name, layout) for name, among in materials.items()}
    background = None
    if spec.background is not None:
        background = draw_backing(spec.background, spec.seed, index if spec.background.per == "frame" else layout)
    return LayoutSurroundings(draw_environment(spec, layout), finishes, background)


def environment_at(scene: Scene, place: LayoutSurroundings) -> Asset | None:
    """The surroundings of a place."""
    return scene.environments[place.environment] if scene.environments else None


def draw_finish(materials: Sequence[Material], seed: int, name: str, layout: int) -> MaterialDraw:
    """One of some materials, with its ranges drawn."""
    rng = random_stream(seed, f"material {name}", layout)
    material = materials[int(rng.integers(len(materials)))]
    pattern = int(rng.integers(2**31))
    # All are drawn, so that none depends on which others a material has.
    hue, saturation, value, contrast, scale, rotate, other, u, v, which = map(float, rng.random(10))
    if isinstance(material, ImageMaterial):
        return MaterialDraw(
            kind=material.kind,
            scale=_between(material.scale, scale),
            rotate=_between(material.rotate, rotate),
            offset=(u, v),
            gain=_between(material.gain, other),
            image=material.images[int(which * len(material.images))],
        )
    tint = _between(material.hue, hue) / 360 % 1.0, _between(material.saturation, saturation)
    bright = _between(material.value, value)
    first = colorsys.hsv_to_rgb(*tint, bright)
    if isinstance(material, ColourMaterial):
        return MaterialDraw(kind=material.kind, colours=(first,))
    return MaterialDraw(
        kind=material.kind,
        colours=(first, colorsys.hsv_to_rgb(*tint, bright * (1 - _between(material.contrast, contrast)))),
        scale=_between(material.scale, scale),
        rotate=_between(material.rotate, rotate),
        offset=(u, v),
        roughness=_between(material.roughness, other) if isinstance(material, BrushedMetalMaterial) else None,
        seed=pattern,
    )


def draw_backing(background: Background, seed: int, number: int) -> BackgroundDraw:
    """What is behind frame or layout ``number``."""
    rng = random_stream(seed, "background", number)
    which, crop, x, y, rotate, gain = map(float, rng.random(6))
    return BackgroundDraw(
        image=background.images[int(which * len(background.images))],
        crop=_between(background.crop, crop),
        place=(x, y),
        rotate=_between(background.rotate, rotate),
        gain=_between(background.gain, gain),
    )


def _between(bounds: tuple[float, float], share: float) -> float:
    return float(bounds[0] + share * np.subtract(*bounds[::-1]))
