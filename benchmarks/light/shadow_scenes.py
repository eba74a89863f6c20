"""Scenes, lights and objects of the light benchmarks: true meshes with materials, and their baked assets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mitsplat.arrays import Float32Array, Float64Array

# isort: off
from mitsplat.asset import Asset  # imports mitsplat, which must be imported before Dr.Jit

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh

# isort: on
from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import make_sensor
from mitsplat.renderer.occluders.proxies import Occluder, Proxies
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, LightSpec, SpotLight
from scenes.build import materials as m
from scenes.build.parts import build_part

ROOT = Path(__file__).resolve().parents[2]
SKY = (0.97, 0.99, 1.0)

LIGHTS: dict[str, tuple[LightSpec, ...]] = {
    "softbox": (
        AreaLight(position=(-0.35, -0.25, 0.75), target=(0, 0, 0), size=(0.3, 0.3), radiance=15.0),
        EnvironmentLight(radiance=0.25, colour=SKY),
    ),
    "lamp": (
        AreaLight(position=(0.45, 0.10, 0.65), target=(0, 0, 0), size=(0.06, 0.06), radiance=330.0),
        EnvironmentLight(radiance=0.2, colour=SKY),
    ),
    "spot": (
        SpotLight(position=(0.30, -0.35, 0.70), target=(0, 0, 0), cone=32.0, intensity=1.6),
        AreaLight(position=(-0.5, 0.1, 0.6), target=(0, 0, 0), size=(0.2, 0.2), radiance=7.0),
        EnvironmentLight(radiance=0.15, colour=SKY),
    ),
    "sky": (EnvironmentLight(radiance=0.9, colour=SKY),),
    "interior": (),  # an image, see lights_of
}


ROOM = np.array([(-3.0, -2.5, -0.75), (3.0, 3.5, 1.95)])
"""Opposite corners of the room of the light ``interior``; the setup is on a table at the origin [m]."""
WALL, CEILING, FLOOR = (0.30, 0.28, 0.25), (0.42, 0.41, 0.39), (0.12, 0.09, 0.07)
WINDOW = (14.0, 15.5, 17.0)
WINDOWS = ((1, 3.5, -2.0, -0.4), (1, 3.5, 0.4, 2.0), (0, -3.0, -1.0, 0.6))
"""Axis and position of the wall, and the horizontal interval of each window [m]."""
SILL, LINTEL, BAR = 0.2, 1.6, 0.03
"""Heights above the table of the lower and upper edge of the windows, and half the width of their bars [m]."""


def interior(height: int = 256, fine: int = 4) -> Float32Array:
    """Return an equirectangular map (H, 2 H, 3), y up: a room with dim walls and three windows.

    Radiance is that of :data:`WALL`, :data:`CEILING`, :data:`FLOOR` and :data:`WINDOW`. A vertical bar divides each
    window into two. Every pixel is the mean of ``fine`` x ``fine`` directions.
    """
    polar = (np.arange(fine * height) + 0.5) / (fine * height) * np.pi
    azimuth = (np.arange(2 * fine * height) + 0.5) / (fine * height) * np.pi
    across = np.sin(polar)[:, None]
    towards = np.broadcast_arrays(across * np.sin(azimuth), across * np.cos(azimuth), np.cos(polar)[:, None])
    direction = np.stack(towards, axis=-1)
    reach = np.where(direction > 0, ROOM[1], ROOM[0]) / direction
    axis = reach.argmin(axis=-1)
    point = direction * reach.min(axis=-1, keepdims=True)
    level = np.where(direction[..., 2] > 0, 1, 0)
    radiance = np.where((axis == 2)[..., None], np.array([FLOOR, CEILING])[level], np.array(WALL))
    for wall, position, low, high in WINDOWS:
        along = point[..., 1 - wall]
        bright = (axis == wall) & (np.abs(point[..., wall] - position) < 1e-6) & (low < along) & (along < high)
        bright &= (point[..., 2] > SILL) & (point[..., 2] < LINTEL) & (np.abs(along - 0.5 * (low + high)) > BAR)
        radiance = np.where(bright[..., None], WINDOW, radiance)
    return radiance.reshape(height, fine, 2 * height, fine, 3).mean(axis=(1, 3)).astype(np.float32)


def lights_of(name: str, folder: Path) -> tuple[LightSpec, ...]:
    """Return the lights of a name; the image of ``interior`` is written to ``folder`` if absent."""
    lights = LIGHTS[name]
    if name != "interior":
        return lights
    file = folder.resolve() / "interior.exr"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        mi.Bitmap(interior()).write(str(file))
    return (EnvironmentLight(image=str(file)),)


@dataclass(frozen=True, eq=False)
class Thing:
    """An object: its true mesh with materials, its asset, and its pose."""

    name: str
    mesh: trimesh.Scene
    pose: Float64Array
    asset: Callable[[Path], Asset]


@dataclass(frozen=True, eq=False)
class Setup:
    """Surroundings, objects on them, and a camera."""

    room: trimesh.Scene
    things: Sequence[Thing]
    camera: Camera
    density: Mapping[str, float] = field(default_factory=dict)


def pose(x: float, y: float, z: float, turn: float = 0.0, tilt: float = 0.0) -> Float64Array:
    """Return a pose [m], rotated about z after a tilt about x [degrees]."""
    matrix = trimesh.transformations.euler_matrix(np.radians(tilt), 0, np.radians(turn))
    matrix[:3, 3] = x, y, z
    return np.asarray(matrix)


def worn(
    mesh: trimesh.Trimesh, image: m.Pixels, *, tile: float = 0.2, roughness: float = 0.7, metallic: float = 0.0
) -> trimesh.Trimesh:
    return m.wear(mesh, image, m.box_uv(mesh, tile), roughness=roughness, metallic=metallic)


def block(low: Sequence[float], high: Sequence[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def simple(name: str, mesh: trimesh.Trimesh, where: Float64Array) -> Thing:
    """Return an object of one matt or glossy material, baked at a small size."""
    scene = trimesh.Scene({name: mesh})

    def bake(folder: Path) -> Asset:
        return baked(scene, folder / name, None, 5000, kind="object")

    return Thing(name, scene, where, bake)


def shipped(name: str, where: Float64Array) -> Thing:
    """Return a part of the shipped scene with its asset."""
    return Thing(name, build_part(name, 0)[0], where, lambda _: Asset.load(ROOT / "scenes/assets" / name))


def table_setup() -> Setup:
    """Return a table with a block whose shadow is captured, and coloured solids in and beside that shadow."""
    rng = np.random.default_rng(1)
    room = {
        "top": worn(block((-0.5, -0.4, -0.04), (0.5, 0.4, 0)), m.concrete(rng, 256)),
        "block": worn(block((-0.16, 0.02, -0.001), (-0.08, 0.10, 0.10)), m.cast((190, 150, 60), rng, size=64)),
    }
    solids = {
        "cube": (trimesh.creation.box((0.05, 0.05, 0.05)), (190, 60, 50), pose(-0.01, 0.03, 0.025, 25)),
        "ball": (trimesh.creation.icosphere(4, 0.03), (220, 218, 210), pose(0.06, -0.05, 0.03)),
        "post": (trimesh.creation.cylinder(0.018, 0.09, sections=48), (60, 110, 180), pose(0.12, 0.06, 0.045)),
        "plank": (trimesh.creation.box((0.10, 0.02, 0.008)), (120, 170, 90), pose(-0.07, -0.05, 0.004, -35)),
    }
    return Setup(trimesh.Scene(room), coloured(solids), view((0.05, -0.42, 0.30)))


def corner_setup() -> Setup:
    """Return two walls, one of them red, that reflect light onto nearby objects, and a shelf above."""
    rng = np.random.default_rng(2)
    room = {
        "floor": worn(block((-0.2, -0.4, -0.04), (0.5, 0.2, 0)), m.cast((205, 200, 190), rng)),
        "red": worn(block((-0.24, -0.4, -0.04), (-0.2, 0.2, 0.25)), m.cast((190, 40, 35), rng)),
        "back": worn(block((-0.24, 0.16, -0.04), (0.5, 0.2, 0.25)), m.cast((200, 200, 205), rng)),
        "shelf": worn(block((0.02, 0.06, 0.12), (0.5, 0.165, 0.13)), m.cast((150, 110, 70), rng)),
    }
    solids = {
        "carton": (trimesh.creation.box((0.06, 0.08, 0.09)), (200, 170, 120), pose(-0.14, 0.03, 0.045, 12)),
        "egg": (trimesh.creation.icosphere(4, 0.028), (235, 232, 225), pose(-0.05, -0.03, 0.028)),
        "can": (trimesh.creation.cylinder(0.025, 0.07, sections=64), (70, 140, 80), pose(0.09, 0.08, 0.035)),
        "slab": (trimesh.creation.box((0.09, 0.05, 0.012)), (60, 60, 70), pose(0.03, -0.10, 0.006, 20)),
    }
    return Setup(trimesh.Scene(room), coloured(solids), view((0.20, -0.42, 0.30), (-0.03, 0, 0.02)))


def bin_setup() -> Setup:
    """Return a box with walls that shade its inside, and solids that lean on each other in it."""
    rng = np.random.default_rng(3)
    outer, inner = block((-0.15, -0.11, 0), (0.15, 0.11, 0.09)), block((-0.14, -0.10, 0.01), (0.14, 0.10, 0.2))
    room = {
        "bench": worn(block((-0.3, -0.25, -0.04), (0.3, 0.25, -0.002)), m.cast((190, 150, 105), rng)),
        "bin": worn(trimesh.boolean.difference([outer, inner], engine="manifold"), m.cast((60, 100, 170), rng)),
    }
    solids = {
        "brick": (trimesh.creation.box((0.08, 0.04, 0.03)), (180, 80, 60), pose(-0.06, -0.03, 0.025, 15)),
        "lid": (trimesh.creation.box((0.08, 0.06, 0.006)), (225, 222, 210), pose(-0.03, -0.04, 0.047, 40, 9)),
        "marble": (trimesh.creation.icosphere(4, 0.022), (90, 170, 110), pose(0.06, 0.02, 0.032)),
        "roll": (trimesh.creation.cylinder(0.02, 0.05, sections=64), (210, 180, 60), pose(0.09, -0.05, 0.03, 30, 90)),
    }
    return Setup(trimesh.Scene(room), coloured(solids), view((0.0, -0.36, 0.38)), {"bench": 0.1})


def parts_setup() -> Setup:
    """Return the shipped metal and plastic parts on a grey mat."""
    rng = np.random.default_rng(4)
    room = {"mat": worn(block((-0.4, -0.3, -0.03), (0.4, 0.3, 0)), m.cast((120, 122, 120), rng, size=256))}
    lying = {
        "hex_nut_m20": (-0.07, 0.01, 0, 0),
        "hex_bolt": (0.0, -0.045, 20, 90),
        "l_bracket": (0.045, 0.03, -30, 0),
        "relay_box": (-0.02, 0.045, 10, 0),
        "bearing_6204": (0.075, -0.03, 0, 0),
        "cable_clip": (-0.06, -0.04, 60, 0),
    }
    things = []
    for name, (x, y, turn, tilt) in lying.items():
        mesh = build_part(name, 0)[0]
        turned = mesh.copy().apply_transform(pose(0, 0, 0, turn, tilt))
        things.append(shipped(name, pose(x, y, -float(turned.bounds[0, 2]), turn, tilt)))
    return Setup(trimesh.Scene(room), things, view((0.03, -0.22, 0.20), fov_x=46))


SETUPS = {"table": table_setup, "corner": corner_setup, "bin": bin_setup, "parts": parts_setup}


def coloured(solids: Mapping[str, tuple[trimesh.Trimesh, m.Colour, Float64Array]]) -> list[Thing]:
    rng = np.random.default_rng(5)
    return [
        simple(name, worn(mesh, m.cast(c, rng, size=64), roughness=0.6), p) for name, (mesh, c, p) in solids.items()
    ]


def view(eye: Sequence[float], target: Sequence[float] = (0, 0, 0.01), *, fov_x: float = 40.0) -> Camera:
    return Camera.look_at(eye, target, width=320, height=200, fov_x=fov_x)


def baked(
    scene: trimesh.Scene,
    folder: Path,
    lights: Sequence[LightSpec] | None,
    gaussians: int,
    *,
    kind: Any,
    density: Mapping[str, float] | None = None,
) -> Asset:
    """Return the asset in ``folder``, baked if absent."""
    if not (folder / "asset.yaml").exists():
        settings = BakeSettings(gaussians=gaussians, fit_steps=0, verify_views=0, density=density)
        mesh = trimesh.util.concatenate([part.mesh for part in read_model(scene).parts])
        pieces = [trimesh.Trimesh(mesh.vertices, mesh.faces).convex_hull]  # for physics, unused here
        result = bake_asset(scene, name=folder.name, kind=kind, lights=lights, settings=settings, pieces=pieces)
        result.asset.save(folder)
    return Asset.load(folder)


def placed(thing: Thing) -> tuple[MeshPart, ...]:
    """Return the parts of an object in its pose."""
    scene = thing.mesh.copy()
    scene.apply_transform(thing.pose)
    return tuple(replace(part, name=f"{thing.name} {part.name}") for part in read_model(scene).parts)


def nearest_object(
    camera: Camera, room: Sequence[MeshPart], things: Sequence[Sequence[MeshPart]]
) -> npt.NDArray[np.uint32]:
    """Return the number of the object at each pixel centre (H, W), 0 for the surroundings."""
    occluders = [Occluder(part.mesh, 0, dynamic=False) for part in room]
    occluders += [Occluder(part.mesh, i, dynamic=True) for i, parts in enumerate(things, 1) for part in parts]
    hit, _ = Proxies(occluders).nearest(make_sensor(camera).view().rays())
    return np.array(hit.instance).reshape(camera.height, camera.width)


def coverage(
    camera: Camera, room: Sequence[MeshPart], things: Sequence[Sequence[MeshPart]], *, side: int = 3
) -> tuple[npt.NDArray[np.uint32], Float64Array]:
    """Return the number of the object that covers a pixel completely, or 0, and the coverage by all objects (H, W)."""
    fine = nearest_object(camera.resized(camera.width * side, camera.height * side), room, things)
    by_pixel = fine.reshape(camera.height, side, camera.width, side)
    least, most = by_pixel.min(axis=(1, 3)), by_pixel.max(axis=(1, 3))
    return np.where(least == most, most, 0), (by_pixel > 0).mean(axis=(1, 3))
