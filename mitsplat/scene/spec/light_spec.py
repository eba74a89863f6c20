"""Keys of the scene file for light sources."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mitsplat.storage.field_types import (
    CountRange,
    ElevationRange,
    EmittedColour,
    Kelvin,
    KelvinRange,
    Positive,
    PositiveRange,
    Range,
    SizeRange,
    StrictModel,
    Vec3,
    Vec3Range,
    optional_field,
)
from mitsplat.storage.yaml_input import FieldError

Vary = Literal["layout", "frame"]
ConeAngle = Annotated[float, Field(gt=0, lt=90)]


class LightDraw(StrictModel):
    """Ranges ``[low, high]`` of random values of a light. Each end of a range has the form of the light's own key.

    Values are uniform in their range and independent of each other. This includes the components of positions and
    sizes. A drawn value replaces the light's own value of the same key.
    """

    vary: Vary = Field("layout", description="``layout`` draws values once per layout, ``frame`` for every frame.")
    count: CountRange = Field(
        (1, 1),
        description="Number of such lights, a number or an inclusive range. The values of each light are drawn "
        "independently.",
    )
    position: Vec3Range | None = Field(None, description="Opposite corners of a box that contains the position [m].")
    distance: PositiveRange | None = Field(
        None,
        description="Distance from the target of the light [m], or from the origin if it has none, in place of "
        "``position``. The direction is uniform by area on the part of the sphere that ``elevation`` and ``azimuth`` "
        "select.",
    )
    elevation: ElevationRange = Field((15.0, 85.0), description="Elevation above the horizon [degrees].")
    azimuth: Range = Field(
        (0.0, 360.0),
        description="Azimuth, 0 along +x, counter-clockwise seen from above [degrees]; for surroundings with a wall, "
        "the sides without the wall.",
    )
    size: SizeRange | None = Field(None, description="Width and height [m].")
    radiance: PositiveRange | None = Field(
        None, description="Radiance [W/(m^2 sr)], or the factor on an environment image."
    )
    temperature: KelvinRange | None = Field(None, description="Temperature of the black body [K], uniform in 1/K.")
    colour: tuple[EmittedColour, EmittedColour] | None = Field(
        None, description="Two colours. The drawn colour lies on the straight line between them."
    )
    rotate_z: Range | None = Field(None, description="Rotation about the vertical axis [degrees].")


_DRAW_ONLY_KEYS = frozenset({"vary", "count", "distance", "elevation", "azimuth"})
"""Keys of a draw that lights themselves do not have."""


class DrawnLight(StrictModel):
    """Keys that all kinds of lights have."""

    draw: LightDraw | None = optional_field("Ranges of values that are drawn at random.")

    @model_validator(mode="after")
    def _check_draw(self) -> DrawnLight:
        if self.draw is None:
            return self
        local = "position" in type(self).model_fields
        for key in sorted(self.draw.model_fields_set - {"vary"}):
            if key not in type(self).model_fields and not (local and key in _DRAW_ONLY_KEYS):
                raise FieldError(("draw", key), f"is not a key of lights of kind {getattr(self, 'kind', '')}")
        if self.draw.distance is not None and self.draw.position is not None:
            raise FieldError(("draw", "distance"), "must not be given together with position")
        for key in ("elevation", "azimuth"):
            if key in self.draw.model_fields_set and self.draw.distance is None:
                raise FieldError(("draw", key), "needs a distance")
        if getattr(self, "path", ()):
            raise FieldError("draw", "must not be given together with a path")
        return self

    @property
    def always_present(self) -> bool:
        """True if every frame has at least one such light."""
        return self.draw is None or self.draw.count[0] > 0


class LightKey(StrictModel):
    """State of a light at one time of its path. Absent values are those of the light itself."""

    position: Vec3 | None = Field(None, description="Position [m].")
    temperature: Kelvin | None = Field(
        None, description="Colour temperature [K]. Requires ``temperature`` of the light."
    )

    @model_validator(mode="after")
    def _check(self) -> LightKey:
        if self.position is None and self.temperature is None:
            raise FieldError((), "must have a position or a temperature (got neither)")
        return self


class LocalLight(DrawnLight):
    """Keys of lights with a position."""

    position: Vec3 = Field((0, 0, 0), description="Position [m]. Required unless it is drawn.")
    colour: EmittedColour = (1, 1, 1)
    temperature: Kelvin | None = Field(
        None, description="Temperature of a black body [K]. Its colour multiplies the colour of the light."
    )
    path: tuple[LightKey, ...] = Field(
        (),
        description="Key states, evenly spaced over the views of a layout. Values in between are interpolated "
        "linearly, temperatures in 1/K. Empty for a static light.",
    )

    @property
    def has_drawn_position(self) -> bool:
        """True if the position is drawn."""
        return self.draw is not None and (self.draw.position is not None or self.draw.distance is not None)

    @model_validator(mode="after")
    def _check_place(self) -> LocalLight:
        if "position" not in self.model_fields_set and not self.has_drawn_position:
            raise FieldError("position", "is required")
        return self

    @model_validator(mode="after")
    def _check_temperature(self) -> LocalLight:
        for number, key in enumerate(self.path):
            if key.temperature is not None and self.temperature is None:
                raise FieldError(("path", number, "temperature"), "needs a temperature of the light itself")
        return self


class AimedLight(LocalLight):
    """Keys of lights with a target."""

    target: Vec3 = Field((0, 0, 0), description="Point that the light faces [m].")

    @model_validator(mode="after")
    def _check(self) -> AimedLight:
        if self.has_drawn_position:
            return self
        for position in (self.position, *(key.position for key in self.path)):
            if position == self.target:
                raise FieldError("target", f"must differ from the light's positions (got {list(self.target)})")
        return self


class AreaLight(AimedLight):
    """Rectangle that emits light from the face towards its target."""

    kind: Literal["area"] = Field("area", description="Rectangular area light.")
    size: tuple[Positive, Positive] = Field((0.5, 0.5), description="Width and height [m].")
    radiance: Positive = Field(10.0, description="Emitted radiance [W/(m^2 sr)].")


class SpotLight(AimedLight):
    """Point that emits light into a cone."""

    kind: Literal["spot"] = Field("spot", description="Spot light.")
    cone: ConeAngle = Field(
        30.0, description="Half angle of the cone [degrees]. The intensity falls linearly in its outer quarter."
    )
    intensity: Positive = Field(10.0, description="Radiant intensity [W/sr].")


class PointLight(LocalLight):
    """Point that emits light in all directions."""

    kind: Literal["point"] = Field("point", description="Point light.")
    intensity: Positive = Field(10.0, description="Radiant intensity [W/sr].")


class EnvironmentLight(DrawnLight):
    """Environment light of constant radiance, or from an equirectangular image (z up)."""

    kind: Literal["environment"] = Field("environment", description="Environment light from all directions.")
    radiance: Positive = Field(1.0, description="Radiance [W/(m^2 sr)], or the factor on the image.")
    colour: EmittedColour = (1, 1, 1)
    image: str | None = Field(
        None, description="HDR or EXR file, relative to the scene file. Not together with ``colour``."
    )
    pool: str | tuple[str, ...] | None = optional_field(
        "List of HDR or EXR files, a folder, or a pattern such as ``skies/*``, whose images are sorted "
        "by name. Each layout draws one image, even if other values vary from frame to frame."
    )
    rotate_z: float = Field(0.0, description="Rotation about the vertical axis [degrees].")

    @model_validator(mode="after")
    def _check(self) -> EnvironmentLight:
        drawn = self.draw is not None and self.draw.colour is not None
        if (self.image is not None or self.pool is not None) and (drawn or self.colour != (1, 1, 1)):
            raise FieldError(
                "draw.colour" if drawn else "colour", "must not be given together with an image, which has the colours"
            )
        if self.pool is None:
            return self
        if self.image is not None:
            raise FieldError("pool", "must not be given together with an image")
        if self.pool == ():
            raise FieldError("pool", "must name at least one image (got [])")
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the image files. In a loaded scene, a pattern has been replaced by the files that it matched."""
        if self.image is not None:
            return (self.image,)
        return self.pool if isinstance(self.pool, tuple) else ()


class RoomLight(StrictModel):
    """Random light of a room: a window, lamps, and light reflected by walls.

    It expands to three entries, and the manifest states the values that were drawn for them. Distances and sizes are
    relative to the width ``size`` of the room; distances are measured from ``around``, in any direction.

    * Window: an area light 12 to 35 degrees above the horizon, at a distance of 0.35 to 0.6. Its size is 0.2 x 0.25 to
      0.45 x 0.4, its temperature 5000 to 8000 K, its radiance 3 to 10.
    * One to three lamps: area lights 50 to 85 degrees above the horizon, at the same distances. Their size is 0.05 x
      0.05 to 0.15 x 0.35, their temperature 2700 to 5000 K, their radiance 8 to 30.
    * Walls: an environment light with a radiance of 0.1 to 0.4 and a colour from white to warm white.
    """

    kind: Literal["room"] = Field("room", description="Window, lamps and light reflected by walls.")
    around: Vec3 = Field((0, 0, 0), description="Centre of the lit area [m].")
    size: Positive = Field(4.0, description="Width of the room [m].")

    def expand(self) -> tuple[AreaLight, AreaLight, EnvironmentLight]:
        """Return the three entries that the room expands to: window, lamps and walls."""
        width = self.size
        distance = 0.35 * width, 0.6 * width
        window = LightDraw(
            distance=distance,
            elevation=(12.0, 35.0),
            size=((0.2 * width, 0.25 * width), (0.45 * width, 0.4 * width)),
            radiance=(3.0, 10.0),
            temperature=(5000.0, 8000.0),
        )
        lamps = LightDraw(
            count=(1, 3),
            distance=distance,
            elevation=(50.0, 85.0),
            size=((0.05 * width, 0.05 * width), (0.15 * width, 0.35 * width)),
            radiance=(8.0, 30.0),
            temperature=(2700.0, 5000.0),
        )
        walls = LightDraw(radiance=(0.1, 0.4), colour=((1.0, 1.0, 1.0), (1.0, 0.9, 0.78)))
        target = self.around
        return AreaLight(target=target, draw=window), AreaLight(target=target, draw=lamps), EnvironmentLight(draw=walls)


LightSpec = AreaLight | SpotLight | PointLight | EnvironmentLight
"""Light of a frame."""

LightEntry = Annotated[LightSpec | RoomLight, Field(discriminator="kind")]
"""Entry of ``lights`` in the scene file."""
