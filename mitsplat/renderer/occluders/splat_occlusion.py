"""Shadow rays through splats: Gaussians that stop a ray with the chance of their opacity there.

What reaches a point through Gaussians of opacity a_i is T = prod_i (1 - a_i G_i), with G_i the peak of Gaussian i along
the ray. Sorting them is not needed where shadow rays are sampled anyway: a ray that each Gaussian stops with chance
a_i G_i, all independent, arrives with chance T (Enderton 2010, "Stochastic Transparency"). Gaussian i with a number u_i
in (0, 1) stops those rays for which a_i G_i > u_i, which are the ones that meet its ellipsoid of sqrt(2 ln(a_i / u_i))
standard deviations. A set of numbers makes solids of all Gaussians, and the first of them that a ray meets ends it. A
ray takes one of several such sets by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.renderer.rays.device_arrays import ray_scene, wrapped

SETS = 8
"""Sets of solids. Each Gaussian is in as many of them as its opacity says, to one."""

FAINTEST = 0.01
"""Opacity below which a Gaussian stops no ray, and least u_i."""

FOOTPRINT = 2.0
"""Distance within which splats do not shadow their own object, over the largest standard deviation that nine of ten of
them do not exceed: the Gaussians of a surface scatter about it, and would shadow each other."""

FLAT = 0.2
"""Shortest over second axis below which an ellipsoid stands for its middle section."""

_SQUARE = (
    np.sqrt(np.pi / 2) * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)
"""Corners and faces of the square that has the area of the unit disc."""

_OCTAHEDRON = (
    np.sqrt(np.pi / np.sqrt(3)) * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]),
    np.array([(x, z, y) if (x + y + z) % 2 else (x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]),
)
"""The same for the octahedron that has the unit sphere's surface, and so its mean projected area (Cauchy)."""


@dataclass(frozen=True, eq=False)
class Caster:
    """Splats that stand in the light.

    Attributes:
        splats: In their own frame.
        instance: Instance id.
        world_from_splats: Similarity transform, shape (4, 4).
    """

    splats: Splats
    instance: int
    world_from_splats: Float64Array


@dataclass(frozen=True, eq=False)
class Solids:
    """Sets of solids that rays may be stopped by, all in one Mitsuba scene, beside each other along x.

    Attributes:
        scene: The scene, with the middle of the first set in its origin.
        middle: Middle of the splats in the world [m].
        radius: Radius around it [m].
        sets: Number of sets.
        owners: Caster, and number among its splats, of the Gaussian that every triangle stands for, shape (2, T).
        footprints: Distance [m] within which the splats of each caster do not shadow their own object, shape (N,).
    """

    scene: Any
    middle: Any
    radius: Any
    sets: int
    owners: npt.NDArray[np.uint32]
    footprints: Float64Array

    @classmethod
    def build(cls, casters: Sequence[Caster], sets: int = SETS) -> Solids | None:
        """Solids of some splats; None if nothing in them is opaque enough."""
        rng = np.random.default_rng(0)
        corners, faces, owners, count = [], [], [], 0
        footprints = np.zeros(len(casters))
        for row, caster in enumerate(casters):
            kept = np.flatnonzero(caster.splats.opacities > FAINTEST)
            if not len(kept):
                continue
            splats = caster.splats.select(kept)
            axes, centres = _ellipsoids(splats, caster.world_from_splats)
            lengths = np.linalg.norm(axes, axis=1)
            footprints[row] = FOOTPRINT * np.quantile(lengths[:, 0], 0.9)
            flat = lengths[:, 2] < FLAT * lengths[:, 1]
            for number, radii in enumerate(_radii(splats.opacities.astype(np.float64), sets, rng)):
                for those, shape in ((flat & (radii > 0), _SQUARE), (~flat & (radii > 0), _OCTAHEDRON)):
                    if not those.any():
                        continue
                    points = radii[those, None, None] * _turned(shape[0], int(those.sum()), rng)
                    points = np.einsum("nij,nkj->nki", axes[those], points) + centres[those, None]
                    corners.append((number, points.reshape(-1, 3)))
                    faces.append(shape[1] + len(shape[0]) * np.arange(len(points))[:, None, None] + count)
                    gaussians = np.repeat(kept[those], len(shape[1]))
                    owners.append(np.stack([np.full_like(gaussians, row), gaussians]))
                    count += points.size // 3
        if not count:
            return None
        everything = np.concatenate([points for _, points in corners])
        middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
        radius = 1.001 * np.linalg.norm(everything - middle, axis=1).max()
        beside = [points - middle + [2 * radius * number, 0, 0] for number, points in corners]
        triangles = np.concatenate([f.reshape(-1, 3) for f in faces])
        mesh = mi.Mesh("splats", count, len(triangles))
        params = mi.traverse(mesh)
        params["vertex_positions"] = wrapped(mi.Float, np.concatenate(beside).astype(np.float32))
        params["faces"] = wrapped(mi.UInt32, triangles.astype(np.uint32))
        params.update()
        return cls(
            ray_scene({"mesh": mesh}),
            mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in middle]),
            dr.opaque(mi.Float, float(radius)),
            sets,
            np.concatenate(owners, axis=1).astype(np.uint32),
            footprints,
        )

    def enter(self, ray: Any, key: Any, near: Any) -> tuple[Any, Any, Any]:
        """Rays as one of the sets sees them, how far on they start, and whether they meet its ball.

        Each takes the set that its ``key`` decides, and starts ``near`` [m] on or later.
        """
        number = mi.UInt32(mi.sample_tea_float32(key, mi.UInt32(self.sets), 4) * self.sets)
        # Only what lies in the ball around its own set may stop a ray.
        start = ray.o - self.middle
        along = dr.dot(start, ray.d)
        half = dr.square(along) - dr.squared_norm(start) + dr.square(self.radius)
        reach = dr.sqrt(dr.maximum(half, 0))
        near, far = dr.maximum(near, -along - reach), dr.minimum(ray.maxt, reach - along)
        inside = mi.Ray3f(start + ray.d * near + mi.Vector3f(2 * self.radius * mi.Float(number), 0, 0), ray.d)
        inside.maxt = dr.maximum(far - near, 0)
        return inside, near, (half > 0) & (far > near)


@dataclass(frozen=True, eq=False)
class SplatOccluders:
    """Splats that shadow rays may be stopped by.

    Attributes:
        solids: What they are to a ray.
        spared: By instance, how far a ray goes before splats may stop it [m].
    """

    solids: Solids
    spared: Any

    @classmethod
    def build(cls, casters: Sequence[Caster], sets: int = SETS) -> SplatOccluders | None:
        """Occluders of some splats; None if nothing in them is opaque enough."""
        solids = Solids.build(casters, sets)
        if solids is None:
            return None
        spared = np.zeros(1 + max(c.instance for c in casters), np.float32)
        np.maximum.at(spared, [c.instance for c in casters], solids.footprints.astype(np.float32))
        return cls(solids, wrapped(mi.Float, spared))

    def stop(self, ray: Any, instance: Any, key: Any, active: Any) -> Any:
        """Whether rays from points of some instances are stopped; a ``key`` per ray decides by chance."""
        instance = mi.UInt32(instance)
        near = dr.gather(mi.Float, self.spared, instance, active & (instance < dr.width(self.spared)))
        inside, _, met = self.solids.enter(ray, key, near)
        return active & met & self.solids.scene.ray_test(inside, active=active & met)


def _ellipsoids(splats: Splats, world_from_splats: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Axes (N, 3, 3), the columns as long as the standard deviations and the shortest last, and centres (N, 3)."""
    turn, shift = world_from_splats[:3, :3], world_from_splats[:3, 3]
    axes = Rotation.from_quat(splats.quats).as_matrix() * splats.scales[:, None].astype(np.float64)
    order = np.argsort(-splats.scales, axis=1)
    return turn @ np.take_along_axis(axes, order[:, None], axis=2), splats.means @ turn.T + shift


def _radii(opacities: Float64Array, sets: int, rng: np.random.Generator) -> Float64Array:
    """Standard deviations (sets, N) of every Gaussian's solid in each set, 0 where it is not in it.

    The u_i of a Gaussian are stratified over the sets, in an order of its own.
    """
    order = np.argsort(rng.random((sets, len(opacities))), axis=0)
    u = np.maximum((order + rng.random(order.shape)) / sets, FAINTEST)
    return np.sqrt(2 * np.log(np.maximum(opacities / u, 1)))


def _turned(points: Float64Array, count: int, rng: np.random.Generator) -> Float64Array:
    """``count`` copies of a shape, each turned at random: in its plane if it is flat, so that none has corners."""
    flat = not points[:, 2].any()
    turns = (
        Rotation.from_rotvec(rng.random((count, 1)) * [0, 0, 2 * np.pi]) if flat else Rotation.random(count, rng=rng)
    )
    return np.asarray(np.einsum("nij,kj->nki", turns.as_matrix(), points))
