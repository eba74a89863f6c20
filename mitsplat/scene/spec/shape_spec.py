"""Keys of the scene file for static geometry: shapes, backdrop, conveyor, drop regions and enclosures."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, NonNegativeFloat, model_validator

from mitsplat.scene.spec.material_spec import ColourMaterial, Material, NoiseMaterial
from mitsplat.scene.spec.object_spec import Arrangements
from mitsplat.storage.field_types import Positive, StrictModel, Unit, Vec3
from mitsplat.storage.yaml_input import FieldError


class Box(StrictModel):
    """Box whose axes are those of the world before ``rotate``."""

    size: tuple[Positive, Positive, Positive] = Field(description="Full edge lengths [m].")
    position: Vec3 = Field((0, 0, 0), description="Centre [m].")
    rotate: Vec3 = Field((0, 0, 0), description="Euler angles about the fixed axes x, y, z, in this order [degrees].")


class Bin(StrictModel):
    """Open box without a lid, into which objects fall."""

    size: tuple[Positive, Positive, Positive] = Field(description="Width, depth and height of the interior [m].")
    position: Vec3 = Field((0, 0, 0), description="Centre of the inner floor [m].")
    thickness: Positive = Field(0.004, description="Thickness of floor and walls [m].")


class Shape(StrictModel):
    """Static box, bin or mesh that is visible, collides with objects, or only affects the light."""

    name: str = Field(min_length=1, description="Name, unique among the shapes.")
    box: Box | None = Field(
        None, description="Geometry: a box. A shape has exactly one of ``box``, ``bin`` and ``mesh``."
    )
    bin: Bin | None = Field(None, description="Geometry: an open bin.")
    mesh: str | None = Field(
        None, description="Geometry: a mesh file, relative to the scene file. Its vertices are in world coordinates."
    )
    units: Positive | None = Field(
        None,
        exclude_if=lambda units: units is None,
        description="Metres per unit of ``mesh``, 0.001 for millimetres. By default stated by the file (STEP, glTF, "
        "3MF, DAE), or 1.",
    )
    up: Literal["x", "y", "z"] | None = Field(
        None,
        exclude_if=lambda up: up is None,
        description="Axis of ``mesh`` that points up. It becomes +z of the world. By default stated by the file "
        "(glTF: y; 3MF: z; DAE), or z.",
    )
    visible: bool = Field(False, description="The shape is rendered.")
    collider: bool = Field(True, description="The shape collides with objects.")
    proxy: bool = Field(
        False,
        description="An invisible shape casts shadows and reflects light. Use it for a table that only the splats "
        "of the environment show.",
    )
    colour: tuple[Unit, Unit, Unit] = Field((0.6, 0.6, 0.6), description="Diffuse reflectance, sRGB-encoded.")
    materials: tuple[Material, ...] = Field(
        (),
        exclude_if=lambda materials: not materials,
        description="Materials of a visible shape, in place of ``colour``. Each layout draws one of them and a value "
        "from each of its ranges.",
    )
    share: Unit = Field(
        1.0,
        exclude_if=lambda share: share == 1,
        description="Probability that a layout has the shape. It is drawn for every layout and every shape.",
    )
    jitter: NonNegativeFloat = Field(
        0.0,
        exclude_if=lambda distance: distance == 0,
        description="Random displacement along x and y, 1 sigma [m]. It is drawn for every layout.",
    )
    rotation_jitter: NonNegativeFloat = Field(
        0.0,
        le=30,
        exclude_if=lambda angle: angle == 0,
        description="Random rotation about the vertical through the centre of the shape, 1 sigma [degrees]. It is "
        "drawn for every layout.",
    )
    friction: NonNegativeFloat = Field(
        0.6,
        description="Coulomb friction coefficient. A contact has the geometric mean of the coefficients of both sides.",
    )
    restitution: Unit = Field(
        0.0,
        exclude_if=lambda restitution: restitution == 0,
        description="Coefficient of restitution. A contact has the geometric mean of the coefficients of both sides.",
    )
    rolling_friction: NonNegativeFloat | None = Field(
        None,
        exclude_if=lambda length: length is None,
        description="Lever arm of rolling friction [m]. A contact has the larger value of its two sides, or that of "
        "the object if the shape has none.",
    )
    torsional_friction: NonNegativeFloat | None = Field(
        None,
        exclude_if=lambda radius: radius is None,
        description="Contact radius of spin friction [m]. A contact has the larger value of its two sides, or that of "
        "the object if the shape has none.",
    )

    @model_validator(mode="after")
    def _check(self) -> Shape:
        forms = [form for form in ("box", "bin", "mesh") if getattr(self, form) is not None]
        if len(forms) != 1:
            got = " and ".join(forms) or "none"
            raise FieldError("name", f"shape {self.name!r} must have either a box, a bin or a mesh (got {got})")
        for key in ("units", "up"):
            if self.mesh is None and getattr(self, key) is not None:
                raise FieldError(key, f"belongs to a mesh, which shape {self.name!r} has not")
        if not (self.visible or self.collider or self.proxy):
            raise FieldError("visible", f"shape {self.name!r} must be visible, a collider or a proxy")
        if self.materials and not self.visible:
            raise FieldError("materials", f"must not be given for shape {self.name!r}, which is not visible")
        return self

    @property
    def is_jittered(self) -> bool:
        """True if the shape stands at another place in every layout."""
        return bool(self.jitter or self.rotation_jitter)

    @property
    def is_drawn(self) -> bool:
        """True if layouts differ in the place or the presence of the shape."""
        return self.is_jittered or self.share < 1


class Conveyor(StrictModel):
    """Conveyor belt that runs while images are taken and carries all objects that settled above it."""

    belt: str = Field(description="Name of the belt shape, a box. The belt runs along the x axis of the box.")
    speed: float = Field(description="Speed of the belt surface [m/s]. Negative towards -x.")
    interval: Positive = Field(description="Time between two images of a layout [s].")

    @model_validator(mode="after")
    def _check(self) -> Conveyor:
        if not self.speed:
            raise FieldError("speed", "must not be 0 (use a shape for a belt that does not move)")
        return self


class Backdrop(StrictModel):
    """Floor and walls around the scene. They are lit like visible shapes and hide everything behind them."""

    size: tuple[Positive, Positive, Positive] = Field(description="Inner width, depth and height of the room [m].")
    position: Vec3 = Field((0, 0, 0), description="Centre of the floor [m].")
    ceiling: bool = Field(False, description="Adds a ceiling with the material of the walls.")
    floor: tuple[Material, ...] = Field(
        (NoiseMaterial(saturation=(0, 0.3), scale=(0.1, 0.5)),),
        description="Materials of the floor. Each layout draws one of them.",
    )
    walls: tuple[Material, ...] = Field(
        (ColourMaterial(saturation=(0, 0.3), value=(0.4, 0.9)),),
        description="Materials of the walls. Each layout draws one of them for all walls.",
    )

    @model_validator(mode="after")
    def _check(self) -> Backdrop:
        for key in ("floor", "walls"):
            if not getattr(self, key):
                raise FieldError(key, "must have at least one material (got [])")
        return self


class Region(StrictModel):
    """Axis-aligned box in which objects start before they fall."""

    min: Vec3 = Field(description="Lower corner [m].")
    max: Vec3 = Field(description="Upper corner [m].")

    @model_validator(mode="after")
    def _check(self) -> Region:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if not low < high:
                raise FieldError("max", f"must be above min along {axis} (got {high:g}, min is {low:g})")
        return self


class Enclosure(StrictModel):
    """Four invisible walls around the drop region and a lid on top of it, which keep objects inside.

    A layout in which an object comes to rest against a wall is drawn again.
    """

    margin: NonNegativeFloat | None = Field(
        None,
        description="Distance between the sides of the region and the walls [m]. If absent, the size of the largest "
        "object, but not beyond the bounds of the colliders.",
    )
    floor: float = Field(0.0, description="Height of the lower edge of the walls [m].")


class NamedRegion(Region):
    """Additional drop region, to which objects refer by its name."""

    name: str = Field(min_length=1, description="Name, unique among the regions.")
    enclosure: Enclosure | None = Field(
        None,
        description="Invisible walls around the region. Their ``floor`` is the height of the surface on which "
        "objects lie.",
    )
    arrangement: Arrangements | None = Field(
        None,
        description="Arrangement of objects in the region, or a list from which each layout draws one. "
        "``settle.arrangement`` if absent.",
    )
