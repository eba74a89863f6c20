"""Field types of scene-file models: values with their units and rules."""

from __future__ import annotations

import json
import unicodedata
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, NonNegativeFloat, ValidationError

from mitsplat.errors import InputError
from mitsplat.storage.yaml_input import model_error_sentence

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

Number = TypeVar("Number", bound=float)
Vector = TypeVar("Vector", bound=tuple[float, ...])


class _InputErrorMeta(ModelMetaclass):
    """Metaclass that reports invalid Python values of a model with the same messages as values of a file."""

    if not TYPE_CHECKING:  # editors complete the keys of models from their fields

        def __call__(cls, **values: Any) -> Any:
            try:
                return super().__call__(**values)
            except ValidationError as error:
                raise InputError(model_error_sentence(error, cls, values)) from None


class StrictModel(BaseModel, metaclass=_InputErrorMeta):
    """Immutable model without unknown keys, infinities or NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse changes, and name the way to a changed copy."""
        raise InputError(f"{type(self).__name__}: must not be changed: use model_copy(update={{{name!r}: ...}})")


def validate_again(value: Any) -> Any:
    """Return a model with validated values, because pydantic's ``model_copy`` validates none. Other values are kept."""
    if isinstance(value, list | tuple):
        return tuple(map(validate_again, value))
    if not isinstance(value, StrictModel):
        return value
    return type(value)(**{name: validate_again(getattr(value, name)) for name in sorted(value.model_fields_set)})


def check_order(bounds: tuple[float, float]) -> tuple[float, float]:
    """Refuse a range with low > high."""
    if bounds[0] > bounds[1]:
        raise ValueError(f"must be [low, high] with low <= high (got {list(bounds)})")
    return bounds


def check_label_name(name: str) -> str:
    """Refuse a name with control characters (invalid in XML) or line breaks (invalid in line-based label files)."""
    for character in name:
        if unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp") or ord(character) & 0xFFFE == 0xFFFE:
            raise ValueError(
                f"must have no control characters or line breaks (got U+{ord(character):04X} in {name[:60]!a})"
            )
    return name


Name = Annotated[str, Field(min_length=1), AfterValidator(check_label_name)]
"""Name of a class, an asset or a keypoint in label files."""


def _check_order_of_components(bounds: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
    """Refuse a range of vectors with low > high in any component."""
    if any(low > high for low, high in zip(*bounds, strict=True)):
        raise ValueError(f"must be [low, high] with low <= high in each component (got {json.dumps(bounds)})")
    return bounds


def optional_field(description: str) -> Any:
    """Return the default of a key that may be absent. Dumps of the model omit an absent key."""
    return Field(None, exclude_if=lambda value: value is None, description=description)


def _count_range(count: object) -> tuple[object, ...]:
    """Convert a number n to (n, n), and a list to a tuple, which strict mode requires."""
    if isinstance(count, int) and not isinstance(count, bool):
        if count < 1:
            raise ValueError(f"must be >= 1 (got {count})")
        return (count, count)
    if not isinstance(count, list | tuple) or len(count) != 2:
        shown = "nothing" if count is None else json.dumps(count, default=str)
        raise ValueError(f"must be a whole number or [minimum, maximum] (got {shown})")
    return tuple(count)


def _scale_range(scale: object) -> object:
    """Validate a range and convert it to a tuple; otherwise pydantic would report the union's other member."""
    if not isinstance(scale, list | tuple):
        return scale
    if len(scale) != 2 or not all(isinstance(n, int | float) and not isinstance(n, bool) and n > 0 for n in scale):
        raise ValueError(f"must be a number > 0 or [minimum, maximum] (got {json.dumps(scale, default=str)})")
    return check_order((float(scale[0]), float(scale[1])))


def _check_not_black(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(colour):
        raise ValueError("must not be black (got [0, 0, 0])")
    return colour


Ordered = Annotated[tuple[Number, Number], AfterValidator(check_order)]
"""Range ``[low, high]`` of a type of numbers, such as ``Ordered[Kelvin]``."""

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
Unit = Annotated[float, Field(ge=0, le=1)]
UnitRange = Ordered[Unit]
Range = Ordered[float]
Stops = Annotated[float, Field(ge=-20, le=20)]
StopsRange = Ordered[Stops]
BlurRange = Ordered[Annotated[float, Field(ge=0, le=1000)]]
PositiveRange = Ordered[Positive]
Vec3Range = Annotated[tuple[Vec3, Vec3], AfterValidator(_check_order_of_components)]
SizeRange = Annotated[
    tuple[tuple[Positive, Positive], tuple[Positive, Positive]], AfterValidator(_check_order_of_components)
]
NonNegativeRange = Ordered[NonNegativeFloat]
CountRange = Annotated[
    tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)]],
    AfterValidator(check_order),
    BeforeValidator(_count_range, json_schema_input_type=int | tuple[int, int]),
]
Scale = Annotated[
    Positive | tuple[Positive, Positive],
    BeforeValidator(_scale_range, json_schema_input_type=Positive | tuple[Positive, Positive]),
]
ElevationRange = Ordered[Annotated[float, Field(ge=-90, le=90)]]
Kelvin = Annotated[float, Field(ge=1667, le=25000)]
KelvinRange = Ordered[Kelvin]
JpegRange = Ordered[Annotated[float, Field(ge=1, le=100)]]
EmittedColour = Annotated[
    tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat],
    AfterValidator(_check_not_black),
    Field(description="Linear RGB factor on the emission."),
]
