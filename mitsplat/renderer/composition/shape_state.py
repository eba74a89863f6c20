"""Shapes of a scene with their parameters at one time, to notice that a script has changed them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True, eq=False)
class ShapeState:
    """Shapes, and their parameters; those of splats are their poses.

    Attributes:
        shapes: The shapes.
        arrays: Copies of all arrays. They keep the variables of Dr.Jit alive, whose indices are compared.
        values: Poses of splats, and the key of each other parameter with its values; a variable of Dr.Jit is
            represented by its index.
    """

    shapes: tuple[mi.Shape, ...]
    arrays: tuple[dr.ArrayBase, ...]
    values: tuple[object, ...]

    @classmethod
    def of(cls, shapes: Sequence[mi.Shape]) -> ShapeState:
        """Read the present parameters of the shapes, without evaluation."""
        arrays: list[dr.ArrayBase] = []
        values: list[object] = []
        for shape in shapes:
            if hasattr(shape, "world_from_splats"):
                values.append(shape.world_from_splats.tobytes())
                continue
            for key, value in mi.traverse(shape):
                values.append(key)
                for leaf in _leaves(value):
                    if dr.is_jit_v(leaf):
                        arrays.append(type(leaf)(leaf))
                        values.append(leaf.index)
                    else:
                        values.append(leaf)
        return cls(tuple(shapes), tuple(arrays), tuple(values))

    def holds_for(self, shapes: Sequence[mi.Shape]) -> bool:
        """Return True if these are the same objects in the same order, with the same parameters."""
        same = len(self.shapes) == len(shapes) and all(a is b for a, b in zip(self.shapes, shapes, strict=True))
        return same and self.values == ShapeState.of(shapes).values


def _leaves(value: Any) -> Iterator[Any]:
    """Yield the arrays of depth 1 and the single values of a parameter."""
    value = getattr(value, "matrix", value)  # of a transform
    if dr.is_tensor_v(value):
        value = value.array
    if not dr.is_array_v(value) or (dr.is_jit_v(value) and dr.depth_v(value) == 1):
        yield value
    else:
        for component in value:
            yield from _leaves(component)
