"""Keys of a scene file about objects: which lie there, and how they come to rest."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from mitsplat.storage.field_types import (
    CountRange,
    Name,
    Positive,
    Scale,
    StrictModel,
    Unit,
    UnitRange,
    Vec3,
    check_weights,
    ordered,
)
from mitsplat.storage.yaml_input import FieldError

_Hue = Annotated[float, Field(ge=-180, le=180)]
HueRange = Annotated[tuple[_Hue, _Hue], AfterValidator(ordered)]
_Saturation = Annotated[float, Field(ge=0, le=2)]
SaturationRange = Annotated[tuple[_Saturation, _Saturation], AfterValidator(ordered)]
_Value = Annotated[float, Field(ge=0.1, le=4)]
ValueRange = Annotated[tuple[_Value, _Value], AfterValidator(ordered)]
_Gain = Annotated[float, Field(ge=0.5, le=2)]
GainRange = Annotated[tuple[_Gain, _Gain], AfterValidator(ordered)]
_Roughness = Annotated[float, Field(ge=0.02, le=1)]
RoughnessRange = Annotated[tuple[_Roughness, _Roughness], AfterValidator(ordered)]

_Yaw = Annotated[float, Field(ge=-360, le=360)]
YawRange = Annotated[tuple[_Yaw, _Yaw], AfterValidator(ordered)]

Arrangement = Literal["drop", "pile", "scatter", "stack", "upright", "tower", "packed"]


class ObjectPose(StrictModel):
    """Where an object starts."""

    position: Vec3 = Field(description="Origin of the asset [m].")
    rotate: Vec3 = Field((0, 0, 0), description="Euler angles about the fixed axes x, y, z, in this order [degrees].")


PRIMITIVES = "primitives"
"""The pool that needs no folder, see :mod:`mitsplat.scene.loading.primitives`."""

NUM_PRIMITIVES = 15

MAIN = "main"
"""What the region is called that the key ``region`` states."""

SIZES = 5
"""How many sizes a range of scales has, evenly spaced in ratio: each is a rigid model of its own in every format."""


class AppearanceRanges(StrictModel):
    """Ranges from which each object's appearance is drawn, once for a layout, uniformly and each for itself.

    Colours change as reflectances do: in linear light, from all directions alike. Nothing becomes brighter than white
    that was not captured so. What is absent stays as it was captured.
    """

    hue: HueRange = Field((0.0, 0.0), description="Rotation of colours about the grey axis [degrees].")
    saturation: SaturationRange = Field(
        (1.0, 1.0), description="Factor on the distance from the grey of the same luminance."
    )
    value: ValueRange = Field((1.0, 1.0), description="Factor on the reflectance.")
    gain: GainRange = Field(
        (1.0, 1.0),
        description="Factors on red, green and blue, each drawn for itself: another capture's white balance.",
    )
    roughness: RoughnessRange | None = Field(
        None, description="GGX roughness of the highlight, instead of the asset's own."
    )
    specular: UnitRange | None = Field(
        None, description="Specular reflectance at normal incidence, instead of the asset's own."
    )
    wear: UnitRange = Field(
        (0.0, 0.0),
        description="Share of its light that dirt takes where it is thickest, about a third of the surface, in patches "
        "that lie elsewhere on every object.",
    )


class ObjectSpec(StrictModel):
    """Objects of one asset, or of a pool that each layout draws from."""

    asset: str | None = Field(None, description="Asset folder, relative to the scene file; this or ``pool``.")
    pool: str | tuple[str, ...] | None = Field(
        None,
        exclude_if=lambda pool: pool is None,
        description="Asset folders that every object of the entry is drawn from, or a pattern such as ``assets/*`` "
        "that takes the objects among the folders that it matches, by name. Or ``primitives``: "
        f"{NUM_PRIMITIVES} boxes, cylinders, spheres, capsules and cones of 25 to 60 mm in random materials, which the "
        "seed decides and no folder holds.",
    )
    count: CountRange = Field((1, 1), description="How many in each layout: a number or an inclusive range.")
    weights: tuple[Positive, ...] = Field(
        (),
        exclude_if=lambda weights: not weights,
        description="How often each of the pool is drawn, relative to the others; alike if absent.",
    )
    balance: bool = Field(
        False,
        exclude_if=lambda balance: not balance,
        description="Whether classes of the pool are dealt out in turn, so that in each split none is ahead of another "
        "by more than one; weights then choose within a class.",
    )
    label: bool = Field(
        True,
        exclude_if=lambda label: label,
        description="Whether it is labelled. What is not hides, shadows and pushes what is, and is in no label file.",
    )
    size: Positive | None = Field(None, description="Longest extent [m], for an asset of unknown units only.")
    scale: Scale = Field(
        1.0,
        description="Uniform scale applied to the asset, its mass with its volume; or a range, of which each object "
        f"has one of {SIZES} sizes evenly spaced in ratio.",
    )
    class_name: Name | None = Field(None, description="Class to label it as, if not the asset's own.")
    region: str | tuple[str, ...] | None = Field(
        None,
        exclude_if=lambda region: region is None,
        description="Name of the region that it starts in, or of several that each object is drawn among by floor "
        f"area; all if absent. The one of the key ``region`` is called ``{MAIN}``.",
    )
    poses: tuple[ObjectPose, ...] = Field(
        (), description="Where each starts, instead of count; from there it settles like the others."
    )

    # Not shown, because layouts are known by what entries show, and none depends on how objects look.
    appearance: AppearanceRanges | None = Field(
        None,
        repr=False,
        exclude_if=lambda appearance: appearance is None,
        description="How much one object looks other than the next.",
    )

    @model_validator(mode="after")
    def _check(self) -> ObjectSpec:
        if (self.asset is None) == (self.pool is None):
            raise FieldError((), "must have either an asset or a pool")
        if self.pool == ():
            raise FieldError("pool", "must name at least one asset (got [])")
        for key in ("weights", "balance"):
            if self.pool is None and getattr(self, key):
                raise FieldError(key, "needs a pool")
        if isinstance(self.pool, tuple) or self.pool == PRIMITIVES:
            self.check_weights(len(self.names))
        if self.pool == PRIMITIVES and self.size is not None:
            raise FieldError("size", "must not be given for primitives, which take a scale")
        if self.poses:
            for key in ("count", "pool", "region"):
                if key in self.model_fields_set:
                    raise FieldError(key, "must not be given together with poses")
            if isinstance(self.scale, tuple):
                raise FieldError("scale", "must be one number together with poses")
        return self

    def check_weights(self, members: int) -> None:
        """Refuse weights of another number than the pool's members."""
        check_weights(self.weights, members, "assets")

    @property
    def most(self) -> int:
        """The most objects of it that a layout can have."""
        return len(self.poses) or self.count[1]

    @property
    def names(self) -> tuple[str, ...]:
        """Asset folders, or primitives, that it draws from; a loaded scene has no pattern, but what it matched."""
        if self.asset is not None:
            return (self.asset,)
        if self.pool == PRIMITIVES:
            return tuple(f"{PRIMITIVES} {number}" for number in range(NUM_PRIMITIVES))
        return self.pool if isinstance(self.pool, tuple) else ()

    @property
    def scales(self) -> tuple[float, ...]:
        """Scales that each of them comes in."""
        if isinstance(self.scale, tuple):
            return tuple(np.geomspace(*self.scale, SIZES).tolist()) if self.scale[0] < self.scale[1] else self.scale[:1]
        return (self.scale,)


class Settle(StrictModel):
    """How objects are laid out and come to rest.

    ``drop``: random poses in the region. ``pile``: the same above a bin, in a column as high as it takes, poured in at
    1 m/s. ``scatter``: apart, so that none touches another. ``stack``: all of one asset above one another on their
    largest face. ``upright``: put down as the asset stands, turned about the vertical. ``tower``: the same, all that
    start in the region on one another, the widest below. ``packed``: the same side by side, in rows from a corner of
    the region, by quarter turns that are a little off.
    """

    arrangement: Arrangement = Field(
        "drop", description="Random drop, pile, sparse scatter, stacks, upright, a tower, or packed side by side."
    )
    yaw: YawRange | None = Field(
        None,
        exclude_if=lambda yaw: yaw is None,
        description="Range of turns about the vertical [degrees] of what is put down upright, as a tower or packed, 0 "
        "as the asset stands: where fronts look. Any turn if absent, quarter turns of what is packed.",
    )
    turned_over: Unit = Field(
        0.0,
        exclude_if=lambda share: share == 0,
        description="Share of what is put down upright, as a tower or packed that stands on another side if it would "
        "stand so: on its left or right, or its head, its front in front.",
    )
    max_time: Positive = Field(6.0, description="Simulated time within which a layout must come to rest [s].")
    attempts: int = Field(
        5, ge=1, description="Draws of poses before what does not come to rest is left out of a layout."
    )
    # Not shown, because layouts do not depend on it.
    incomplete: Unit = Field(
        0.2,
        repr=False,
        description="Share of layouts that may lack objects because they did not come to rest; a dataset of which more "
        "do ends with an error.",
    )
    timestep: Positive = Field(0.002, description="Time step of the simulation [s].")
    stepper: Literal["warp", "mujoco"] = Field(
        "warp", description="Newton's MuJoCo solver on Warp, or MuJoCo in C: double precision and nothing to compile."
    )
