"""Helpers of physics tests: bodies, their simulation, poses, and extents of placed meshes."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mitsplat.geometry.mesh import mass_properties

STEPPERS = ("warp", "mujoco")
GRAVITY = 9.81
EVERYWHERE = np.full(3, -1e3), np.full(3, 1e3)
"""Bounds that no body reaches [m]."""


def pose_at(position: ArrayLike, rotation: Rotation | None = None) -> NDArray[np.float64]:
    """Build a rigid transform, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, 3] = position
    if rotation is not None:
        pose[:3, :3] = rotation.as_matrix()
    return pose


def draw_start_poses(drop, assets, rng, arrangement="drop"):
    """Draw start poses (N, 4, 4) of assets in the only region of a scene."""
    items = [drop.start_poses.item(asset) for asset in assets]
    return drop.start_poses.draw(items, drop.static_scenes[0], rng, [arrangement])


def lowest(mesh: trimesh.Trimesh, pose: NDArray[np.float64]) -> float:
    """Return the height of a placed mesh's lowest vertex [m]."""
    return float((mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2].min())


def scanned_box(size=(0.12, 0.16, 0.04), *, dent=3e-4, noise=1e-4, points=6000, seed=0):
    """Return the convex hull of noisy points on a box, whose sides are dented [m]: as the scan of a package."""
    box = trimesh.creation.box(size)
    places, faces = trimesh.sample.sample_surface(box, points, seed=seed)
    normals = box.face_normals[faces]
    depths = dent * np.prod(np.where(normals == 0, 1 - (2 * places / size) ** 2, 1.0), axis=1)
    heights = np.random.default_rng(seed).normal(0, noise, points) - depths
    return trimesh.convex.convex_hull(places + normals * heights[:, None])


def body_of(*pieces, density=3000.0, **material):
    """Return a body of convex pieces with a contact material."""
    from mitsplat.physics.bodies import Body
    from mitsplat.physics.friction import ContactMaterial

    mass = mass_properties(trimesh.util.concatenate(list(pieces)), pieces, density=density)
    return Body(pieces, mass, ContactMaterial(**material))


def table(pose=None, size=1.0, **material):
    """Return a box with a square top [m] in the plane z = 0 of its pose."""
    from mitsplat.physics.bodies import Collider
    from mitsplat.physics.friction import ContactMaterial

    top_from_box = trimesh.transformations.translation_matrix((0, 0, -0.05))
    return Collider(
        ContactMaterial(**material), box=((size, size, 0.1), (np.eye(4) if pose is None else pose) @ top_from_box)
    )


def world_of(stepper, bodies, colliders, poses, *, timestep=0.002, capacity=1.0):
    """Return the simulation of bodies at their poses."""
    from mitsplat.physics.mujoco_world import MujocoWorld
    from mitsplat.physics.warp_world import WarpWorld

    if stepper == "mujoco":
        world = MujocoWorld(bodies, colliders, timestep=timestep)
    else:
        world = WarpWorld(bodies, colliders, timestep=timestep, capacity=capacity)
    world.reset(np.stack(poses))
    return world


def run_until(world, time):
    """Advance a world to a simulated time [s]."""
    while world.time < time - 1e-9:
        world.advance()


def centres(world):
    """Return the centres of mass [m], shape (N, 3)."""
    return np.array([(pose @ [*body.mass.centre, 1])[:3] for body, pose in zip(world.bodies, world.poses, strict=True)])


def energy(world):
    """Return the kinetic and potential energy of the bodies [J]."""
    total = 0.0
    for body, pose, centre, (speed, spin) in zip(
        world.bodies, world.poses, centres(world), world.velocities, strict=True
    ):
        inertia = pose[:3, :3] @ body.mass.inertia @ pose[:3, :3].T
        total += body.mass.mass * (GRAVITY * centre[2] + speed @ speed / 2) + spin @ inertia @ spin / 2
    return total
