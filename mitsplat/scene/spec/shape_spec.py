"""Keys of a scene file about what does not move: shapes, the drop region, the walls around it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, NonNegativeFloat, model_validator

from mitsplat.scene.spec.material_spec import ColourMaterial, Material, NoiseMaterial
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.storage.field_types import Positive, StrictModel, Unit, Vec3
from mitsplat.storage.yaml_input import FieldError


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
    materials: tuple[Material, ...] = Field(
        (),
        exclude_if=lambda materials: not materials,
        description="What it is made of instead of ``colour``, if it is visible: one of these, which each layout draws "
        "anew with all that is a range of it.",
    )
    friction: NonNegativeFloat = Field(
        0.6, description="Coulomb friction coefficient; what touches has the geometric mean of both sides'."
    )

    @model_validator(mode="after")
    def _check(self) -> Shape:
        if sum(form is not None for form in (self.box, self.bin, self.mesh)) != 1:
            raise FieldError("name", f"shape {self.name!r} must have either a box, a bin or a mesh")
        if not (self.visible or self.collider or self.proxy):
            raise FieldError("visible", f"shape {self.name!r} must be visible, a collider or a proxy")
        if self.materials and not self.visible:
            raise FieldError("materials", f"must not be given for shape {self.name!r}, which is not visible")
        return self


class Conveyor(StrictModel):
    """A belt that runs while images are taken, with all that settled above it."""

    belt: str = Field(description="Name of the shape, a box that runs along its own x axis.")
    speed: float = Field(description="Speed of its surface [m/s]; negative towards -x.")
    interval: Positive = Field(description="Time from one turn of the cameras to the next [s].")

    @model_validator(mode="after")
    def _check(self) -> Conveyor:
        if not self.speed:
            raise FieldError("speed", "must not be 0 (a belt that stands still is a shape)")
        return self


class Backdrop(StrictModel):
    """Floor and walls around everything, which lights fall on as on visible shapes. What is behind them is hidden."""

    size: tuple[Positive, Positive, Positive] = Field(description="Width, depth and height of the room inside [m].")
    position: Vec3 = Field((0, 0, 0), description="Middle of its floor [m].")
    rotate_z: float = Field(0.0, description="Rotation about the vertical [degrees].")
    sides: tuple[Literal["-x", "+x", "-y", "+y"], ...] = Field(
        ("-x", "+x", "-y", "+y"), description="Sides that have a wall, before the rotation."
    )
    ceiling: bool = Field(False, description="Whether it has a ceiling, of the walls' material.")
    collider: bool = Field(False, description="Whether objects rest on its floor.")
    floor: tuple[Material, ...] = Field(
        (NoiseMaterial(saturation=(0, 0.3), scale=(0.1, 0.5)),),
        description="Materials, one of which each layout draws for the floor.",
    )
    walls: tuple[Material, ...] = Field(
        (ColourMaterial(saturation=(0, 0.3), value=(0.4, 0.9)),),
        description="Materials, one of which each layout draws for all walls.",
    )

    @model_validator(mode="after")
    def _check(self) -> Backdrop:
        for key in ("floor", "walls"):
            if not getattr(self, key):
                raise FieldError(key, "must have at least one material (got [])")
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


class NamedRegion(Region):
    """A further region, with a name by which objects are sent there."""

    name: str = Field(min_length=1, description="Name, unique among the regions.")
    enclosure: Enclosure | None = Field(
        None, description="Invisible walls around it; their ``floor`` is the height of what its objects lie on."
    )
    arrangement: Arrangement | None = Field(
        None, description="How objects are laid out in it, if not as ``settle.arrangement`` says."
    )
