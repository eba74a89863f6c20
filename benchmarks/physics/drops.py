"""Resting poses of single parts on a table: ``python -m benchmarks.physics.drops [--drops N] [--steppers S ...]``.

Warp takes several times as long as the others; ``--steppers mujoco reference`` leaves it out.

A cube, coins of several ratios of height to diameter, steel dice, and the shipped parts fall 0.05 to 0.25 m from random
poses, with both steppers and with MuJoCo's own time stepping as a reference. A part rests flat or on edge if the
symmetry axis of its inertia, or else the z axis, is within 25 degrees of the vertical or within 17 degrees of the
horizontal.

The reference shares no code with the steppers: the convex hull of the part on a plane, which is exact on a table, with
steps of 0.5 ms and a damping ratio for the restitution (Nagurka and Huang, 2004, "A Mass-Spring-Damper Model of a
Bouncing Ball"). It does not wait for rest.

Published values: a coin that does not rebound and falls in a random pose rests on edge with the probability
h / sqrt(h^2 + d^2) (Yong and Mahadevan, 2011, "Probability, geometry, and dynamics in the toss of a thick coin"). With
rebounds, thin coins do so more rarely: an American nickel (h/d = 0.09) in one of about 6000 tosses (Murray and Teare,
1993, "Probability of a tossed coin landing on edge"), and a coin of h/d = 1 in half of the tosses (Hernández-Navarro
and Piñero, 2022, "Exact face-landing probabilities for bouncing objects").

Dice have two square faces of 15 mm and a height of ``die RATIO`` times that. They rest flat on a square face, and on
edge on one of the four others. Students rolled such dice, cut from a steel bar (Mungan and Lipscombe, 2013,
"Probability analysis for rolls of a square cuboidal die", table 1). The surface and other conditions change the shares
(Riemer, Stoyan and Obreschkow, 2013, "Cuboidal dice and Gibbs distributions").

The formula of Yong and Mahadevan is the solid angle of the edge, as seen from the centre of mass. By the same argument,
a hex nut that does not rebound rests on a side with the probability of the solid angle of its sides. Those of its
chamfers may end flat or on a side.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import trimesh
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest, chi2_contingency, chisquare

from benchmarks.record import figure, recording
from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.geometry.mesh import MassProperties, mass_properties
from mitsplat.physics.settle import warp_settings

if TYPE_CHECKING:
    from mitsplat.physics.worlds import World

ASSETS = Path(__file__).resolve().parents[2] / "scenes/assets"
STEPPERS = ("warp", "mujoco", "reference")
RATIOS = (0.09, 0.2, 0.35, 0.5, 0.75, 1.0)
PUBLISHED = {0.09: (1 / 6000, "Murray and Teare"), 1.0: (0.5, "Hernández-Navarro and Piñero")}  # with rebounds
DICE = {0.47: (0.916, 332), 0.63: (0.738, 840), 0.81: (0.496, 740), 1.16: (0.148, 1011), 1.55: (0.040, 606)}
"""Published shares of rolls that end on a square face, and their numbers, by the height over the side of the square."""
DIAMETER, DIE_SIDE = 0.025, 0.015
BATCH = 20
CHUNK = 5  # batches that a process makes with one simulation
SPACING = 0.5
TIMESTEP, MAX_TIME = 0.002, 8.0
REFERENCE_STEP, REFERENCE_TIME, CONTACT_TIME = 0.0005, 3.0, 0.003
FRICTION, TABLE_FRICTION = 0.35, 0.5
FLAT, EDGE = 0.9, 0.3  # smallest and largest cosine of the angle between the axis and the vertical


@dataclass(frozen=True)
class Batch:
    """Drops of one part in one simulation."""

    part: str
    stepper: str
    restitution: float
    number: int


@dataclass(frozen=True, eq=False)
class Part:
    """A part with its mesh and convex pieces, and the local axis that tells flat from on edge."""

    mesh: trimesh.Trimesh
    pieces: tuple[trimesh.Trimesh, ...]
    mass: MassProperties
    axis: Float64Array


def part_names() -> list[str]:
    """Return the names of the cube, the coins, the dice, and the shipped parts."""
    shipped = sorted(path.name for path in ASSETS.iterdir() if (path / "pieces.ply").exists())
    return ["cube", *(f"coin {ratio:g}" for ratio in RATIOS), *(f"die {ratio:g}" for ratio in DICE), *shipped]


def make_part(name: str) -> Part:
    kind, _, ratio = name.partition(" ")
    if kind in ("cube", "coin", "die"):
        if kind == "cube":
            mesh = trimesh.creation.box((0.02, 0.02, 0.02))
        elif kind == "die":
            mesh = trimesh.creation.box((DIE_SIDE, DIE_SIDE, float(ratio) * DIE_SIDE))
        else:
            mesh = trimesh.creation.cylinder(radius=DIAMETER / 2, height=float(ratio) * DIAMETER, sections=128)
        return Part(mesh, (mesh,), mass_properties(mesh, (mesh,), density=7850.0), np.array([0.0, 0.0, 1.0]))
    asset = Asset.load(ASSETS / name)
    if asset.mesh is None:
        raise ValueError(f"asset {name!r} must have a mesh (got none)")
    mass = mass_properties(asset.mesh, asset.pieces, density=asset.density)
    moments, axes = np.linalg.eigh(mass.inertia)
    gaps = np.diff(moments)
    round_part = gaps.min() < 0.01 * moments.max()
    axis = axes[:, 2 if gaps[1] > gaps[0] else 0] if round_part else np.array([0.0, 0.0, 1.0])
    return Part(asset.mesh, asset.pieces, mass, axis)


def draw_starts(batch: Batch) -> Float64Array:
    """Draw initial poses (20, 4, 4); they are the same for all steppers."""
    rng = np.random.default_rng([*batch.part.encode(), batch.number])
    poses = np.tile(np.eye(4), (BATCH, 1, 1))
    poses[:, :3, :3] = Rotation.random(BATCH, random_state=rng).as_matrix()
    poses[:, :2, 3] = SPACING * np.transpose(np.divmod(np.arange(BATCH), 5))
    poses[:, 2, 3] = rng.uniform(0.05, 0.25, BATCH)
    return poses


def drop_batch(batch: Batch) -> tuple[Batch, Float64Array, Float64Array, float, int]:
    """Drop the bodies of a batch.

    Returns:
        The batch, the upward components of the bodies' axes (20, 3), the heights of the lowest points of their meshes
        above the table (20,) [m], CPU seconds, and the number of bodies that moved.
    """
    start = time.process_time()
    with warp_settings():
        poses, moving = (drop_reference if batch.stepper == "reference" else drop_bodies)(batch)
    seconds = time.process_time() - start
    heights = (poses[:, 2, :3] @ make_part(batch.part).mesh.vertices.T).min(axis=1) + poses[:, 2, 3]
    return batch, poses[:, 2, :3], heights, seconds, moving


@lru_cache(maxsize=1)
def make_world(part_name: str, stepper: str, restitution: float) -> World:
    from mitsplat.physics.bodies import Body, Collider
    from mitsplat.physics.friction import ContactMaterial
    from mitsplat.physics.mujoco_world import MujocoWorld
    from mitsplat.physics.warp_world import WarpWorld

    part, place = make_part(part_name), np.eye(4)
    place[2, 3] = -0.05
    bodies = [Body(part.pieces, part.mass, ContactMaterial(FRICTION, restitution))] * BATCH
    table = Collider(ContactMaterial(TABLE_FRICTION, restitution), box=((20.0, 20.0, 0.1), place))
    if stepper == "mujoco":
        return MujocoWorld(bodies, [table], timestep=TIMESTEP)
    return WarpWorld(bodies, [table], timestep=TIMESTEP, capacity=2.0)


def drop_bodies(batch: Batch) -> tuple[Float64Array, int]:
    from mitsplat.physics.rest import FREE_TIME, run_to_rest

    world = make_world(batch.part, batch.stepper, batch.restitution)
    world.reset(draw_starts(batch))
    outcome = run_to_rest(world, max_time=MAX_TIME, bounds=(np.full(3, -50.0), np.full(3, 50.0)), free_time=FREE_TIME)
    return outcome.poses, len(outcome.causes)


def damping_ratio(restitution: float) -> float:
    """Return the damping ratio sin(b) of a contact with the restitution exp(-tan(b) (pi - 2 b))."""
    if restitution == 0:
        return 1.0
    angle = brentq(lambda b: np.exp(-np.tan(b) * (np.pi - 2 * b)) - restitution, 0.0, np.pi / 2 - 1e-9)
    return float(np.sin(angle))


def drop_reference(batch: Batch) -> tuple[Float64Array, int]:
    part, starts = make_part(batch.part), draw_starts(batch)
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.impratio = REFERENCE_STEP, 100.0
    spec.option.cone, spec.option.integrator = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    hull = trimesh.convex.convex_hull(np.concatenate([piece.vertices for piece in part.pieces]))
    spec.add_mesh(name="hull", uservert=hull.vertices.ravel(), userface=hull.faces.ravel())
    contact = {
        "condim": 4,
        "friction": [np.sqrt(FRICTION * TABLE_FRICTION), 1e-4, 0.0],
        "solref": [CONTACT_TIME, damping_ratio(batch.restitution)],
        "solimp": [0.99, 0.999, 0.001, 0.5, 2.0],
    }
    plane = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[50, 50, 1], **contact)
    plane.contype, plane.conaffinity = 0, 1
    moments = part.mass.inertia
    for _ in starts:
        body = spec.worldbody.add_body(
            mass=part.mass.mass,
            ipos=part.mass.centre,
            fullinertia=[*np.diag(moments), moments[0, 1], moments[0, 2], moments[1, 2]],
            explicitinertial=True,
        )
        body.add_freejoint()
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull", **contact)
        geom.contype, geom.conaffinity = 1, 0
    model = spec.compile()
    data = mujoco.MjData(model)
    # MuJoCo moves a mesh into its principal frame, but keeps the body's.
    coordinates = data.qpos.reshape(-1, 7)
    coordinates[:, :3] = starts[:, :3, 3]
    coordinates[:, 3:] = Rotation.from_matrix(starts[:, :3, :3]).as_quat(scalar_first=True)
    mujoco.mj_step(model, data, nstep=round(REFERENCE_TIME / REFERENCE_STEP))
    found = np.tile(np.eye(4), (BATCH, 1, 1))
    found[:, :3, :3] = Rotation.from_quat(coordinates[:, 3:], scalar_first=True).as_matrix()
    found[:, :3, 3] = coordinates[:, :3]
    return found, int((np.abs(data.qvel.reshape(-1, 6)[:, :3]).max(axis=1) > 0.05).sum())


def solid_angles(part: Part) -> tuple[float, float]:
    """Return the shares of the full solid angle that flat faces and edges of a part's hull take, seen from its centre.

    A flat face or an edge has a normal as close to the axis, or to its plane, as a part that rests flat or on edge.
    The solid angle of a triangle is that of van Oosterom and Strackee (1983, "The solid angle of a plane triangle").
    """
    hull = part.mesh.convex_hull
    a, b, c = np.moveaxis(hull.triangles - part.mass.centre, 1, 0)
    x, y, z = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volumes = np.einsum("ni,ni->n", a, np.cross(b, c))
    dots = (np.einsum("ni,ni->n", *pair) for pair in ((b, c), (a, c), (a, b)))
    angles = 2 * np.arctan2(volumes, x * y * z + sum(dot * length for dot, length in zip(dots, (x, y, z), strict=True)))
    along = np.abs(hull.face_normals @ part.axis)
    flat, edge = (float(angles[chosen].sum() / angles.sum()) for chosen in (along > FLAT, along < EDGE))
    return flat, edge


def batches_of(names: Sequence[str], steppers: Sequence[str], drops: int, restitution: float) -> Iterator[Batch]:
    for part in names:
        for stepper in steppers:
            for number in range(-(-drops // BATCH)):
                yield Batch(part, stepper, restitution, number)


def show(
    name: str,
    up: dict[str, Float64Array],
    heights: dict[str, Float64Array],
    seconds: dict[str, float],
    moving: dict[str, int],
) -> None:
    """Print and record the shares of one part with each stepper of ``up``."""
    axis, table = make_part(name).axis, {}
    for stepper in up:
        along = np.abs(up[stepper] @ axis)
        flat, edge, count = int((along > FLAT).sum()), int((along < EDGE).sum()), len(along)
        interval = binomtest(edge, count).proportion_ci(method="wilson")
        table[stepper] = [flat, edge, count - flat - edge]
        each = seconds[stepper] / count
        text = f"{name:18} {stepper:9} flat {flat / count:7.2%}  on edge {edge / count:7.2%}"
        text += f" ({interval.low:.2%} to {interval.high:.2%})  other {1 - (flat + edge) / count:7.2%}"
        for value, unit, what in (
            (count, "", "drops"),
            (flat / count, "", "flat"),
            (edge / count, "", "edge"),
            ((interval.low, interval.high), "", "edge interval"),
            (moving[stepper], "", "moving"),
            ((1e3 * heights[stepper].min(), 1e3 * heights[stepper].max()), "mm", "heights of meshes"),
            (each, "s", "cpu"),
        ):
            figure(value, unit, name, stepper, what)
        if name == "cube":
            faces = np.argmax(np.concatenate([up[stepper], -up[stepper]], axis=1), axis=1)
            counts = np.bincount(faces, minlength=6)
            figure(chisquare(counts).pvalue, "", name, stepper, "p of equal faces")
            text += f"  faces {counts.tolist()}, p = {chisquare(counts).pvalue:.3f}"
        text += f"  mesh {1e3 * heights[stepper].min():.3f} to {1e3 * heights[stepper].max():.3f} mm above the table"
        print(f"{text}  moving {moving[stepper]}  {each:.3f} CPU s", flush=True)
    for first, second in combinations(up, 2):
        rows = np.array([table[first], table[second]])
        rows = rows[:, rows.any(axis=0)]
        p = chi2_contingency(rows).pvalue if rows.shape[1] > 1 else 1.0
        figure(p, "", name, "p", first, second)
    if name.startswith("hex_nut"):
        flat_share, side_share = solid_angles(make_part(name))
        figure((side_share, 1 - flat_share), "", name, "edge without rebound")
        print(
            f"{name:18} by solid angle on a side: {side_share:.2%} to {1 - flat_share:.2%} without rebound", flush=True
        )
    if name.startswith("die"):
        share, rolls = DICE[float(name.split()[1])]
        published = binomtest(round(share * rolls), rolls).proportion_ci(method="wilson")
        figure((published.low, published.high), "", name, "published flat")
        print(f"{name:18} published flat: {published.low:.2%} to {published.high:.2%} of {rolls} rolls", flush=True)
    if name.startswith("coin"):
        ratio = float(name.split()[1])
        expected = ratio / np.hypot(ratio, 1)
        figure(expected, "", name, "edge without rebound")
        text = f"{name:18} published on edge: {expected:.2%} without rebound (Yong and Mahadevan)"
        if ratio in PUBLISHED:
            share, authors = PUBLISHED[ratio]
            text += f", {share:.2%} with rebounds ({authors})"
        print(text, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"all by default: {', '.join(part_names())}")
    parser.add_argument("--drops", type=int, default=200, help="drops of each part with each stepper")
    parser.add_argument("--steppers", nargs="+", choices=STEPPERS, default=list(STEPPERS))
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--restitution", type=float, default=0.5, help="of parts and table")
    arguments = parser.parse_args()
    names = arguments.parts or part_names()
    up: dict[tuple[str, str], list[Float64Array]] = defaultdict(list)
    heights: dict[tuple[str, str], list[Float64Array]] = defaultdict(list)
    seconds: dict[tuple[str, str], float] = defaultdict(float)
    moving: dict[tuple[str, str], int] = defaultdict(int)
    with recording("physics.drops", parser, arguments, ignore=("processes",)):
        drop_batch(Batch(names[0], arguments.steppers[0], arguments.restitution, 0))  # compiles the kernels once
        with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
            batches = batches_of(names, arguments.steppers, arguments.drops, arguments.restitution)
            for batch, found, above, spent, moved in pool.map(drop_batch, batches, chunksize=CHUNK):
                key = batch.part, batch.stepper
                up[key].append(found)
                heights[key].append(above)
                seconds[key] += spent
                moving[key] += moved
        for name in names:
            show(
                name,
                {stepper: np.concatenate(up[name, stepper]) for stepper in arguments.steppers},
                {stepper: np.concatenate(heights[name, stepper]) for stepper in arguments.steppers},
                {stepper: seconds[name, stepper] for stepper in arguments.steppers},
                {stepper: moving[name, stepper] for stepper in arguments.steppers},
            )


if __name__ == "__main__":
    main()
