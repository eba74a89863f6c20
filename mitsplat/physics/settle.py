"""Settled layouts: objects dropped from random poses and simulated until they rest, each with a rest certificate."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import version
from itertools import compress, product
from pathlib import Path

import numpy as np
import trimesh

from mitsplat.engine.pool import run_frames
from mitsplat.errors import InputError
from mitsplat.progress import Note, discard_note
from mitsplat.runtime.variant import one_at_a_time
from mitsplat.runtime.warp_start import quiet_warp
from mitsplat.scene.layout import Layout, UnsettledLayoutError
from mitsplat.scene.planning.frame_plan import to_index
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.storage.cache import cache_folder, write_cache_file
from mitsplat.storage.content_hash import ContentHash

PACKAGE = Path(__file__).parents[1]

_PHYSICS_MODULES = (
    *("bodies", "certificate", "contact_solver", "contacts", "drop", "friction", "handling", "mujoco_world"),
    *("newton_model", "placement", "rest", "restitution", "start_poses", "static_scene", "warp_world", "worlds"),
)
MODULES = (
    "geometry.decomposition",
    "geometry.hull_facets",
    "geometry.hull_fit",
    "geometry.mesh",
    "geometry.mesh_distance",
    "geometry.mesh_holes",
    "geometry.mesh_points",
    "geometry.rigid",
    "geometry.solids",
    *(f"physics.{name}" for name in _PHYSICS_MODULES),
    "scene.planning.contents",
    "scene.planning.shape_poses",
    "scene.splits",
    "scene.streams",
    "scene.walls",
)
"""Modules whose code determines the resting poses.

From other modules they import only types and values, and the values are hashed separately.
"""
_SIMULATION = ("mujoco", "mujoco-warp", "newton", "warp-lang")
_TRIES_ALONE = 3
"""Drops of an object alone before it counts as one that does not come to rest."""
LIBRARIES = ("coacd", "fast-simplification", "manifold3d", "numpy", "scipy", "trimesh", *_SIMULATION)


@one_at_a_time
def settle_layout(scene: Scene, index: int, *, progress: Note | None = None, cached: bool = True) -> Layout:
    """Drop the objects of one layout until they rest. The scene's seed and ``index`` determine the result.

    The result is cached in ``$XDG_CACHE_HOME/mitsplat/layouts`` (``~/.cache`` by default). The key is a hash of all
    inputs of the simulation: objects, start regions, colliders and code, but not their appearance.

    Args:
        scene: Objects, start regions and colliders.
        index: Index of the layout.
        progress: Callback for slow operations: convex decomposition, compilation.
        cached: Read an existing result from the cache, and write a new one to it.

    Raises:
        InputError: If there is no layout of this index, the region is too small for the objects, or none of them comes
            to rest within the limits.
    """
    Scene.check(scene)
    index = to_index(index, "layout")
    if index < 0:
        raise InputError(f"layout must be at least 0 (got {index})")
    path = _cached_path(scene, index)
    if cached:
        with suppress(OSError, ValueError, KeyError, TypeError):  # a damaged or missing file is replaced
            return Layout.from_json(json.loads(path.read_bytes()))
    with warp_settings(progress if scene.spec.settle.stepper == "warp" else None):
        from mitsplat.physics.drop import drop_of  # Newton reads these settings when it compiles

        layout = drop_of(scene, progress or discard_note).settle(index)
    if cached:
        write_cache_file(path, lambda file: file.write(json.dumps(layout.to_json()).encode()))
    return layout


def is_cached(scene: Scene, index: int) -> bool:
    """Return True if the result of :func:`settle_layout` is in the cache."""
    return _cached_path(scene, index).exists()


def _cached_path(scene: Scene, index: int) -> Path:
    return cache_folder() / "layouts" / f"{_scene_hash(scene)[:32]}-{index:04d}.json"


@dataclass(frozen=True)
class _SettleOne:
    """Job that settles a layout in a worker process."""

    scene: Scene
    cached: bool

    def __call__(self, index: int, note: Note, /) -> Layout:
        try:
            return settle_layout(self.scene, index, progress=note, cached=self.cached)
        except UnsettledLayoutError as nothing:
            return nothing.layout


def settle_layouts(
    scene: Scene, indices: Iterable[int], *, workers: int = 1, progress: Note | None = None, cached: bool = True
) -> Iterator[Layout]:
    """Settle many layouts in worker processes and yield them in order of completion; see :func:`settle_layout`.

    If no object of a layout comes to rest, the layout is empty and lists the missing objects.

    Several layouts in one simulation (Newton's worlds) cost about as much per layout as single ones on a CPU, and would
    wait for the slowest (``python -m benchmarks.physics.settle worlds``).
    """
    layouts = {index: [index] for index in indices}
    return run_frames(_SettleOne(scene, cached), layouts, workers=workers, note=progress or discard_note)


def try_alone(scene: Scene) -> Iterator[tuple[str, Arrangement, list[str]]]:
    """Drop each object alone in each arrangement of its regions, but only in the first one of random poses.

    Yields:
        Its asset, the arrangement, and the reasons of the tries if all of them failed.

    One size of each asset is tried. The stepper is always MuJoCo in C, because it needs no compilation.

    Raises:
        InputError: If no collider exists.
    """
    settle = scene.spec.settle.model_copy(update={"stepper": "mujoco"})
    scene = replace(scene, spec=scene.spec.model_copy(update={"settle": settle}))
    tried = set()
    with warp_settings():
        from mitsplat.physics.drop import drop_of  # Newton reads these settings when it compiles
        from mitsplat.physics.placement import PUT_DOWN

        drop = drop_of(scene, discard_note)
        for entry, pool in zip(scene.spec.objects, scene.pools, strict=True):
            for region in () if entry.poses else scene.spec.regions_of(entry):
                possible = scene.spec.all_regions[region][1]
                falling = [arrangement for arrangement in possible if arrangement not in PUT_DOWN]
                put_down = [arrangement for arrangement in possible if arrangement in PUT_DOWN]
                for asset, arrangement in product(pool, [*falling[:1], *put_down]):
                    one = scene.assets[asset].name, region, arrangement
                    if one not in tried:
                        tried.add(one)
                        yield one[0], arrangement, drop.try_alone(asset, region, arrangement, _TRIES_ALONE)


@dataclass(frozen=True, eq=False)
class ReplayMoment:
    """Moment of a replay.

    Attributes:
        layout: The layout with the poses of this moment.
        time: Simulated time since the start [s].
        dropped_again: Ids of the objects that have been dropped again since the moment before. They jump to new start
            poses.
    """

    layout: Layout
    time: float
    dropped_again: tuple[int, ...] = ()


def replay_layout(scene: Scene, layout: Layout, *, interval: float = 0.04) -> Iterator[ReplayMoment]:
    """Simulate the drop of a layout again.

    On a CPU, the simulation reproduces the original drop exactly.

    Yields:
        A moment every ``interval`` seconds [s], and finally the given layout.
    """
    with warp_settings():
        from mitsplat.physics.drop import drop_of  # Newton reads these settings when it compiles

        for time, poses, again in drop_of(scene, discard_note).replay(layout, interval):
            moving = (
                replace(instance, world_from_object=pose)
                for instance, pose in zip(layout.instances, poses, strict=True)
            )
            ids = tuple(instance.id for instance in compress(layout.instances, again))
            yield ReplayMoment(replace(layout, instances=tuple(moving)), time, ids)
    yield ReplayMoment(layout, layout.certificate.time_to_rest)


@lru_cache(maxsize=4)
def _scene_hash(scene: Scene) -> str:
    """Return a hash of all inputs that determine the resting poses of a scene."""
    spec = scene.spec
    digest = ContentHash()

    def add(*values: object) -> None:
        digest.add(repr(values))

    def add_mesh(mesh: trimesh.Trimesh | None) -> None:
        if mesh is not None:
            for array in (mesh.vertices, mesh.faces):
                add(array.shape)
                digest.add(np.ascontiguousarray(array).tobytes())

    for name in LIBRARIES:
        add(name, version(name))
    for module in MODULES:
        digest.add((PACKAGE / f"{module.replace('.', '/')}.py").read_bytes())
    solid = [shape.collider for shape in spec.shapes]
    shapes = [shape.model_copy(update={"materials": ()}) for shape in compress(spec.shapes, solid)]
    add(platform.machine(), spec.seed, spec.settle, spec.region, spec.objects, shapes)
    add(scene.class_names, spec.environment_collides)
    held_out = spec.hold_out.assets or spec.hold_out.environments
    if spec.empty or held_out or any(entry.balance for entry in spec.objects):  # these depend on splits
        add(spec.empty, spec.output.validation, spec.output.test, spec.hold_out)
    for mesh in compress(scene.shape_meshes, solid):
        add_mesh(mesh)
    surroundings = scene.environments if spec.environment_collides else ()
    if spec.regions:
        add(spec.regions)
    for asset in (*scene.assets, *surroundings):
        add(asset.name, asset.class_name, asset.density, asset.mass)
        add(asset.friction, asset.restitution, asset.rolling_friction, asset.torsional_friction)
        for mesh in (asset.mesh, *asset.pieces):
            add_mesh(mesh)
    return digest.hexdigest()


@contextmanager
def warp_settings(progress: Note | None = None) -> Iterator[None]:
    """Silence Warp and disable gradients, which reduces the simulation's compile time to two thirds."""
    import warp as wp  # takes a third of a second, which a cached layout does not need

    kept = wp.config.enable_backward
    wp.config.enable_backward = False
    try:
        with quiet_warp():
            compiled = Path(wp.config.kernel_cache_dir or ".").glob("wp_newton._src.solvers.mujoco.kernels*")
            if progress is not None and not any(compiled):
                progress("compiling physics kernels for the first time (about a minute)")
            yield
    finally:
        wp.config.enable_backward = kept
