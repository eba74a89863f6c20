"""Time samples of a USD stage: its time codes, moving prims, and attributes that change.

The images of a stage are one per time code from ``startTimeCode`` to ``endTimeCode``; if the stage states
``framesPerSecond``, there are as many per second instead. They end at the last sample of a pose. A stage without these
time codes has those of its samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from mitsplat.errors import InputError

if TYPE_CHECKING:
    from pxr import Usd

MAX_TIMES = 10_000


def time_codes(stage: Usd.Stage, limit: int | None = None) -> list[float]:
    """Return the time codes of the images; a stage without moving prims has one.

    Args:
        stage: The stage.
        limit: Maximum number of time codes, or None.

    Raises:
        InputError: If there are more than 10,000 time codes.
    """
    from pxr import Usd, UsdGeom  # optional

    found = set[float]()
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
            found.update(UsdGeom.Xformable(prim).GetTimeSamples())
    first, last = min(found, default=0.0), max(found, default=0.0)
    if stage.HasAuthoredTimeCodeRange():
        first, last = stage.GetStartTimeCode(), min(last, stage.GetEndTimeCode())
    step = 1.0
    if stage.HasAuthoredMetadata("framesPerSecond"):
        step = stage.GetTimeCodesPerSecond() / stage.GetFramesPerSecond()
    if not found or not last > first:
        return [first]
    if not (np.isfinite([first, last, step]).all() and step > 0):
        raise InputError(f"time codes must be finite (got {first:g} to {last:g} in steps of {step:g})")
    count = int((last - first) / step + 1e-6) + 1
    if min(count, limit or count) > MAX_TIMES:
        raise InputError(f"a stage must have at most {MAX_TIMES} time codes (got {count}): limit them with --frames")
    return [first + step * number for number in range(min(count, limit or count))]


def is_moving(prim: Usd.Prim) -> bool:
    """Return True if the pose of a prim in the world may change."""
    from pxr import UsdGeom  # optional

    while prim:
        if prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
            return True
        prim = prim.GetParent()
    return False


def sampled_attributes(prim: Usd.Prim) -> Iterator[str]:
    """Yield the names of the attributes of a prim that change and are not part of its pose."""
    from pxr import UsdGeom  # optional

    for attribute in prim.GetAuthoredAttributes():
        if attribute.ValueMightBeTimeVarying() and not UsdGeom.Xformable.IsTransformationAffectedByAttrNamed(
            attribute.GetName()
        ):
            yield attribute.GetName()
