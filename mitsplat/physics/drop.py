"""Drop simulation of a layout: draw start poses, drop the objects, and certify their rest."""

from __future__ import annotations

import gc
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.errors import InputError
from mitsplat.physics.bodies import Part, make_part
from mitsplat.physics.certificate import RestingObject, RestingState
from mitsplat.physics.handling import draw_handling
from mitsplat.physics.mujoco_world import MujocoWorld
from mitsplat.physics.placement import PUT_DOWN, Item
from mitsplat.physics.rest import (
    CONTACT_OVERFLOW,
    FREE_TIME,
    LATE,
    LEANING,
    Observe,
    RestOutcome,
    observe_nothing,
    run_to_rest,
)
from mitsplat.physics.start_poses import StartPoses
from mitsplat.physics.static_scene import make_static_scene
from mitsplat.physics.warp_world import WarpWorld
from mitsplat.physics.worlds import World
from mitsplat.progress import Note, discard_note
from mitsplat.scene.layout import NO_PHYSICS, Instance, Layout, LeftOut, RestCertificate, UnsettledLayoutError
from mitsplat.scene.planning.contents import draw_arrangements, draw_objects, draw_regions
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.scene.splits import draw_environment
from mitsplat.scene.streams import random_stream

TIMESTEP = 0.002  # of the simulation [s]
# Number of simulations between garbage collections. Newton leaves each model (1 MiB and more) in reference cycles,
# which Python would collect only after a quarter of all objects. A collection takes 0.5 s.
_COLLECTION_INTERVAL = 24
CROWDED = "no room for all"
_LEFT_OUT_PER_ROUND = 0.1  # share of the objects that is left out per round if they find no room,
_MAX_LEFT_OUT = 0.5  # and maximum share in total: beyond it, the region is too small
_POUR_SPEED = 1.0  # speed limit of poured objects [m/s]: at higher speed, heavy objects eject light ones
# Simulated time for the draws of a layout [s], five times that of a pile of thirty packages. After it, each rejected
# draw leaves objects out.
_MAX_SIMULATED = 20.0


@dataclass(frozen=True, eq=False)
class _DrawnObject:
    """An object drawn for a layout: its pose from the scene file (if any), its start region, and their arrangement."""

    id: int
    asset: int
    given: Float64Array | None
    region: int
    arrangement: Arrangement


@dataclass(frozen=True)
class _Rejection:
    """Rejection of a draw.

    Attributes:
        reason: Reason.
        causes: Positions of the objects that cause it.
        sentence: Error message, or empty.
        simulated: Simulated time of the draw [s].
    """

    reason: str
    causes: Sequence[int]
    sentence: str = ""
    simulated: float = 0.0


@dataclass(eq=False)
class _CachedDrop:
    """Simulation of a scene that reports to the caller of the present call."""

    scene: Scene
    progress: Note = discard_note

    @cached_property
    def drop(self) -> Drop:
        """The simulation."""
        return Drop(self.scene, lambda text: self.progress(text))


_cached_drop = lru_cache(maxsize=1)(_CachedDrop)


def drop_of(scene: Scene, progress: Note) -> Drop:
    """Return the :class:`Drop` of a scene, cached for the last scene. It reports to the last ``progress``."""
    cached = _cached_drop(scene)
    cached.progress = progress
    return cached.drop


class Drop:
    """Drop simulation of a scene's objects, with cached data that its layouts share.

    The simulation itself is the most expensive of these data.

    Args:
        scene: Objects, start regions and colliders.
        progress: Callback for slow operations, also when an asset is used for the first time.

    Attributes:
        scene: The scene.
        objects: Physical part of each asset of the scene.
        start_poses: Start poses of its objects.
        static_scenes: Colliders and obstacles by the number of the environment, or those of the last layout only.
    """

    def __init__(self, scene: Scene, progress: Note) -> None:
        self.scene = scene
        self._worlds: dict[tuple[tuple[int, ...], float, int], World] = {}
        self._world_count = 0
        parts: dict[int, Part] = {}
        for asset in scene.assets:
            if id(asset.mesh) not in parts:  # entries may share a mesh
                parts[id(asset.mesh)] = make_part(asset, progress)
        self.objects = [parts[id(asset.mesh)] for asset in scene.assets]
        self.start_poses = StartPoses(scene, self.objects)
        self._surroundings = (scene.environments if scene.spec.environment_collides else ()) or (None,)
        self.static_scenes = {
            number: make_static_scene(scene, self.objects, around, progress)
            for number, around in enumerate(self._surroundings)
        }
        for static in self.static_scenes.values():
            self.start_poses.check_given(static)

    def settle(self, index: int) -> Layout:
        """Draw poses until a layout passes all checks.

        After ``settle.attempts`` rejected draws, the objects that caused every rejection are left out. If there are
        none, the object that caused most rejections is left out. The remaining objects are drawn again. Once the draws
        of a layout have simulated 20 s, every rejected draw leaves out objects. If objects find no room beside one
        another, the last of them are left out.

        Raises:
            InputError: If more than half of the objects find no room, although each of them fits alone.
            UnsettledLayoutError: If no draw passes, even with fewer objects.
        """
        drawn = self._draw_contents(index)
        if not drawn:
            return Layout(index, (), NO_PHYSICS)
        attempts = self.scene.spec.settle.attempts
        refused: list[str] = []
        left_out: list[LeftOut] = []
        sentence = crowded = ""
        total, simulated = len(drawn), 0.0
        while drawn:
            faults: dict[int, list[str]] = {one.id: [] for one in drawn}
            before = len(refused)
            while len(refused) < before + attempts and CROWDED not in refused[before:]:
                found = self._try(index, drawn, refused)
                if isinstance(found, Layout):
                    return replace(found, left_out=tuple(left_out))
                refused.append(found.reason)
                sentence = found.sentence
                crowded = crowded or (sentence if found.reason == CROWDED else "")
                for position in found.causes:
                    faults[drawn[position].id].append(found.reason)
                simulated += found.simulated
                if simulated > _MAX_SIMULATED:
                    break
            draws = len(refused) - before
            removed = [one for one in drawn if len(faults[one.id]) == draws]
            if CROWDED in refused[before:]:
                removed = drawn[-math.ceil(_LEFT_OUT_PER_ROUND * len(drawn)) :]
                if len(drawn) - len(removed) < (1 - _MAX_LEFT_OUT) * total:
                    raise InputError(crowded)
            for one in removed or [max(drawn, key=lambda one: (len(faults[one.id]), one.id))]:
                reason, times = Counter(faults[one.id] or refused[before:]).most_common(1)[0]
                short_reason = reason.removeprefix(f"{self.scene.assets[one.asset].name} ")
                left_out.append(LeftOut(one.id, one.asset, f"{short_reason} in {times} of {draws} draws"))
                drawn.remove(one)
        reasons = ", ".join(f"{count} x {reason}" for reason, count in Counter(refused[:attempts]).items())
        rule = f"layout {index} must come to rest in settle.attempts = {attempts} draws (got {reasons})"
        failed = replace(NO_PHYSICS, attempts=len(refused), refused=tuple(refused))
        raise UnsettledLayoutError(sentence or f"{self.scene.path}: {rule}", Layout(index, (), failed, tuple(left_out)))

    def _draw_contents(self, index: int) -> list[_DrawnObject]:
        """Return the objects that are drawn for a layout."""
        assets, given = draw_objects(self.scene, index)
        arrangements = draw_arrangements(self.scene.spec, index)
        rows = zip(assets, given, draw_regions(self.scene.spec, index), strict=True)
        return [_DrawnObject(number, *row, arrangements[row[-1]]) for number, row in enumerate(rows, start=1)]

    def _arrangements(self, drawn: Sequence[_DrawnObject]) -> list[Arrangement]:
        """Return the arrangement of each region."""
        arrangements = [possible[0] for _, possible in self.scene.spec.all_regions]
        for one in drawn:
            arrangements[one.region] = one.arrangement
        return arrangements

    def _items(self, drawn: Sequence[_DrawnObject], given: Sequence[Float64Array | None] = ()) -> list[Item]:
        """Return objects to place, with the given poses or else those of the scene file."""
        poses = given or [one.given for one in drawn]
        return [self.start_poses.item(one.asset, pose, one.region) for one, pose in zip(drawn, poses, strict=True)]

    def _try(self, index: int, drawn: Sequence[_DrawnObject], refused: Sequence[str]) -> Layout | _Rejection:
        """Drop the given objects from the next draw of start poses."""
        number = self.static_key(index)
        assets, static = tuple(one.asset for one in drawn), self.static_scenes[number]
        items, arrangements = self._items(drawn), self._arrangements(drawn)
        rng = random_stream(self.scene.spec.seed, "object poses", index, len(refused))
        try:
            start = self.start_poses.draw(items, static, rng, arrangements)
        except InputError as error:
            # An object that is too large for its region is rejected alone; the others may still fit.
            alone = [self.start_poses.find([item], static, rng, arrangements) is None for item in items]
            reason = "no room for it" if any(alone) else CROWDED
            return _Rejection(reason, np.flatnonzero(alone).tolist(), str(error))
        world = self.world_of(assets, 2.0 ** refused.count(CONTACT_OVERFLOW), number)
        outcome = self._run(world, start, index, len(refused), drawn, rng)
        if outcome.rejection:
            reason = outcome.rejection
            if reason in (LEANING, LATE):
                reason = f"{self.scene.assets[assets[outcome.causes[0]]].name} {reason}"
            return _Rejection(reason, outcome.causes, simulated=world.time)
        # The tilt is the angle between the vertical and the object's start vertical after its rotation.
        upright = np.einsum("nj,nj->n", outcome.poses[:, 2, :3], start[:, 2, :3])
        resting = [
            RestingObject(
                self.start_poses.placed(one.asset, pose),
                one.arrangement,
                None if one.given is not None else float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
            )
            for one, pose, cosine in zip(drawn, outcome.poses, upright, strict=True)
        ]
        state = RestingState(resting, static.obstacles)
        defect = state.find_defect()
        if defect is not None:
            return _Rejection(defect.reason, defect.causes, simulated=world.time)
        certificate = RestCertificate(
            rested=True,
            inside=True,
            overflow=False,
            time_to_rest=outcome.time,
            max_speed=outcome.max_speed,
            max_spin=outcome.max_spin,
            surface_motion=outcome.surface_motion,
            collider_penetration=state.collider_penetration,
            pair_penetration=state.pair_penetration,
            support_gap=max(state.support_gaps),
            standoff=max(self.objects[asset].standoff for asset in assets),
            attempts=len(refused) + 1,
            refused=tuple(refused),
        )
        return Layout(index, self._instances(drawn, outcome.poses), certificate)

    def try_alone(self, asset: int, region: int, arrangement: Arrangement, tries: int) -> list[str]:
        """Drop an object alone into a region.

        Returns:
            The reason of each failed try, or [] if one try succeeds.
        """
        refused: list[str] = []
        while len(refused) < tries:
            found = self._try(0, [_DrawnObject(1, asset, None, region, arrangement)], refused)
            if isinstance(found, Layout):
                return []
            refused.append(found.reason)
        return refused

    def replay(self, layout: Layout, interval: float) -> Iterator[tuple[float, Float64Array, BoolArray]]:
        """Simulate the drop of a layout again, from the start until its objects rest.

        Yields:
            Every ``interval`` seconds: the time [s], the poses (N, 4, 4), and a mask (N,) of the objects that were
            dropped again since the moment before.
        """
        resting_ids = {instance.id for instance in layout.instances}
        drawn = [one for one in self._draw_contents(layout.index) if one.id in resting_ids]
        if not drawn:
            return
        assets, certificate = tuple(one.asset for one in drawn), layout.certificate
        attempt = certificate.attempts - 1
        rng = random_stream(self.scene.spec.seed, "object poses", layout.index, attempt)
        capacity = 2.0 ** certificate.refused.count(CONTACT_OVERFLOW)
        number = self.static_key(layout.index)
        world = self.world_of(assets, capacity, number)
        start = self.start_poses.draw(self._items(drawn), self.static_scenes[number], rng, self._arrangements(drawn))
        restarted = np.zeros(len(drawn), dtype=bool)
        moments = [(0.0, start, restarted.copy())]

        def observe(time: float, poses: Float64Array, again: BoolArray) -> None:
            np.logical_or(restarted, again, out=restarted)
            if len(moments) * interval <= time <= certificate.time_to_rest:
                moments.append((time, poses, restarted.copy()))
                restarted[:] = False

        self._run(world, start, layout.index, attempt, drawn, rng, observe)
        yield from moments

    def static_key(self, layout: int) -> int:
        """Return the key of a layout's static scene; environments without collision share one.

        If colliders are drawn per layout, each layout has its own static scene, and the last one is cached.
        """
        number = draw_environment(self.scene.spec, layout) if len(self._surroundings) > 1 else 0
        if not any(shape.collider and shape.is_drawn for shape in self.scene.spec.shapes):
            return number
        key = len(self._surroundings) + layout
        if key not in self.static_scenes:
            static = make_static_scene(self.scene, self.objects, self._surroundings[number], discard_note, layout)
            self.static_scenes.clear()
            self.static_scenes[key] = static
        return key

    def _run(
        self,
        world: World,
        start: Float64Array,
        index: int,
        attempt: int,
        drawn: Sequence[_DrawnObject],
        rng: np.random.Generator,
        observe: Observe = observe_nothing,
    ) -> RestOutcome:
        """Simulate a draw of a layout from its start poses (N, 4, 4); ``rng`` draws those of objects that fail."""
        settle = self.scene.spec.settle
        fastest = _POUR_SPEED if any(one.arrangement == "pile" for one in drawn) else np.inf
        static, arrangements = self.static_scenes[self.static_key(index)], self._arrangements(drawn)
        free = np.array([one.given is None for one in drawn])
        own = np.array([one.region for one in drawn])

        def limits(box: tuple[Float64Array, Float64Array]) -> tuple[Float64Array, Float64Array]:
            """Return the box of each object. Those with a pose in the scene file may be in any of the regions."""
            low, high = np.where(free[:, None], np.stack(box)[:, own], [[box[0].min(axis=0)], [box[1].max(axis=0)]])
            return low, high

        def redraw(poses: Float64Array, failed: BoolArray) -> Float64Array | None:
            if (failed & ~free).any():
                return None
            placed = [None if again else pose for again, pose in zip(failed, poses, strict=True)]
            return self.start_poses.find(self._items(drawn, placed), static, rng, arrangements)

        # Round objects that are put down would roll away without rolling friction.
        falls = PUT_DOWN.isdisjoint(one.arrangement for one in drawn)
        regions = [region for region, _ in self.scene.spec.all_regions]
        handling = draw_handling(
            world.bodies,
            start,
            list(zip(regions, arrangements, strict=True)),
            [free & (own == region) for region in range(len(regions))],
            random_stream(self.scene.spec.seed, "object motion", index, attempt),
            speed=settle.speed,
            spin=settle.spin,
        )
        world.reset(start, handling.velocities)
        return run_to_rest(
            world,
            max_time=settle.max_time,
            bounds=limits(static.bounds),
            walls=limits(static.walls),
            free_time=FREE_TIME if falls else 0.0,
            fastest=fastest,
            handling=handling,
            redraw=redraw if falls else None,
            observe=observe,
        )

    def world_of(self, assets: tuple[int, ...], capacity: float, number: int = 0) -> World:
        """Return the simulation of these assets in a static scene; the last one is cached."""
        key = assets, capacity, number
        if key not in self._worlds:
            static = self.static_scenes[number]
            bodies = [self.objects[asset].body for asset in assets]
            self._worlds.clear()
            self._world_count += 1
            if self._world_count % _COLLECTION_INTERVAL == 0:
                gc.collect()
            self._worlds[key] = (
                MujocoWorld(bodies, static.colliders, timestep=TIMESTEP)
                if self.scene.spec.settle.stepper == "mujoco"
                else WarpWorld(
                    bodies, static.colliders, timestep=TIMESTEP, capacity=capacity, contact_finder=static.contact_finder
                )
            )
        return self._worlds[key]

    def _instances(self, drawn: Sequence[_DrawnObject], poses: Float64Array) -> tuple[Instance, ...]:
        return tuple(
            Instance(one.id, one.asset, self.scene.class_index(one.asset), pose)
            for one, pose in zip(drawn, poses, strict=True)
        )
