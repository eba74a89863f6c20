"""Draw poses above a scene, drop the objects from them, and judge how they came to rest."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.assets import Asset
from mitsplat.clearance import Clearance, PlacedSurface, Surface, all_clearances, clearance
from mitsplat.errors import InputError
from mitsplat.mesh import convex_pieces, mass_properties, prepare_mesh
from mitsplat.physics import OVERFLOW, Body, Collider, MujocoWorld, WarpWorld, World, run_to_rest
from mitsplat.scene import Scene
from mitsplat.settle import FloatArray, Instance, Layout, Progress, RestCertificate
from mitsplat.spec import Region

_PLACES = 200  # positions tried for an object before all are drawn anew
_DRAWS = 20
_SPACING = 1e-3  # between the bounding boxes of objects at the start [m]
_REACH = 5e-3  # gaps beyond this are not measured [m]
# What may be wrong with a layout at rest [m], or as a share of an object's size where that is more.
_DEEPEST_IN_COLLIDER, _DEEPEST_IN_OBJECT, _WIDEST_GAP, _SHARE = 3e-4, 5e-4, 1e-3, 0.005


@dataclass(frozen=True)
class _Request:
    """A scene, and whom to tell what making its :class:`Drop` takes, which is no part of what is asked for."""

    scene: Scene
    progress: Progress = field(compare=False)


def drop_of(scene: Scene, progress: Progress) -> Drop:
    """The :class:`Drop` of a scene, the same as the last time if the scene is."""
    return _make_drop(_Request(scene, progress))


@lru_cache(maxsize=1)
def _make_drop(request: _Request) -> Drop:
    return Drop(request.scene, request.progress)


class Drop:
    """Drops the objects of a scene; keeps what its layouts share, of which the simulation itself costs most to make.

    Args:
        scene: What to drop, from where, and on what.
        progress: Told in a few words what takes long.
    """

    def __init__(self, scene: Scene, progress: Progress) -> None:
        self.scene = scene
        self._parts: dict[int, tuple[Body, Surface]] = {}
        self._worlds: dict[tuple[tuple[int, ...], float], World] = {}
        self._objects = [self._part(asset, progress) for asset in scene.assets]
        self._colliders: list[Collider] = []
        self._obstacles: list[PlacedSurface] = []
        walls = self._add_colliders(progress)
        self._bounds = _enclosure(scene.spec.region, [item.bounds for item in self._obstacles], walls)

    def settle(self, index: int) -> Layout:
        """Draw poses until a layout holds.

        Raises:
            InputError: If objects find no room, or no draw holds.
        """
        spec, refused, capacity = self.scene.spec, [], 1.0
        counts = _random(spec.seed, "object counts", index)
        assets = tuple(
            position
            for position, entry in enumerate(spec.objects)
            for _ in range(int(counts.integers(*_range(entry.count), endpoint=True)))
        )
        if not assets:
            return Layout(index, (), RestCertificate(True, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, attempts=0))
        for attempt in range(spec.settle.attempts):
            poses = self.draw_poses(assets, _random(spec.seed, "object poses", index, attempt))
            world = self._world(assets, capacity)
            world.reset(poses)
            outcome = run_to_rest(world, max_time=spec.settle.max_time, bounds=self._bounds)
            reason = outcome.refused
            if reason == OVERFLOW:
                capacity *= 2
            if not reason:
                resting = [self._placed(asset, pose) for asset, pose in zip(assets, outcome.poses, strict=True)]
                clearances = all_clearances(resting, self._obstacles, reach=_REACH)
                gaps = _support_gaps(resting, clearances)
                reason = _fault(clearances, gaps, self._obstacles)
            if reason:
                refused.append(reason)
                continue
            certificate = RestCertificate(
                rested=True,
                time_to_rest=outcome.time,
                max_speed=outcome.max_speed,
                max_spin=outcome.max_spin,
                surface_motion=outcome.surface_motion,
                deepest_penetration=max(0.0, -min(pair.distance for pair in clearances)),
                support_gap=max(gaps.values()),
                attempts=attempt + 1,
                refused=tuple(refused),
            )
            return Layout(index, self._instances(assets, outcome.poses), certificate)
        reasons = ", ".join(f"{count} x {reason}" for reason, count in Counter(refused).items())
        raise InputError(
            f"{self.scene.path}: layout {index} must come to rest in settle.attempts = {spec.settle.attempts} "
            f"draws (got {reasons})"
        )

    def _world(self, assets: tuple[int, ...], capacity: float) -> World:
        """The simulation of these assets; the last one is kept."""
        if (assets, capacity) not in self._worlds:
            settle, bodies = self.scene.spec.settle, [self._objects[asset][0] for asset in assets]
            self._worlds.clear()
            self._worlds[assets, capacity] = (
                MujocoWorld(bodies, self._colliders, timestep=settle.timestep)
                if settle.stepper == "mujoco"
                else WarpWorld(bodies, self._colliders, timestep=settle.timestep, capacity=capacity)
            )
        return self._worlds[assets, capacity]

    def _part(self, asset: Asset, progress: Progress) -> tuple[Body, Surface]:
        """Body and surface of an asset, made once for all entries that share its mesh."""
        if asset.mesh is None:
            raise InputError(f"asset {asset.name!r} must have a mesh to be dropped")
        if id(asset.mesh) not in self._parts:
            mesh = prepare_mesh(asset.mesh, f"asset {asset.name!r}")
            pieces = asset.pieces or _pieces(mesh, asset.name, progress)
            mass = mass_properties(mesh, pieces, density=asset.density, mass=asset.mass)
            self._parts[id(asset.mesh)] = Body(pieces, mass, asset.friction), Surface(mesh)
        return self._parts[id(asset.mesh)]

    def _add_colliders(self, progress: Progress) -> list[int]:
        """Fill colliders and obstacles, which are parallel; positions of the invisible ones: the enclosure."""
        scene, walls = self.scene, []
        for shape, shape_mesh in zip(scene.spec.shapes, scene.shape_meshes, strict=True):
            if not shape.collider:
                continue
            if not (shape.visible or shape.proxy):
                walls.append(len(self._colliders))
            mesh = prepare_mesh(shape_mesh, f"shape {shape.name!r}")
            if shape.box is None:
                collider = Collider(shape.friction, pieces=_pieces(mesh, shape.name, progress))
            else:
                pose = np.eye(4)
                pose[:3, :3] = Rotation.from_euler("xyz", shape.box.rotate, degrees=True).as_matrix()
                pose[:3, 3] = shape.box.position
                collider = Collider(shape.friction, box=(shape.box.size, pose))
            self._colliders.append(collider)
            self._obstacles.append(PlacedSurface(shape.name, Surface(mesh)))
        surroundings = scene.environment
        if scene.spec.environment_collides and surroundings is not None and surroundings.mesh is not None:
            mesh = prepare_mesh(surroundings.mesh, f"asset {surroundings.name!r}", solid=False)
            pieces = surroundings.pieces or _pieces(mesh, surroundings.name, progress)
            self._colliders.append(Collider(surroundings.friction, pieces=pieces))
            self._obstacles.append(PlacedSurface(surroundings.name, Surface(mesh)))
        if not self._colliders:
            raise InputError(f"{scene.path}: objects must have something to rest on (no shape is a collider)")
        return walls

    def draw_poses(self, assets: Sequence[int], rng: np.random.Generator) -> FloatArray:
        """Poses (N, 4, 4) in the region, orientations uniform in SO(3), bounding boxes apart, colliders not touched."""
        for _ in range(_DRAWS):
            poses = self._place_all(assets, rng)
            if poses is not None:
                return poses
        size = np.subtract(self.scene.spec.region.max, self.scene.spec.region.min)
        raise InputError(
            f"{self.scene.path}: region must be large enough to start all objects in (the {len(assets)} of a layout "
            f"find no room without overlap in {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} m)"
        )

    def _place_all(self, assets: Sequence[int], rng: np.random.Generator) -> FloatArray | None:
        region = self.scene.spec.region
        poses = np.tile(np.eye(4), (len(assets), 1, 1))
        taken: list[FloatArray] = []
        # Large ones first, for which room is scarce.
        for i in sorted(range(len(assets)), key=lambda i: -self._objects[assets[i]][0].size):
            poses[i, :3, :3] = Rotation.random(rng=rng).as_matrix()
            turned = self._objects[assets[i]][0].outline @ poses[i, :3, :3].T
            bounds = np.stack([turned.min(axis=0), turned.max(axis=0)])
            low, high = np.array(region.min) - bounds[0], np.array(region.max) - bounds[1]
            if (low > high).any():
                return None
            for _ in range(_PLACES):
                poses[i, :3, 3] = rng.uniform(low, high)
                box = bounds + poses[i, :3, 3]
                if any(_boxes_meet(box, other) for other in taken):
                    continue
                placed = self._placed(assets[i], poses[i])
                if all(clearance(placed, item, reach=_SPACING).distance > 0 for item in self._obstacles):
                    taken.append(box)
                    break
            else:
                return None
        return poses

    def _placed(self, asset: int, pose: FloatArray) -> PlacedSurface:
        return PlacedSurface(self.scene.assets[asset].name, self._objects[asset][1], pose)

    def _instances(self, assets: Sequence[int], poses: FloatArray) -> tuple[Instance, ...]:
        classes = [self.scene.class_names.index(self.scene.assets[asset].class_name) for asset in assets]
        return tuple(
            Instance(number + 1, asset, class_index, pose)
            for number, (asset, class_index, pose) in enumerate(zip(assets, classes, poses, strict=True))
        )


def _support_gaps(resting: Sequence[PlacedSurface], clearances: Sequence[Clearance]) -> dict[PlacedSurface, float]:
    """Distance of each object from what is nearest to it [m]."""
    return {
        item: max(0.0, min(pair.distance for pair in clearances if item in (pair.first, pair.second)))
        for item in resting
    }


def _fault(
    clearances: Sequence[Clearance], gaps: Mapping[PlacedSurface, float], obstacles: Sequence[PlacedSurface]
) -> str:
    """Why objects at rest are not where they could be, or empty."""
    for pair in sorted(clearances, key=lambda pair: pair.distance):
        if pair.second in obstacles:
            limit = max(_DEEPEST_IN_COLLIDER, _SHARE * pair.first.size)
        else:
            limit = max(_DEEPEST_IN_OBJECT, _SHARE * min(pair.first.size, pair.second.size))
        if -pair.distance > limit:
            return f"{pair.first.name} and {pair.second.name} overlap by {-pair.distance * 1e3:.1f} mm"
    for item, gap in gaps.items():
        if gap > max(_WIDEST_GAP, _SHARE * item.size):
            return f"{item.name} rests {gap * 1e3:.1f} mm or more from what is nearest"
    return ""


def _random(seed: int, purpose: str, *numbers: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([seed, zlib.crc32(purpose.encode()), *numbers]))


def _range(count: int | tuple[int, int]) -> tuple[int, int]:
    return (count, count) if isinstance(count, int) else count


def _pieces(mesh: trimesh.Trimesh, name: str, progress: Progress) -> tuple[trimesh.Trimesh, ...]:
    progress(f"convex pieces of {name}")
    return convex_pieces(mesh)


def _boxes_meet(first: FloatArray, second: FloatArray) -> bool:
    return bool((first[0] < second[1] + _SPACING).all() and (second[0] < first[1] + _SPACING).all())


def _enclosure(region: Region, bounds: Sequence[FloatArray], walls: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Corners of what centres of mass must stay in: the outer faces of the walls beside the region, else all colliders.

    Args:
        region: Where objects start.
        bounds: Bounding box of each collider, shape (2, 3) [m].
        walls: Positions of the colliders that are an enclosure.
    """
    low, high = np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]
    high[2] = max(high[2], region.max[2])
    for axis in (0, 1):
        across = 1 - axis
        for wall in (bounds[position] for position in walls):
            if wall[0][across] > region.min[across] or wall[1][across] < region.max[across]:
                continue
            if wall[0][axis] >= region.max[axis]:
                high[axis] = min(high[axis], wall[1][axis])
            if wall[1][axis] <= region.min[axis]:
                low[axis] = max(low[axis], wall[0][axis])
    return low, high
