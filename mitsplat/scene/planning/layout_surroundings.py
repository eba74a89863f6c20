"""Surroundings of a layout: environment, materials of visible shapes, and background image.

The seed and the index of the layout determine the surroundings; the index of the frame determines per-frame values.
"""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mitsplat.scene.planning.shape_poses import draw_shift, is_present
from mitsplat.scene.spec.material_spec import Background, ColourMaterial, ImageMaterial, Material
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.spec.shape_spec import Shape
from mitsplat.scene.splits import draw_environment
from mitsplat.scene.streams import random_stream
from mitsplat.scene.walls import material_name
from mitsplat.storage.files import JsonObject

Colour = tuple[float, float, float]

_CROP, _ROTATION, _GAIN = (0.5, 1.0), (-15.0, 15.0), (0.7, 1.3)
"""Ranges of the size [of the largest crop], the rotation [degrees] and the linear gain of background images."""


@dataclass(frozen=True)
class MaterialDraw:
    """Material with values drawn for one layout.

    Attributes:
        kind: Kind of material, as in the scene file.
        colours: sRGB-encoded colours of the pattern: one or two, or none for an image.
        scale: Size of the largest features of the pattern, or width of the image [m].
        rotate: Rotation on the surface [degrees].
        offset: Shift on the surface, as a fraction of a repetition.
        image: Name of the image file.
        seed: Seed of the pattern.
    """

    kind: str
    colours: tuple[Colour, ...] = ()
    scale: float = 1.0
    rotate: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    image: str | None = None
    seed: int = 0

    def to_json(self) -> JsonObject:
        """Return the material as JSON values, without the values that its kind does not have."""
        return {name: value for name, value in vars(self).items() if value not in (None, ())}


@dataclass(frozen=True)
class BackgroundDraw:
    """Background image of one frame.

    Attributes:
        image: Name of the file.
        crop: Size of the crop, relative to the largest crop with the aspect ratio of the output at this rotation.
        place: Position of the crop in its free range, from the left and from the top, in [0, 1].
        rotate: Rotation [degrees].
        gain: Factor on the linear colours of the image.
    """

    image: str
    crop: float
    place: tuple[float, float]
    rotate: float
    gain: float

    def to_json(self) -> JsonObject:
        """Return the background as JSON values."""
        return dict(vars(self))


@dataclass(frozen=True)
class LayoutSurroundings:
    """Surroundings drawn for a frame.

    Attributes:
        environment: Index among the environments of the scene; 0 if there are none.
        materials: Drawn materials, by the names of visible shapes. All walls of a backdrop share one entry.
        shifts: Displacement along x and y [m] and rotation [degrees] of jittered shapes, by their names.
        absent: Names of the shapes that the layout does not have.
        background: Background image, if the scene has one.
    """

    environment: int = 0
    materials: Mapping[str, MaterialDraw] = field(default_factory=dict)
    shifts: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    background: BackgroundDraw | None = None
    absent: tuple[str, ...] = ()

    def material_of(self, shape: Shape) -> MaterialDraw:
        """Return the drawn material of a shape, or its fixed colour."""
        return self.materials.get(material_name(shape.name)) or MaterialDraw("colour", (shape.colour,))

    def to_json(self, spec: SceneSpec) -> JsonObject:
        """Return the values that the scene file leaves open as JSON values; empty if there are none."""
        values: JsonObject = {}
        if isinstance(spec.environment, tuple):
            values["environment"] = {"number": self.environment, "name": spec.environment[self.environment]}
        if self.materials:
            values["materials"] = {name: drawn.to_json() for name, drawn in self.materials.items()}
        if self.shifts:
            values["shifts"] = {name: list(shift) for name, shift in self.shifts.items()}
        if self.absent:
            values["absent"] = list(self.absent)
        if self.background is not None:
            values["background"] = self.background.to_json()
        return values


def draw_surroundings(spec: SceneSpec, index: int, layout: int | None = None) -> LayoutSurroundings:
    """Draw the surroundings of frame ``index``, or of the layout whose number is given."""
    layout = index // spec.output.views if layout is None else layout
    present = [shape for shape in spec.shapes if is_present(shape, spec.seed, layout)]
    names = {shape.name for shape in present}
    absent = tuple(shape.name for shape in spec.shapes if shape.name not in names)
    choices = {material_name(shape.name): shape.materials for shape in present if shape.materials}
    materials = {name: draw_material(among, spec.seed, name, layout) for name, among in choices.items()}
    shifts = {shape.name: draw_shift(shape, spec.seed, layout) for shape in present if shape.is_jittered}
    background = None if spec.background is None else draw_background(spec.background, spec.seed, index)
    return LayoutSurroundings(draw_environment(spec, layout), materials, shifts, background, absent)


def draw_material(materials: Sequence[Material], seed: int, name: str, layout: int) -> MaterialDraw:
    """Draw one of several materials and a value from each of its ranges."""
    rng = random_stream(seed, f"material {name}", layout)
    material = materials[int(rng.integers(len(materials)))]
    pattern = int(rng.integers(2**31))
    # All values are drawn always, so that no value depends on the other values of the material.
    hue, saturation, value, contrast, scale, rotate, _, u, v, choice = map(float, rng.random(10))
    if isinstance(material, ImageMaterial):
        return MaterialDraw(
            kind=material.kind,
            scale=_lerp(material.scale, scale),
            rotate=360 * rotate,
            offset=(u, v),
            image=material.images[int(choice * len(material.images))],
        )
    tint = _lerp(material.hue, hue) / 360 % 1.0, _lerp(material.saturation, saturation)
    bright = _lerp(material.value, value)
    first = colorsys.hsv_to_rgb(*tint, bright)
    if isinstance(material, ColourMaterial):
        return MaterialDraw(kind=material.kind, colours=(first,))
    return MaterialDraw(
        kind=material.kind,
        colours=(first, colorsys.hsv_to_rgb(*tint, bright * (1 - _lerp(material.contrast, contrast)))),
        scale=_lerp(material.scale, scale),
        rotate=360 * rotate,
        offset=(u, v),
        seed=pattern,
    )


def draw_background(background: Background, seed: int, index: int) -> BackgroundDraw:
    """Draw the background image of frame ``index``."""
    rng = random_stream(seed, "background", index)
    choice, crop, x, y, rotate, gain = map(float, rng.random(6))
    return BackgroundDraw(
        image=background.images[int(choice * len(background.images))],
        crop=_lerp(_CROP, crop),
        place=(x, y),
        rotate=_lerp(_ROTATION, rotate),
        gain=_lerp(_GAIN, gain),
    )


def _lerp(bounds: tuple[float, float], share: float) -> float:
    return float(bounds[0] + share * np.subtract(*bounds[::-1]))
