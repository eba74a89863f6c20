"""Keys of the scene file for objects: assets, counts, and how they come to rest."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from mitsplat.storage.field_types import (
    CountRange,
    Name,
    Ordered,
    Positive,
    Scale,
    StrictModel,
    Unit,
    UnitRange,
    Vec3,
    optional_field,
)
from mitsplat.storage.yaml_input import FieldError

HueRange = Ordered[Annotated[float, Field(ge=-180, le=180)]]
SaturationRange = Ordered[Annotated[float, Field(ge=0, le=2)]]
ValueRange = Ordered[Annotated[float, Field(ge=0.1, le=4)]]
GainRange = Ordered[Annotated[float, Field(ge=0.5, le=2)]]
RoughnessRange = Ordered[Annotated[float, Field(ge=0.02, le=1)]]
YawRange = Ordered[Annotated[float, Field(ge=-360, le=360)]]
SpeedRange = Ordered[Annotated[float, Field(gt=0, le=3)]]
SpinRange = Ordered[Annotated[float, Field(ge=0, le=3600)]]
USUAL_SPEED, USUAL_SPIN = (0.2, 0.6), (0.0, 720.0)

Arrangement = Literal[
    "drop", "tossed", "tipped", "pushed", "shaken", "pile", "scatter", "stack", "upright", "tower", "packed"
]
Arrangements = Annotated[
    tuple[Arrangement, ...],
    Field(min_length=1),
    BeforeValidator(
        lambda value: (value,) if isinstance(value, str) else tuple(value) if isinstance(value, list) else value,
        json_schema_input_type=Arrangement | tuple[Arrangement, ...],
    ),
]
"""One arrangement or several; a single name is converted to a tuple."""


class ObjectPose(StrictModel):
    """Initial pose of an object."""

    position: Vec3 = Field(description="Position of the origin of the asset [m].")
    rotate: Vec3 = Field((0, 0, 0), description="Euler angles about the fixed axes x, y, z, in this order [degrees].")


PRIMITIVES = "primitives"
"""Name of the built-in pool, see :mod:`mitsplat.scene.loading.primitives`."""

NUM_PRIMITIVES = 15

MAIN_REGION = "main"
"""Name of the region that the key ``region`` defines."""

NUM_SCALES = 5
"""Number of sizes in a range of scales, evenly spaced in ratio. Every format treats each size as a separate rigid
model.
"""


class AppearanceRanges(StrictModel):
    """Ranges of the appearance of objects. Values are uniform and drawn once per layout, independently for each object.

    Colours change as reflectances do: in linear light, equally for all directions. No colour becomes brighter than
    white unless it was captured so. Absent keys leave the captured appearance unchanged.
    """

    hue: HueRange = Field((0.0, 0.0), description="Rotation of colours about the grey axis [degrees].")
    saturation: SaturationRange = Field(
        (1.0, 1.0), description="Factor on the distance of a colour from the grey of equal luminance."
    )
    value: ValueRange = Field((1.0, 1.0), description="Factor on the reflectance.")
    gain: GainRange = Field(
        (1.0, 1.0),
        description="Factors on red, green and blue, drawn independently. They model the white balance of another "
        "capture.",
    )
    roughness: RoughnessRange | None = Field(
        None, description="GGX roughness of all materials. That of the asset if absent."
    )
    specular: UnitRange | None = Field(
        None, description="Specular reflectance at normal incidence of all materials. That of the asset if absent."
    )
    wear: UnitRange = Field(
        (0.0, 0.0),
        description="Share of light that dirt absorbs where it is thickest. Dirt covers about a third of the "
        "surface, in patches that differ from object to object.",
    )


class ObjectSpec(StrictModel):
    """Objects of one asset, or of a pool from which each layout draws."""

    asset: str | None = Field(
        None, description="Asset folder, relative to the scene file. An entry has either ``asset`` or ``pool``."
    )
    pool: str | tuple[str, ...] | None = optional_field(
        "List of asset folders, or a pattern such as ``assets/*``, which selects the objects among the "
        "matching folders, sorted by name. Each object of the entry draws one asset. Or ``primitives``: "
        f"{NUM_PRIMITIVES} boxes, cylinders, spheres, capsules and cones of 25 to 60 mm with random "
        "materials. The seed determines the primitives; they need no folder."
    )
    count: CountRange = Field((1, 1), description="Number of objects per layout, a number or an inclusive range.")
    balance: bool = Field(
        False,
        exclude_if=lambda balance: not balance,
        description="Draws the classes of the pool in turn, so that within each split the counts of any two classes "
        "differ by at most one.",
    )
    label: bool = Field(
        True,
        exclude_if=lambda label: label,
        description="The objects are labelled. An object without a label still occludes, shadows and pushes other "
        "objects, but is in no label file.",
    )
    size: Positive | None = Field(None, description="Longest extent [m]. Only for an asset of unknown units.")
    scale: Scale = Field(
        1.0,
        description="Uniform scale of the asset. The mass scales with the volume. With a range, each object has one "
        f"of {NUM_SCALES} sizes, evenly spaced in ratio.",
    )
    class_name: Name | None = Field(None, description="Class name of the labels. The class of the asset if absent.")
    region: str | tuple[str, ...] | None = optional_field(
        "Name of the region in which objects start, or a list of names. Each object draws one of them by "
        f"floor area. All regions if absent. The region of the key ``region`` has the name ``{MAIN_REGION}``."
    )
    poses: tuple[ObjectPose, ...] = Field(
        (), description="Initial pose of each object, in place of ``count``. From there, objects settle as usual."
    )

    # ``appearance`` is not in the repr, because layouts are identified by the repr of entries and do not depend on it.
    appearance: AppearanceRanges | None = Field(
        None,
        repr=False,
        exclude_if=lambda appearance: appearance is None,
        description="Ranges of the differences in appearance between objects.",
    )

    @model_validator(mode="after")
    def _check(self) -> ObjectSpec:
        if (self.asset is None) == (self.pool is None):
            raise FieldError(
                (), f"must have either an asset or a pool (got {'neither' if self.pool is None else 'both'})"
            )
        if self.pool == ():
            raise FieldError("pool", "must name at least one asset (got [])")
        if self.balance and self.pool is None:
            raise FieldError("balance", "needs a pool")
        if self.pool == PRIMITIVES and self.size is not None:
            raise FieldError("size", "must not be given for primitives (use scale)")
        if self.poses:
            for key in ("count", "pool", "region"):
                if key in self.model_fields_set:
                    raise FieldError(key, "must not be given together with poses")
            if isinstance(self.scale, tuple):
                raise FieldError("scale", "must be one number together with poses")
        return self

    @property
    def max_count(self) -> int:
        """Maximum number of objects of the entry in a layout."""
        return len(self.poses) or self.count[1]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the asset folders or primitives.

        In a loaded scene, a pattern has been replaced by the folders that it matched.
        """
        if self.asset is not None:
            return (self.asset,)
        if self.pool == PRIMITIVES:
            return tuple(f"{PRIMITIVES} {number}" for number in range(NUM_PRIMITIVES))
        return self.pool if isinstance(self.pool, tuple) else ()

    @property
    def scales(self) -> tuple[float, ...]:
        """Scales of the objects of the entry."""
        if isinstance(self.scale, tuple):
            low, high = self.scale
            return tuple(np.geomspace(low, high, NUM_SCALES).tolist()) if low < high else (low,)
        return (self.scale,)


class Settle(StrictModel):
    """Initial arrangement of objects and simulation until rest.

    * ``drop``: random poses in the region.
    * ``tossed``: random poses in the region. Each object starts at ``speed``, horizontally in the direction of a random
      point of the region, and at ``spin`` about a random axis.
    * ``tipped``: random poses close together, as the contents of a container, which leave it at the same ``speed``, 45
      degrees downwards in the direction of a random point of the region. The container is not simulated.
    * ``pushed``: a drop. One second later, a vertical plane without friction sweeps objects together at ``speed``, in
      a random direction, from the edge of the region to between 20 and 70 % of its length.
    * ``shaken``: a drop. One second later, the ground moves to and fro three times in 0.96 s, along a random horizontal
      direction. ``speed`` is its maximum speed.
    * ``pile``: random poses above a bin, in a column as high as necessary, poured in at 1 m/s.
    * ``scatter``: random poses apart from each other, so that no objects touch.
    * ``stack``: the objects of one asset on top of each other, on their largest face.
    * ``upright``: upright as the asset is modelled, rotated about the vertical axis.
    * ``tower``: upright, and all objects that start in the region on top of each other, the widest at the bottom.
    * ``packed``: upright side by side, in rows from a corner of the region, in slightly inexact quarter turns.
    """

    arrangement: Arrangements = Field(
        ("drop",),
        description="Initial arrangement of the objects: one name, or a list. Each layout has one arrangement of the "
        "list, all equally often; a name that occurs twice is used twice as often.",
    )
    speed: SpeedRange = Field(
        USUAL_SPEED,
        exclude_if=lambda speed: speed == USUAL_SPEED,
        description="Range of speeds for the arrangements ``tossed``, ``tipped``, ``pushed`` and ``shaken`` [m/s].",
    )
    spin: SpinRange = Field(
        USUAL_SPIN,
        exclude_if=lambda spin: spin == USUAL_SPIN,
        description="Range of angular speeds for the arrangement ``tossed`` [degrees/s].",
    )
    yaw: YawRange | None = optional_field(
        "Range of rotations about the vertical axis [degrees] for the arrangements ``upright``, "
        "``tower`` and ``packed``. 0 is the orientation of the asset, so the range controls the "
        "direction of the fronts. If absent, any rotation, or quarter turns for ``packed``."
    )
    turned_over: Unit = Field(
        0.0,
        exclude_if=lambda share: share == 0,
        description="For the arrangements ``upright``, ``tower`` and ``packed``: share of objects that stand on "
        "another side, if they are stable on it. The side is left, right or top; the front stays in "
        "front.",
    )
    max_time: Positive = Field(
        6.0,
        description="Simulated time within which a layout must come to rest [s]. It starts again if objects are "
        "dropped again.",
    )
    attempts: int = Field(
        5,
        ge=1,
        description="Number of draws of poses. Objects that do not come to rest in any of them are left out of the "
        "layout.",
    )
    # ``incomplete`` is not in the repr, because layouts do not depend on it.
    incomplete: Unit = Field(
        0.2,
        repr=False,
        description="Maximum share of layouts that lack objects because these did not come to rest. A dataset with a "
        "larger share ends with an error.",
    )
    stepper: Literal["mujoco", "warp"] = Field(
        "mujoco",
        description="Physics engine: ``mujoco`` for MuJoCo in C, ``warp`` for the MuJoCo solver of Newton on Warp. The "
        "layouts differ, but pass the same rest certificate. The machine never changes the engine. MuJoCo is the "
        "default because it takes a half to a sixth of Warp's time and compiles nothing.",
    )
