"""Keys of a scene file about light sources."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mitsplat.scene.spec_types import EmittedColour, Kelvin, Positive, StrictModel, Vec3
from mitsplat.yaml_input import FieldError


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


class LocalLight(StrictModel):
    """What every light at a place has."""

    position: Vec3 = Field(description="Position [m].")
    colour: EmittedColour = (1, 1, 1)
    temperature: Kelvin | None = Field(
        None, description="Temperature of the black body whose colour multiplies that of the light [K]."
    )
    path: tuple[LightKey, ...] = Field(
        (),
        description="Keys evenly spaced over a layout's views, linear in between (temperatures in 1/K); "
        "empty for a light at rest.",
    )

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
    cone: float = Field(30.0, gt=0, lt=90, description="Half angle of the cone [degrees].")
    intensity: Positive = Field(10.0, description="Radiant intensity [W/sr].")


class PointLight(LocalLight):
    """A point that emits in all directions."""

    kind: Literal["point"] = Field("point", description="A point.")
    intensity: Positive = Field(10.0, description="Radiant intensity [W/sr].")


class EnvironmentLight(StrictModel):
    """A constant sky, or an equirectangular image of it (z up)."""

    kind: Literal["environment"] = Field("environment", description="A sky all around.")
    radiance: Positive = Field(1.0, description="Radiance [W/(m^2 sr)], or the factor on the image.")
    colour: EmittedColour = (1, 1, 1)
    image: str | None = Field(None, description="HDR or EXR file, relative to the scene file.")
    rotate_z: float = Field(0.0, description="Rotation about the vertical [degrees].")


LightSpec = Annotated[AreaLight | SpotLight | PointLight | EnvironmentLight, Field(discriminator="kind")]
