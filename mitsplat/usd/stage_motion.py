"""Time samples of a USD stage: its time codes, moving and hidden prims, and attributes that change.

The images of a stage are one per time code from ``startTimeCode`` to ``endTimeCode``; if the stage states
``framesPerSecond``, there are as many per second instead. They end at the last sample of a pose or visibility. A stage
without these time codes has those of its samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mitsplat.errors import InputError

if TYPE_CHECKING:
    from pxr import Usd

MAX_TIMES = 10_000


def time_codes(stage: Usd.Stage, limit: int | None) -> list[float]:
    """Return the time codes of the images; a stage without moving prims and changing visibility has one.

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
        if _is_blinking(prim):
            found.update(UsdGeom.Imageable(prim).GetVisibilityAttr().GetTimeSamples())
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

    xforms = (UsdGeom.Xformable(one) for one in lineage(prim) if one.IsA(UsdGeom.Xformable))
    return any(xform.TransformMightBeTimeVarying() for xform in xforms)


def lineage(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield a prim and its ancestors, the nearest first."""
    while prim:
        yield prim
        prim = prim.GetParent()


def visibility(prim: Usd.Prim, times: Sequence[float]) -> list[bool]:
    """Return the visibility of a prim at time codes: one value if it does not change."""
    from pxr import UsdGeom  # optional

    def is_visible(time: float) -> bool:
        return bool(UsdGeom.Imageable(prim).ComputeVisibility(time) != UsdGeom.Tokens.invisible)

    return [is_visible(time) for time in (times if any(map(_is_blinking, lineage(prim))) else times[:1])]


def _is_blinking(prim: Usd.Prim) -> bool:
    """Return True if a prim has time samples of its own visibility."""
    from pxr import UsdGeom  # optional

    return bool(UsdGeom.Imageable(prim) and UsdGeom.Imageable(prim).GetVisibilityAttr().ValueMightBeTimeVarying())


def sampled_attributes(prim: Usd.Prim) -> Iterator[str]:
    """Yield the names of the attributes of a prim that change, except for its pose and visibility."""
    from pxr import UsdGeom  # optional

    for attribute in prim.GetAuthoredAttributes():
        name = attribute.GetName()
        is_read = name == UsdGeom.Tokens.visibility or UsdGeom.Xformable.IsTransformationAffectedByAttrNamed(name)
        if attribute.ValueMightBeTimeVarying() and not is_read:
            yield name
