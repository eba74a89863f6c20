"""Checks of a resting state on the original meshes: penetration, support, and the requested arrangement."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from mitsplat.geometry.decomposition import max_gap
from mitsplat.geometry.mesh_distance import Clearance, PlacedSurface, all_clearances
from mitsplat.physics.placement import PUT_DOWN
from mitsplat.physics.rest import LEANING, WALL_DISTANCE
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.scene.walls import ENCLOSURE

MAX_MEASURED_GAP = 5e-3
"""Larger gaps are not measured [m]."""

# Maximum penetration at rest [m], or as a share of the object's size if that is larger: convex pieces of scans deviate
# by that much.
_MAX_DEPTH_IN_COLLIDER, _MAX_DEPTH_IN_OBJECT, _MAX_DEPTH_SHARE = 3e-4, 5e-4, 0.003
_MIN_SCATTER_DISTANCE = 5e-4  # minimum distance of scattered objects at rest [m]
_FALLEN_TILT = 5.0  # tilt from which an upright object has fallen over [degrees]


@dataclass(frozen=True, eq=False)
class RestingObject:
    """Object at rest.

    Attributes:
        surface: Its mesh at its pose.
        arrangement: Arrangement of its start region.
        tilt: Angle between the vertical and the start vertical after the object's rotation [degrees]; None if the scene
            file states its pose.
    """

    surface: PlacedSurface
    arrangement: Arrangement
    tilt: float | None


@dataclass(frozen=True)
class Defect:
    """Defect of a resting state: its description, and the positions of the affected objects."""

    reason: str
    causes: tuple[int, ...]


class RestingState:
    """Objects at rest among static obstacles.

    Attributes:
        support_gaps: Distance of each object from its nearest neighbour [m].
        collider_penetration: Deepest penetration of an obstacle [m].
        pair_penetration: Deepest penetration of two objects [m].
    """

    def __init__(self, objects: Sequence[RestingObject], obstacles: Sequence[PlacedSurface]) -> None:
        self._objects, self._obstacles = objects, obstacles
        surfaces = [one.surface for one in objects]
        self._clearances = all_clearances(surfaces, obstacles, reach=MAX_MEASURED_GAP)
        self.support_gaps = [
            max(0.0, min(pair.distance for pair in self._clearances if item in (pair.first, pair.second)))
            for item in surfaces
        ]
        self.collider_penetration = _deepest(pair for pair in self._clearances if pair.second in obstacles)
        self.pair_penetration = _deepest(pair for pair in self._clearances if pair.second not in obstacles)

    def find_defect(self) -> Defect | None:
        """Return the first defect: a penetration, an unsupported object, or a violated arrangement."""
        return self._find_penetration() or self._find_gap() or self._find_violation()

    def _find_penetration(self) -> Defect | None:
        for pair in sorted(self._clearances, key=lambda pair: pair.distance):
            if -pair.distance > max_depth(pair, in_collider=pair.second in self._obstacles):
                reason = f"{pair.first.name} and {pair.second.name} overlap by {-pair.distance * 1e3:.1f} mm"
                return self._defect(reason, pair.first, pair.second)
        return None

    def _find_gap(self) -> Defect | None:
        for one, gap in zip(self._objects, self.support_gaps, strict=True):
            if gap > max_gap(one.surface.size):
                return self._defect(
                    f"{one.surface.name} rests {gap * 1e3:.1f} mm or more from what is nearest", one.surface
                )
        return None

    def _find_violation(self) -> Defect | None:
        """Return the first violation: an object leans on an enclosure, touches a scattered one, or fell over."""
        for pair in self._clearances:
            if pair.second.name.startswith(ENCLOSURE) and pair.distance < WALL_DISTANCE:
                return self._defect(f"{pair.first.name} {LEANING}", pair.first)
        scattered = {one.surface for one in self._objects if one.arrangement == "scatter"}
        for pair in self._clearances:
            if pair.first in scattered and pair.second not in self._obstacles and pair.distance < _MIN_SCATTER_DISTANCE:
                return self._defect(f"{pair.first.name} and {pair.second.name} touch", pair.first, pair.second)
        fallen = [
            one.surface
            for one in self._objects
            if one.arrangement in PUT_DOWN and one.tilt is not None and one.tilt > _FALLEN_TILT
        ]
        return self._defect(f"{fallen[0].name} fell over", *fallen) if fallen else None

    def _defect(self, reason: str, *affected: PlacedSurface) -> Defect:
        return Defect(reason, tuple(i for i, one in enumerate(self._objects) if one.surface in affected))


def max_depth(pair: Clearance, *, in_collider: bool) -> float:
    """Return the maximum penetration of a pair at rest [m].

    Args:
        pair: Two surfaces.
        in_collider: True if the second one is a collider.
    """
    if in_collider:
        return max(_MAX_DEPTH_IN_COLLIDER, _MAX_DEPTH_SHARE * pair.first.size)
    return max(_MAX_DEPTH_IN_OBJECT, _MAX_DEPTH_SHARE * max(pair.first.size, pair.second.size))


def _deepest(pairs: Iterable[Clearance]) -> float:
    return max([0.0, *(-pair.distance for pair in pairs)])
