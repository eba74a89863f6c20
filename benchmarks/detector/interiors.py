"""Rooms with a workbench, windows, fluorescent tubes and a desk lamp, and clutter on the bench, for Blender Cycles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
import trimesh
from shapely.geometry import MultiPoint, Point, Polygon
from trimesh.creation import box, cylinder
from trimesh.transformations import rotation_matrix, translation_matrix

from benchmarks.detector import clutter
from benchmarks.detector.clutter import Material, Thing, matt, metal, plate, tube, vivid
from benchmarks.light.shadow_scenes import block
from mitsplat.geometry.camera_poses import look_at_pose
from scenes.build.parts import turned

ROOM = np.array([(-2.3, -2.9, -0.85), (2.3, 1.7, 1.85)])
"""Corners of the room [m]; the top of the bench is z = 0 around the origin."""

BENCHES: tuple[Material, ...] = (
    matt([0.50, 0.34, 0.19], 0.45, "wood", second=[0.36, 0.22, 0.11]),
    metal([0.58, 0.59, 0.60], 0.42, pattern="spangle", second=[0.45, 0.46, 0.48], wear=0.6),
    matt([0.05, 0.13, 0.30], 0.75, "grain"),
    matt([0.62, 0.61, 0.58], 0.35, "speckle", second=[0.45, 0.44, 0.42]),
    matt([0.03, 0.16, 0.10], 0.6, "grid", second=[0.35, 0.45, 0.30]),
    matt([0.16, 0.085, 0.04], 0.35, "wood", second=[0.07, 0.035, 0.018]),
    matt([0.11, 0.20, 0.14], 0.5, "chips", second=[0.22, 0.20, 0.18]),
    matt([0.03, 0.03, 0.032], 0.8, "speckle", second=[0.06, 0.06, 0.06]),
    matt([0.40, 0.26, 0.14], 0.85, "cardboard"),
    matt([0.27, 0.26, 0.25], 0.8, "speckle", second=[0.17, 0.165, 0.16]),
    matt([0.72, 0.71, 0.67], 0.25, "grain"),
    matt([0.60, 0.46, 0.28], 0.6, "wood", second=[0.50, 0.36, 0.20]),
)
"""Tops of benches: beech, galvanised steel, blue mat, laminate, cutting mat, oak, chipped paint, rubber, cardboard,
concrete, white laminate and plywood."""

LIGHTING = (("window",), ("tubes",), ("window", "tubes"), ("lamp", "tubes"), ("lamp", "window"))


@dataclass
class Interior:
    """Things of a scene with their poses, and the places on the bench that are taken.

    Attributes:
        objects: Meshes with a material and a pose (4, 4) [m].
        taken: Footprints on the bench [m].
        tall: Bounds (2, 3) of things on the bench, which cameras keep away from [m].
    """

    objects: list[tuple[trimesh.Trimesh, Material, np.ndarray]] = field(default_factory=list)
    taken: list[Any] = field(default_factory=list)
    tall: list[np.ndarray] = field(default_factory=list)

    def add(self, thing: Thing, pose: np.ndarray | None = None) -> None:
        """Add a thing."""
        self.objects += [(mesh, kind, np.eye(4) if pose is None else pose) for mesh, kind in thing]

    def strew(self, thing: Thing, rng: np.random.Generator, reach: tuple[float, float], half: np.ndarray) -> None:
        """Place a thing on a free place of the bench, ``reach`` from the middle; leave it out if none is found."""
        points = np.concatenate([mesh.vertices[:, :2] for mesh, _ in thing])
        hull = MultiPoint(points).convex_hull.buffer(0.004)
        height = max(mesh.bounds[1, 2] for mesh, _ in thing)
        for _ in range(60):
            angle, away, turn = rng.uniform(0, 2 * np.pi), rng.uniform(*reach), rng.uniform(0, 2 * np.pi)
            place = away * np.array([1.35 * np.cos(angle), np.sin(angle)])
            there = shapely.affinity.translate(
                shapely.affinity.rotate(hull, turn, origin=(0, 0), use_radians=True), *place
            )
            in_front = height > 0.05 and place[1] < 0.04
            inside = Polygon(half * [(-1, -1), (1, -1), (1, 1), (-1, 1)]).contains(there)
            if inside and not in_front and not any(there.intersects(other) for other in self.taken):
                self.taken.append(there)
                low, high = np.array(there.bounds).reshape(2, 2)
                self.tall.append(np.array([[*low, 0], [*high, height]]))
                self.add(thing, translation_matrix((*place, 0)) @ rotation_matrix(turn, (0, 0, 1)))
                return


def container(rng: np.random.Generator, size: Sequence[float], thickness: float) -> Thing:
    """Return a bin of inner ``size`` [m] as in scenes: a stacking box, a sheet metal tray or a cardboard box."""
    half = np.array(size[:2]) / 2
    outer = block((*-(half + thickness), 0), (*(half + thickness), size[2]))
    inner = block((*-half, thickness), (*half, 1))
    kind = (
        matt(vivid(rng), 0.4),
        metal([0.55, 0.56, 0.57], 0.35, wear=0.5),
        matt([0.42, 0.27, 0.14], 0.85, "cardboard"),
    )[rng.integers(3)]
    shell = trimesh.boolean.difference([outer, inner], engine="manifold")
    if kind["pattern"] == "cardboard":
        return [(shell, kind)]
    lip = block((*-(half + thickness + 0.006), size[2] - 0.006), (*(half + thickness + 0.006), size[2]))
    return [
        (
            trimesh.boolean.union(
                [shell, trimesh.boolean.difference([lip, inner], engine="manifold")], engine="manifold"
            ),
            kind,
        )
    ]


def interior(
    number: int, rng: np.random.Generator, footprints: Sequence[np.ndarray], bin_size: Sequence[float] | None
) -> Interior:
    """Return the surroundings of parts whose vertices cover ``footprints`` (N, 2) [m], without the parts."""
    made = Interior()
    made.taken = [MultiPoint(points).convex_hull.buffer(0.003) for points in footprints]
    half = rng.uniform((0.65, 0.38), (0.85, 0.46))
    made.add([(block((*-half, -0.04), (*half, 0)), BENCHES[number % len(BENCHES)])])
    if bin_size is not None:
        made.add(container(rng, bin_size, 0.004))
        made.taken.append(
            shapely.geometry.box(*-(np.array(bin_size[:2]) / 2 + 0.012), *(np.array(bin_size[:2]) / 2 + 0.012))
        )
    elif rng.random() < 0.4:
        sheet = trimesh.creation.box(rng.uniform((0.25, 0.2, 0.0003), (0.42, 0.3, 0.0003)))
        paper = matt([0.7, 0.69, 0.66], 0.7, "print" if rng.random() < 0.5 else "grain")
        turn = rotation_matrix(rng.uniform(-0.5, 0.5), (0, 0, 1))
        made.add([(sheet, paper)], translation_matrix((*rng.uniform(-0.08, 0.08, 2), 0.0001)) @ turn)
    for makers, count, reach in (
        (clutter.SOFT, (1, 4), (0.12, 0.36)),
        (clutter.TOOLS, (2, 6), (0.05, 0.34)),
        (clutter.GOODS, (2, 6), (0.18, 0.42)),
        (clutter.SMALL, (1, 4), (0.03, 0.25)),
    ):
        for _ in range(int(rng.integers(*count))):
            made.strew(makers[rng.integers(len(makers))](rng), rng, reach, half)
    add_room(made, rng, half)
    for light in LIGHTING[number % len(LIGHTING)]:
        {"window": add_windows, "tubes": add_tubes, "lamp": add_lamp}[light](made, rng)
    return made


def add_room(made: Interior, rng: np.random.Generator, half: np.ndarray) -> None:
    """Add walls, cabinets, and what is behind the bench: a wall with tools, a shelf with boxes, or nothing."""
    low, high = ROOM
    paint = matt(list(rng.uniform(0.35, 0.75) * rng.uniform((0.9, 0.9, 0.8), (1, 1, 1))), 0.7)
    floor = rng.uniform(0.08, 0.35) * np.array([1, 0.95, 0.88])
    made.add([
        (block((*low[:2], low[2] - 0.1), (*high[:2], low[2])), matt(list(floor), 0.5, "speckle", second=[0.2] * 3)),
        (block((*low[:2], high[2]), (*high[:2], high[2] + 0.1)), matt([0.7, 0.7, 0.68], 0.8)),
        (block((low[0] - 0.1, low[1], low[2]), (low[0], high[1], high[2])), paint),
        (block((high[0], low[1], low[2]), (high[0] + 0.1, high[1], high[2])), paint),
        (block((low[0], low[1] - 0.1, low[2]), (high[0], low[1], high[2])), paint),
        (block((low[0], high[1], low[2]), (high[0], high[1] + 0.1, high[2])), paint),
    ])  # fmt: skip
    for _ in range(7):  # cabinets and machines along the walls
        size = rng.uniform((0.4, 0.4, 0.7), (1.0, 0.6, 1.9))
        side = rng.integers(3)
        place = (
            (low[0] + 0.35, rng.uniform(-2.5, 1.3)),
            (high[0] - 0.35, rng.uniform(-2.5, 1.3)),
            (rng.uniform(-1.8, 1.8), low[1] + 0.35),
        )[side]
        made.add(
            [(box(size), matt(vivid(rng), rng.uniform(0.3, 0.7)))], translation_matrix((*place, low[2] + size[2] / 2))
        )
    behind = rng.integers(3)
    back = half[1] + 0.03
    if behind == 0:
        made.add(
            [
                (
                    block((-1.3, back, -0.3), (1.3, back + 0.03, 0.9)),
                    matt(vivid(rng), 0.6, ("grain", "wood", "grid")[rng.integers(3)], second=[0.3] * 3),
                )
            ]
        )
        hung = rotation_matrix(np.pi / 2, (1, 0, 0))
        for x in np.arange(-0.6, 0.7, 0.16):
            tool = clutter.TOOLS[rng.integers(5)](rng)
            turn = rotation_matrix(np.pi / 2 + rng.normal(0, 0.06), (0, 0, 1))
            made.add(tool, translation_matrix((x, back, rng.uniform(0.15, 0.4))) @ hung @ turn)
    elif behind == 1:
        for z in (0.0, 0.3):
            made.add([(block((-0.9, back, z - 0.02), (0.9, back + 0.28, z)), metal([0.5, 0.5, 0.5], 0.5))])
            for x in np.arange(-0.8, 0.85, 0.2):
                thing = (clutter.package, clutter.spray_can, clutter.lid, clutter.tape)[rng.integers(4)](rng)
                made.add(
                    thing, translation_matrix((x, back + 0.13, z)) @ rotation_matrix(rng.uniform(-0.3, 0.3), (0, 0, 1))
                )


def shining(radiance: float, temperature: float) -> Material:
    """Return the material of an emitter of a blackbody's colour."""
    return {"emission": float(radiance), "temperature": float(temperature)}


def add_windows(made: Interior, rng: np.random.Generator) -> None:
    """Add a window with a frame to one or two of the walls beside and in front of the bench."""
    low, high = ROOM
    turns = {0: (low[0] + 0.01, np.pi / 2), 1: (high[0] - 0.01, -np.pi / 2), 2: (low[1] + 0.01, np.pi)}
    for side in rng.permutation(3)[: rng.integers(1, 3)]:
        where, turn = turns[int(side)]
        width, height = rng.uniform(0.9, 1.8), rng.uniform(0.8, 1.2)
        along, sill = rng.uniform(-0.9, 0.5), rng.uniform(0.05, 0.4)
        place = (along, where, sill) if side == 2 else (where, along, sill)
        pose = translation_matrix(place) @ rotation_matrix(turn, (0, 0, 1))
        # The window faces -y here.
        pane = block((-width / 2, 0, 0), (width / 2, 0.005, height))
        frame = matt([0.75] * 3 if rng.random() < 0.6 else [0.1, 0.1, 0.1], 0.4)
        bars = [
            block((x - 0.03, -0.05, 0), (x + 0.03, 0.01, height))
            for x in np.linspace(-width / 2, width / 2, int(rng.integers(2, 5)))
        ]
        bars += [
            block((-width / 2, -0.05, z - 0.03), (width / 2, 0.01, z + 0.03))
            for z in np.linspace(0, height, int(rng.integers(2, 4)))
        ]
        made.add([(pane, shining(rng.uniform(8, 25), rng.uniform(5500, 9000))), *((bar, frame) for bar in bars)], pose)


def add_tubes(made: Interior, rng: np.random.Generator) -> None:
    """Add fluorescent tubes in fixtures below the ceiling."""
    radiance, temperature = rng.uniform(40, 110), rng.uniform(3500, 6800)
    turn = rotation_matrix(rng.choice([0, np.pi / 2]), (0, 0, 1))
    for _ in range(int(rng.integers(2, 6))):
        fixture = block((-0.63, -0.06, 0.02), (0.63, 0.06, 0.05))
        light = cylinder(0.013, 1.2, sections=12).apply_transform(rotation_matrix(np.pi / 2, (0, 1, 0)))
        place = rng.uniform((-1.3, -1.6, 1.2), (1.3, 0.6, 1.7))
        made.add(
            [(light, shining(radiance, temperature)), (fixture, matt([0.7] * 3, 0.4))], translation_matrix(place) @ turn
        )


def add_lamp(made: Interior, rng: np.random.Generator) -> None:
    """Add a desk lamp that shines on the parts from the far side of the bench."""
    place = rng.uniform((0.3, 0.12, 0.32), (0.55, 0.34, 0.52)) * (rng.choice([-1, 1]), 1, 1)
    r = rng.uniform(0.03, 0.06)
    # The axis of the shade points from the lamp to the bench.
    shade = turned(
        [(0.35 * r, -0.09), (0.4 * r, -0.09), (1.5 * r, 0.02), (1.45 * r, 0.02), (0.35 * r, -0.085), (0.35 * r, -0.09)]
    )
    bulb = plate(Point(0, 0).buffer(r, 4), 0.003, -0.003)
    aim = look_at_pose(place, (*rng.uniform(-0.08, 0.08, 2), 0))
    finish = matt(vivid(rng), 0.35)
    radiance = rng.uniform(0.5, 1.4) / r**2
    made.add([(bulb, shining(radiance, rng.uniform(2700, 5500))), (shade, finish)], aim)
    rear = place - 0.085 * aim[:3, 2]
    arm = tube(
        clutter.curve(
            [(place[0] * 1.25, 0.36, 0), (place[0] * 1.3, 0.38, 0.25), rear + np.array([0, 0.03, 0.05]), rear], 30
        ),
        0.008,
    )
    made.add([(arm, finish)])
