"""Things on workbenches that are no parts: tools, packaging, cables, cloth and small hardware, modelled in code.

Each builder returns a thing that stands on z = 0 around the origin [m], as meshes with a material each. A material is a
dictionary that ``blender_photos.py`` turns into shader nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
import trimesh
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from shapely.geometry import LineString, Point, Polygon, box
from trimesh.creation import extrude_polygon
from trimesh.transformations import rotation_matrix, translation_matrix

from scenes.build.parts import MM, cut, hexagon, rod, rounded_box, turned

Material = dict[str, Any]
Thing = list[tuple[trimesh.Trimesh, Material]]

STEEL = (0.56, 0.55, 0.53)
"""Linear reflectance of bare steel at normal incidence."""


def matt(colour: Sequence[float], roughness: float = 0.5, pattern: str = "grain", **more: Any) -> Material:
    """Return the material of a dielectric of linear ``colour``."""
    return {"colour": list(colour), "roughness": roughness, "metallic": 0.0, "pattern": pattern, **more}


def metal(colour: Sequence[float] = STEEL, roughness: float = 0.3, **more: Any) -> Material:
    """Return the material of a metal of linear reflectance ``colour``."""
    return {"colour": list(colour), "roughness": roughness, "metallic": 1.0, "pattern": "grain", **more}


def vivid(rng: np.random.Generator) -> list[float]:
    """Return a random linear colour: half of them saturated, the others grey to black."""
    if rng.random() < 0.5:
        return [float(value) for value in rng.permutation([rng.uniform(0.3, 0.7), rng.uniform(0, 0.3), 0.03])]
    return [float(value) for value in rng.uniform(0.02, 0.6) * rng.uniform(0.9, 1.1, 3)]


def tube(path: np.ndarray, radius: float, sections: int = 14) -> trimesh.Trimesh:
    """Return a circle swept along points (N, 3)."""
    circle = Point(0, 0).buffer(radius, max(1, sections // 4))
    return trimesh.creation.sweep_polygon(circle, path, engine="earcut")


def curve(points: Sequence[Sequence[float]], count: int = 80) -> np.ndarray:
    """Return ``count`` points of a smooth curve through points (N, 3)."""
    return np.asarray(CubicSpline(np.arange(len(points)), points)(np.linspace(0, len(points) - 1, count)))


def plate(outline: Polygon, thickness: float, low: float = 0.0) -> trimesh.Trimesh:
    return extrude_polygon(outline, thickness, engine="earcut").apply_translation((0, 0, low))


def grounded(*pieces: tuple[trimesh.Trimesh, Material], lying: bool = False) -> Thing:
    """Return pieces in millimetres as a thing in metres; one along z is laid along x if ``lying``."""
    moves = rotation_matrix(np.pi / 2, (0, 1, 0)) if lying else np.eye(4)
    whole = [mesh.copy().apply_transform(moves) for mesh, _ in pieces]
    low, high = np.min([mesh.bounds[0] for mesh in whole], 0), np.max([mesh.bounds[1] for mesh in whole], 0)
    middle = np.array([*(low + high)[:2] / 2, low[2]])
    return [
        (mesh.apply_translation(-middle).apply_scale(MM), kind) for mesh, (_, kind) in zip(whole, pieces, strict=True)
    ]


def screwdriver(rng: np.random.Generator) -> Thing:
    """Screwdriver with a fluted handle."""
    length, r = rng.uniform(60, 150), rng.uniform(11, 17)
    handle = turned(
        [(0, 0), (0.6 * r, 0), (0.95 * r, 4), (r, 18), (0.95 * r, 60), (0.62 * r, 78), (0.75 * r, 92), (0.5 * r, 96),
         (0, 96)]
    )  # fmt: skip
    turns = np.arange(6) * np.pi / 3
    flutes = [rod(0.3 * r, 8, 64).apply_translation((1.13 * r * np.cos(a), 1.13 * r * np.sin(a), 0)) for a in turns]
    shaft = rod(rng.uniform(2, 3.5), 95, 96 + length)
    tip = trimesh.creation.box((6.5, 0.9, 9)).apply_translation((0, 0, 99 + length))
    collar = turned([(0, 78), (0.66 * r, 78), (0.7 * r, 85), (0, 88)])
    colour = vivid(rng)
    return grounded(
        (cut(handle, *flutes), matt(colour, rng.uniform(0.15, 0.4))),
        (collar, matt([0.02, 0.02, 0.02], 0.5)),
        (shaft, metal((0.6, 0.6, 0.6), 0.2)),
        (tip, metal((0.2, 0.2, 0.2), 0.4)),
        lying=True,
    )


def spanner(rng: np.random.Generator) -> Thing:
    """Combination spanner: open jaw and ring."""
    size = rng.uniform(10, 24)
    length = 8 * size + 30
    jaw = (
        Point(0, 0)
        .buffer(1.1 * size)
        .difference(shapely.affinity.rotate(box(-2 * size, -size / 2, 0.3 * size, size / 2), 15, origin=(0, 0)))
    )
    ring = Point(length, 0).buffer(0.82 * size).difference(Point(length, 0).buffer(0.52 * size, 3))
    shaft = box(0.8 * size, -0.28 * size, length - 0.7 * size, 0.28 * size)
    waist = box(1.6 * size, -0.13 * size, length - 1.6 * size, 0.13 * size)
    flat = plate(shapely.union_all([jaw, ring, shaft]).buffer(-0.6).buffer(0.6), 0.3 * size)
    groove = plate(waist, 1.0, 0.3 * size - 0.5)
    finish = metal((0.72, 0.72, 0.72), rng.uniform(0.12, 0.3)) if rng.random() < 0.7 else metal((0.1, 0.1, 0.1), 0.4)
    return grounded((cut(flat, groove), finish))


def pliers(rng: np.random.Generator) -> Thing:
    """Combination pliers, slightly open, with plastic sleeves."""
    colour, opened, pieces = vivid(rng), rng.uniform(3, 9), []
    for side in (1, -1):
        spine = curve([(0, 0, 0), (20, 10, 0), (60, 17, 0), (110, 15, 0), (140, 12, 0)], 40)[:, :2]
        lever = LineString(spine).buffer(4.5)
        head = Polygon([(6, -9), (8, 9), (-14, 11), (-42, 5), (-44, 0.4), (4, 0.4)]).buffer(1)
        outline = shapely.union_all([lever, head, Point(0, 0).buffer(11)])
        sleeve = np.column_stack([spine[14:], np.full(len(spine[14:]), 5.0)])
        both = [
            (plate(outline, 5, 0 if side > 0 else 5), metal((0.3, 0.3, 0.31), 0.35)),
            (tube(sleeve, 6.2), matt(colour, rng.uniform(0.3, 0.6))),
        ]
        for mesh, kind in both:
            if side < 0:
                mesh.apply_transform(rotation_matrix(np.pi, (1, 0, 0))).apply_translation((0, 0, 10))
            pieces.append((mesh.apply_transform(rotation_matrix(side * np.radians(opened), (0, 0, 1))), kind))
    return grounded(*pieces)


def hex_key(rng: np.random.Generator) -> Thing:
    """Angled hexagon key."""
    size = rng.uniform(3, 8)
    bend = np.linspace(0, np.pi / 2, 10)
    arc = np.column_stack([2 * size * np.sin(bend), 2 * size * (1 - np.cos(bend)), 0 * bend])
    path = np.vstack([[(-22 * size, 0, 0)], arc, [(2 * size, 7 * size, 0)]])
    mesh = trimesh.creation.sweep_polygon(hexagon(size), path, engine="earcut")
    return grounded((mesh, metal((0.12, 0.12, 0.13) if rng.random() < 0.6 else STEEL, 0.35)))


def caliper(rng: np.random.Generator) -> Thing:
    """Vernier caliper."""
    opened = rng.uniform(0, 60)
    fixed = shapely.union_all([box(0, 0, 210, 16), Polygon([(0, 0), (0, -40), (3, -40), (14, 0)]), box(0, 16, 6, 30)])
    slide = Polygon([(0, 0), (0, -40), (-3, -40), (-14, 0)]).union(box(-12, -3, 50, 21)).union(box(-12, 16, -7, 30))
    steel = metal((0.66, 0.66, 0.65), 0.28)
    face = plate(box(4, 3, 40, 15), 1.0, 6.0)
    display = rng.random() < 0.5
    return grounded(
        (plate(fixed, 3.5), steel),
        (plate(slide, 6).apply_translation((opened + 14, 0, 0)), matt([0.03] * 3, 0.5) if display else steel),
        (face.apply_translation((opened + 14, 0, 0)), matt([0.25, 0.3, 0.22], 0.15)),
    )


def tape(rng: np.random.Generator) -> Thing:
    """Roll of adhesive tape."""
    inner, width = rng.uniform(25, 38), rng.uniform(12, 50)
    outer = inner + rng.uniform(6, 25)
    core = turned([(inner - 2.5, 0), (inner, 0), (inner, width), (inner - 2.5, width), (inner - 2.5, 0)])
    roll = turned([(inner, 0), (outer, 0), (outer, width), (inner, width), (inner, 0)])
    return grounded((roll, matt(vivid(rng), 0.3)), (core, matt([0.4, 0.28, 0.16], 0.8)))


def mug(rng: np.random.Generator) -> Thing:
    """Mug with a handle and coffee."""
    r, height = rng.uniform(36, 43), rng.uniform(80, 105)
    body = turned([(0, 0), (r - 4, 0), (r, 5), (r, height), (r - 3, height), (r - 3, 6), (0, 5)])
    grip = curve([(x, 0, z * height) for x, z in ((r - 1, 0.8), (r + 26, 0.75), (r + 24, 0.35), (r - 1, 0.25))], 30)
    glaze = matt(vivid(rng), 0.12)
    level = rng.uniform(0.3, 0.8) * height
    coffee = turned([(0, 6), (r - 3.2, 6), (r - 3.2, level), (0, level)])
    return grounded((body, glaze), (tube(grip, 5.5), glaze), (coffee, matt([0.02, 0.01, 0.005], 0.1)))


def spray_can(rng: np.random.Generator) -> Thing:
    """Spray can, upright, with a printed band."""
    r = rng.uniform(24, 33)
    body = turned([(0, 0), (r, 0), (r, 140), (0.8 * r, 152), (0, 153)])
    cap = turned([(0, 150), (0.75 * r, 150), (0.75 * r, 185), (0.6 * r, 190), (0, 190)])
    band = turned([(r + 0.1, 30), (r + 0.1, 110), (r, 110), (r, 30), (r + 0.1, 30)])
    return grounded(
        (body, matt(vivid(rng), 0.25)), (cap, matt(vivid(rng), 0.35)), (band, matt([0.6, 0.6, 0.58], 0.3, "print"))
    )


def marker(rng: np.random.Generator) -> Thing:
    """Felt-tip marker, lying."""
    colour = matt(vivid(rng), 0.35)
    body = turned([(0, 0), (7, 0), (8, 3), (8, 85), (0, 85)])
    cap = turned([(0, 85), (8.6, 85), (8.2, 125), (5, 130), (0, 130)])
    return grounded((body, matt([0.7, 0.7, 0.7], 0.35)), (cap, colour), lying=True)


def carton(rng: np.random.Generator) -> Thing:
    """Open cardboard box with flaps."""
    a, b, height = rng.uniform(80, 180), rng.uniform(60, 120), rng.uniform(35, 90)
    board = matt([0.42, 0.27, 0.14], 0.85, "cardboard")
    walls = [
        trimesh.creation.box((a, b, 3)).apply_translation((0, 0, 1.5)),
        *(trimesh.creation.box((a, 3, height)).apply_translation((0, s * (b / 2 - 1.5), height / 2)) for s in (1, -1)),
        *(trimesh.creation.box((3, b, height)).apply_translation((s * (a / 2 - 1.5), 0, height / 2)) for s in (1, -1)),
    ]
    for k in range(4):
        width, reach = (b, a / 2) if k % 2 == 0 else (a, b / 2)
        flap = trimesh.creation.box((0.5 * reach, width - 4, 2.5)).apply_translation((0.25 * reach, 0, 0))
        flap.apply_transform(rotation_matrix(rng.uniform(-0.9, 0.9), (0, 1, 0)))
        flap.apply_translation((reach - 1.5, 0, height))
        walls.append(flap.apply_transform(rotation_matrix(k * np.pi / 2, (0, 0, 1))))
    return grounded(*((wall, board) for wall in walls))


def package(rng: np.random.Generator) -> Thing:
    """Closed small carton with print and a strip of tape."""
    size = rng.uniform((50, 35, 18), (150, 100, 80))
    print_ = matt(vivid(rng), rng.uniform(0.2, 0.7), "print" if rng.random() < 0.6 else "cardboard")
    strip = rounded_box((size[0] + 0.6, 22, size[2] + 0.6), 0.3)
    return grounded((rounded_box(tuple(size), 1.0), print_), (strip, matt([0.5, 0.4, 0.25], 0.15)))


def foam(rng: np.random.Generator) -> Thing:
    """Block of packing foam with pockets."""
    block = trimesh.creation.box((150, 100, 30)).apply_translation((0, 0, 15))
    pockets = [rod(rng.uniform(12, 22), 10, 40).apply_translation((x, y, 0)) for x in (-45, 0, 45) for y in (-24, 24)]
    return grounded((cut(block, *pockets), matt([0.03] * 3 if rng.random() < 0.5 else [0.5, 0.15, 0.25], 0.95)))


def lid(rng: np.random.Generator) -> Thing:
    """Jar or pot without its lid."""
    r, height = rng.uniform(20, 45), rng.uniform(25, 70)
    pot = turned([(0, 0), (r, 0), (1.05 * r, height), (1.05 * r - 2, height), (r - 2, 3), (0, 3)])
    return grounded((pot, metal((0.7, 0.7, 0.7), 0.3) if rng.random() < 0.4 else matt(vivid(rng), 0.4)))


def screws(rng: np.random.Generator) -> Thing:
    """A few socket-head screws M5 and dowel pins, lying."""
    pieces = []
    finish = metal((0.1, 0.1, 0.11), 0.4) if rng.random() < 0.5 else metal((0.65, 0.64, 0.62), 0.25)
    for _ in range(int(rng.integers(3, 8))):
        length = rng.uniform(10, 30)
        screw = turned([(0, 0), (2.4, 0), (2.4, length), (4.25, length), (4.25, length + 5), (0, length + 5)], 24)
        screw = cut(screw, plate(hexagon(4), 3.5, length + 2))
        lies = translation_matrix((*rng.uniform(-28, 28, 2), 4.25)) @ rotation_matrix(rng.uniform(0, 6.3), (0, 0, 1))
        pieces.append((screw.apply_transform(lies @ rotation_matrix(np.pi / 2 + 0.06, (0, 1, 0))), finish))
    return grounded(*pieces)


def spring(rng: np.random.Generator) -> Thing:
    """Compression spring, lying."""
    r, turns = rng.uniform(5, 11), int(rng.integers(7, 14))
    angle = np.linspace(0, 2 * np.pi * turns, 24 * turns)
    path = np.column_stack([r * np.cos(angle), r * np.sin(angle), 4.0 * angle / (2 * np.pi)])
    return grounded((tube(path, rng.uniform(0.7, 1.3), 8), metal(STEEL, 0.3)), lying=True)


def o_rings(rng: np.random.Generator) -> Thing:
    """Rubber rings."""
    rings = []
    for _ in range(int(rng.integers(2, 5))):
        r = rng.uniform(7, 20)
        ring = trimesh.creation.torus(r, rng.uniform(1, 2.2), major_sections=48, minor_sections=16)
        ring.apply_translation((*rng.uniform(-40, 40, 2), -ring.bounds[0, 2]))
        rings.append((ring, matt([0.02] * 3 if rng.random() < 0.6 else [0.35, 0.05, 0.02], 0.5)))
    return grounded(*rings)


def cloth(rng: np.random.Generator, *, cells: int = 56, steps: int = 110) -> Thing:
    """Crumpled wiping cloth: a compressed sheet that fell (position-based dynamics, Müller et al. 2007)."""
    side = rng.uniform(0.2, 0.34), rng.uniform(0.16, 0.26)
    ticks = [np.linspace(-s / 2, s / 2, cells) for s in side]
    rest = np.stack([*np.meshgrid(*ticks, indexing="ij"), np.zeros((cells, cells))], axis=-1)
    bumps = gaussian_filter(rng.normal(size=(cells, cells)), rng.uniform(4, 8))
    x = rest * (rng.uniform(0.45, 0.75), rng.uniform(0.6, 0.9), 1)
    x[..., 2] = 0.06 + 0.03 * bumps / bumps.std()
    before = x.copy()
    offsets = ((1, 0), (0, 1), (1, 1), (1, -1), (2, 0), (0, 2))
    for _ in range(steps):
        x, before = x + 0.95 * (x - before) - (0, 0, 1.5e-4), x
        for _ in range(8):
            moved, count = np.zeros_like(x), np.full((cells, cells, 1), 1e-9)
            for i, j in offsets:
                a = (slice(i, None), slice(max(j, 0), cells + min(j, 0)))
                b = (slice(0, cells - i), slice(max(-j, 0), cells - max(j, 0)))
                apart = x[a] - x[b]
                distance = np.linalg.norm(apart, axis=-1, keepdims=True)
                length = np.linalg.norm(rest[a] - rest[b], axis=-1, keepdims=True)
                soft = 0.15 if max(i, j) == 2 else 0.5
                push = soft * (length / np.maximum(distance, 1e-9) - 1) * apart
                moved[a] += push
                moved[b] -= push
                count[a] += 1
                count[b] += 1
            x = x + 1.4 * moved / count
            below = x[..., 2] < 0.0012
            x[below, :2] = 0.7 * before[below, :2] + 0.3 * x[below, :2]  # friction
            x[below, 2] = 0.0012
    corner = (np.arange(cells - 1)[:, None] * cells + np.arange(cells - 1)).ravel()
    quads = np.stack([corner, corner + cells, corner + cells + 1, corner + 1], 1)
    sheet = trimesh.Trimesh(x.reshape(-1, 3), np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), process=False)
    sheet.apply_translation(-np.append(sheet.bounds.mean(axis=0)[:2], 0))
    pattern = ("weave", "checker", "weave")[rng.integers(3)]
    return [(sheet, matt(vivid(rng), 0.95, pattern, second=[0.6, 0.58, 0.55]))]


def cable(rng: np.random.Generator) -> Thing:
    """Loosely coiled cable with a plug."""
    r, loop = rng.uniform(2, 4), rng.uniform(45, 80)
    turns = rng.uniform(1.2, 3.2)
    angle = np.linspace(0, 2 * np.pi * turns, int(14 * turns))
    radius = loop * (1 + 0.08 * np.cumsum(rng.normal(size=len(angle))) / np.sqrt(np.arange(1, len(angle) + 1)))
    height = r + 1.6 * r * np.floor(angle / (2 * np.pi)) + 0.4 * r * (1 + np.sin(3 * angle))
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    out = ring[-1, :2] / np.linalg.norm(ring[-1, :2])
    along = np.array([-out[1], out[0]])
    ends = [np.append(ring[-1, :2] + s * along + t * out, r) for s, t in ((50, 10), (95, 40), (125, 85))]
    path = curve([*ring, *ends], 60 * int(2 + turns))
    path[:, 2] = np.maximum(path[:, 2], r)
    towards = path[-1] - path[-2]
    plug = trimesh.creation.box((34, 15, 11)).apply_transform(
        translation_matrix((*path[-1, :2], 5.5)) @ rotation_matrix(np.arctan2(towards[1], towards[0]), (0, 0, 1))
    )
    colour = vivid(rng)
    return grounded((tube(path, r), matt(colour, 0.45)), (plug, matt([0.02] * 3, 0.4)))


TOOLS: tuple[Callable[[np.random.Generator], Thing], ...] = (screwdriver, spanner, pliers, hex_key, caliper, marker)
GOODS: tuple[Callable[[np.random.Generator], Thing], ...] = (tape, mug, spray_can, carton, package, foam, lid)
SMALL: tuple[Callable[[np.random.Generator], Thing], ...] = (screws, spring, o_rings)
SOFT: tuple[Callable[[np.random.Generator], Thing], ...] = (cloth, cable)
