"""Keys of a scene file about light sources."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

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
    check_weights,
    ordered,
)
from mitsplat.storage.yaml_input import FieldError

Vary = Literal["layout", "frame"]
ConeAngle = Annotated[float, Field(gt=0, lt=90)]


class LightDraw(StrictModel):
    """What of a light is drawn, from ranges ``[low, high]`` of which each end is written as the light's own key is.

    Values are uniform in their range and independent of each other, components of positions, targets and sizes too. A
    light's own value of a key that is drawn counts for nothing.
    """

    vary: Vary = Field("layout", description="Whether values are drawn once for a layout, or anew for every frame.")
    count: CountRange = Field(
        (1, 1), description="How many such lights there are, each drawn for itself: a number or an inclusive range."
    )
    position: Vec3Range | None = Field(None, description="Opposite corners of a box [m].")
    distance: PositiveRange | None = Field(
        None,
        description="Distance from ``around`` [m], at an azimuth and elevation that are uniform by area on the sphere; "
        "instead of a position.",
    )
    azimuth: Range = Field((0.0, 360.0), description="0 along +x, counter-clockwise from above [degrees].")
    elevation: ElevationRange = Field((15.0, 85.0), description="Above the horizon [degrees].")
    around: Vec3 | None = Field(
        None, description="Where distances are from [m]; the light's target if absent, or else the origin."
    )
    target: Vec3Range | None = Field(None, description="Opposite corners of a box that it faces a point of [m].")
    size: SizeRange | None = Field(None, description="Width and height [m].")
    cone: Annotated[tuple[ConeAngle, ConeAngle], AfterValidator(ordered)] | None = Field(
        None, description="Half angle of the cone [degrees]."
    )
    radiance: PositiveRange | None = Field(None, description="Radiance [W/(m^2 sr)], or the factor on an image.")
    intensity: PositiveRange | None = Field(None, description="Radiant intensity [W/sr].")
    temperature: KelvinRange | None = Field(None, description="Temperature of the black body [K], uniform in 1/K.")
    colour: tuple[EmittedColour, EmittedColour] | None = Field(
        None, description="Colours between these two, on the straight line from one to the other."
    )
    rotate_z: Range | None = Field(None, description="Rotation about the vertical [degrees].")


_OF_DRAWS = frozenset({"vary", "count", "distance", "azimuth", "elevation", "around"})
"""Keys of a draw that are none of a light's."""


class DrawnLight(StrictModel):
    """What lights of all kinds have."""

    draw: LightDraw | None = Field(
        None, exclude_if=lambda draw: draw is None, description="Values that are drawn instead of stated."
    )

    @model_validator(mode="after")
    def _check_draw(self) -> DrawnLight:
        if self.draw is None:
            return self
        local = "position" in type(self).model_fields
        for key in sorted(self.draw.model_fields_set - {"vary"}):
            if key not in type(self).model_fields and not (local and key in _OF_DRAWS):
                raise FieldError(("draw", key), f"is nothing that a light of kind {getattr(self, 'kind', '')} has")
        if self.draw.distance is not None and self.draw.position is not None:
            raise FieldError(("draw", "distance"), "must not be given together with position")
        for key in ("azimuth", "elevation", "around"):
            if key in self.draw.model_fields_set and self.draw.distance is None:
                raise FieldError(("draw", key), "needs a distance")
        if getattr(self, "path", ()):
            raise FieldError("draw", "must not be given together with a path")
        return self

    @property
    def sure(self) -> bool:
        """Whether there is one in every frame."""
        return self.draw is None or self.draw.count[0] > 0


class LightKey(StrictModel):
    """State of a light at one time of its path; what is absent stays as the light itself has it."""

    position: Vec3 | None = Field(None, description="Position [m].")
    intensity: Positive | None = Field(None, description="Intensity [W/sr], or an area light's radiance [W/(m^2 sr)].")
    temperature: Kelvin | None = Field(None, description="Colour temperature [K]; needs that of the light.")

    @model_validator(mode="after")
    def _check(self) -> LightKey:
        if self.position is None and self.intensity is None and self.temperature is None:
            raise FieldError((), "must have a position, an intensity or a temperature")
        return self


class LocalLight(DrawnLight):
    """What every light at a place has."""

    position: Vec3 = Field((0, 0, 0), description="Position [m]; required where it is not drawn.")
    colour: EmittedColour = (1, 1, 1)
    temperature: Kelvin | None = Field(
        None, description="Temperature of the black body whose colour multiplies that of the light [K]."
    )
    path: tuple[LightKey, ...] = Field(
        (),
        description="Keys evenly spaced over a layout's views, linear in between (temperatures in 1/K); "
        "empty for a light at rest.",
    )

    @property
    def moved(self) -> bool:
        """Whether its position is drawn."""
        return self.draw is not None and (self.draw.position is not None or self.draw.distance is not None)

    @model_validator(mode="after")
    def _check_place(self) -> LocalLight:
        if "position" not in self.model_fields_set and not self.moved:
            raise FieldError("position", "is required")
        return self

    @model_validator(mode="after")
    def _check_temperature(self) -> LocalLight:
        for number, key in enumerate(self.path):
            if key.temperature is not None and self.temperature is None:
                raise FieldError(("path", number, "temperature"), "needs a temperature of the light itself")
        return self


class AimedLight(LocalLight):
    """What every light that faces something has."""

    target: Vec3 = Field((0, 0, 0), description="Point that it faces [m].")

    @model_validator(mode="after")
    def _check(self) -> AimedLight:
        if self.moved or (self.draw is not None and self.draw.target is not None):
            return self
        for position in (self.position, *(key.position for key in self.path)):
            if position == self.target:
                raise FieldError("target", f"must differ from the light's positions (got {list(self.target)})")
        return self


class AreaLight(AimedLight):
    """A rectangle that emits from the face turned to its target."""

    kind: Literal["area"] = Field("area", description="A rectangle.")
    size: tuple[Positive, Positive] = Field((0.5, 0.5), description="Width and height [m].")
    radiance: Positive = Field(10.0, description="Emitted radiance [W/(m^2 sr)].")


class SpotLight(AimedLight):
    """A point that emits into a cone."""

    kind: Literal["spot"] = Field("spot", description="A cone.")
    cone: ConeAngle = Field(30.0, description="Half angle of the cone [degrees].")
    intensity: Positive = Field(10.0, description="Radiant intensity [W/sr].")


class PointLight(LocalLight):
    """A point that emits in all directions."""

    kind: Literal["point"] = Field("point", description="A point.")
    intensity: Positive = Field(10.0, description="Radiant intensity [W/sr].")


class EnvironmentLight(DrawnLight):
    """A constant sky, or an equirectangular image of it (z up)."""

    kind: Literal["environment"] = Field("environment", description="A sky all around.")
    radiance: Positive = Field(1.0, description="Radiance [W/(m^2 sr)], or the factor on the image.")
    colour: EmittedColour = (1, 1, 1)
    image: str | None = Field(None, description="HDR or EXR file, relative to the scene file.")
    pool: str | tuple[str, ...] | None = Field(
        None,
        exclude_if=lambda pool: pool is None,
        description="Such files of which each layout has one, also where all else is drawn anew for every frame; or a "
        "folder, or a pattern such as ``skies/*``, of which the images are taken, by name.",
    )
    weights: tuple[Positive, ...] = Field(
        (),
        exclude_if=lambda weights: not weights,
        description="How often each of the pool is drawn, relative to the others; alike if absent.",
    )
    rotate_z: float = Field(0.0, description="Rotation about the vertical [degrees].")

    @model_validator(mode="after")
    def _check(self) -> EnvironmentLight:
        if self.pool is None:
            if self.weights:
                raise FieldError("weights", "needs a pool")
            return self
        if self.image is not None:
            raise FieldError("pool", "must not be given together with an image")
        if self.pool == ():
            raise FieldError("pool", "must name at least one image (got [])")
        if isinstance(self.pool, tuple):
            self.check_weights(len(self.pool))
        return self

    def check_weights(self, members: int) -> None:
        """Refuse weights of another number than the pool's members."""
        check_weights(self.weights, members, "images")

    @property
    def names(self) -> tuple[str, ...]:
        """Images that it shows; a loaded scene has no pattern, but what it matched."""
        if self.image is not None:
            return (self.image,)
        return self.pool if isinstance(self.pool, tuple) else ()


class RoomLight(StrictModel):
    """A window and lamps: the light of a room, as one layout after the other might be lit.

    It stands for three other entries, by which the manifest states what was drawn, of a room that is ``size`` wide. A
    window: an area light 12 to 35 degrees above the horizon, at 0.35 to 0.6 of the size from ``around`` in any
    direction, of 0.2 by 0.25 to 0.45 by 0.4 of the size, of 5000 to 8000 K and a radiance of 3 to 10. Lamps: area
    lights 50 to 85 degrees above the horizon at the same distances, of 0.05 by 0.05 to 0.15 by 0.35 of the size, of
    2700 to 5000 K and 8 to 30. And what walls reflect: an environment light of 0.1 to 0.4, white to warm.
    """

    kind: Literal["room"] = Field("room", description="A window and lamps.")
    around: Vec3 = Field((0, 0, 0), description="What they light [m].")
    size: Positive = Field(4.0, description="Width of the room [m].")
    lamps: CountRange = Field((1, 3), description="How many lamps: a number or an inclusive range.")
    vary: Vary = Field("layout", description="Whether all of it is drawn once for a layout, or anew for every frame.")

    def written_out(self) -> tuple[AreaLight, AreaLight, EnvironmentLight]:
        """The entries that it stands for."""

        def place(elevation: tuple[float, float]) -> dict[str, Any]:
            return {"vary": self.vary, "distance": (0.35 * self.size, 0.6 * self.size), "elevation": elevation}

        def sizes(*shares: tuple[float, float]) -> Any:
            return tuple((width * self.size, height * self.size) for width, height in shares)

        window = LightDraw(
            **place((12.0, 35.0)),
            size=sizes((0.2, 0.25), (0.45, 0.4)),
            radiance=(3.0, 10.0),
            temperature=(5000.0, 8000.0),
        )
        lamp = LightDraw(
            **place((50.0, 85.0)),
            count=self.lamps,
            size=sizes((0.05, 0.05), (0.15, 0.35)),
            radiance=(8.0, 30.0),
            temperature=(2700.0, 5000.0),
        )
        walls = LightDraw(vary=self.vary, radiance=(0.1, 0.4), colour=((1.0, 1.0, 1.0), (1.0, 0.9, 0.78)))
        area = [AreaLight(target=self.around, draw=draw) for draw in (window, lamp)]
        return area[0], area[1], EnvironmentLight(draw=walls)


LightSpec = AreaLight | SpotLight | PointLight | EnvironmentLight
"""A light as frames have it."""

LightEntry = Annotated[LightSpec | RoomLight, Field(discriminator="kind")]
"""An entry of the scene file."""
