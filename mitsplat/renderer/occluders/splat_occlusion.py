"""Shadow rays through splats: a Gaussian stops a ray with a probability equal to its opacity there.

The transmittance through Gaussians of opacity a_i is T = prod_i (1 - a_i G_i), where G_i is the peak of Gaussian i
along the ray. Sampled shadow rays need no sorting: if each Gaussian independently stops a ray with probability a_i G_i,
the ray arrives with probability T (Enderton 2010, "Stochastic Transparency"). With a random number u_i in (0, 1),
Gaussian i stops the rays with a_i G_i > u_i. These are the rays that intersect its ellipsoid of sqrt(2 ln(a_i / u_i))
standard deviations. A set of numbers u_i turns all Gaussians into solids, and the first solid on a ray stops it. Each
ray selects one of several such sets at random.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.renderer.rays.device_arrays import ray_scene, wrapped

SETS = 8
"""Number of sets of solids. A Gaussian of opacity a is in about a * SETS of them."""

MIN_OCCLUDING_OPACITY = 0.01
"""Opacity below which a Gaussian stops no ray, and smallest u_i."""

FOOTPRINT = 2.0
"""Distance within which splats do not shadow their own object, in units of the 90 % quantile of their largest standard
deviations. The Gaussians of a surface scatter around it and would shadow each other.
"""

FLAT = 0.2
"""Ratio of the shortest to the second axis below which a flat section replaces the ellipsoid."""

_SQUARE = (
    np.sqrt(np.pi / 2) * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)
"""Corners and faces of the square with the area of the unit disc."""

_OCTAHEDRON = (
    np.sqrt(np.pi / np.sqrt(3)) * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]),
    np.array([(x, z, y) if (x + y + z) % 2 else (x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]),
)
"""Corners and faces of the octahedron with the surface of the unit sphere, hence with its mean projected area (Cauchy).
"""


@dataclass(frozen=True, eq=False)
class Caster:
    """Splats that occlude light.

    Attributes:
        splats: Splats in their own frame.
        instance: Instance id.
        world_from_splats: Similarity transform, shape (4, 4).
    """

    splats: Splats
    instance: int
    world_from_splats: Float64Array


@dataclass(frozen=True, eq=False)
class Solids:
    """Sets of solids in one Mitsuba scene, side by side along x.

    Attributes:
        scene: The scene, with the centre of the first set at its origin.
        middle: Centre of the splats in the world [m].
        radius: Radius around the centre [m].
        sets: Number of sets.
        owners: Caster, and number among its splats, of each triangle's Gaussian, shape (2, T).
        footprints: Distance [m] within which the splats of each caster do not shadow their own object, shape (N,).
    """

    scene: mi.Scene
    middle: mi.Point3f
    radius: mi.Float
    sets: int
    owners: npt.NDArray[np.uint32]
    footprints: Float64Array

    @classmethod
    def build(cls, casters: Sequence[Caster], sets: int = SETS) -> Solids | None:
        """Build the solids of splats; return None if no Gaussian is opaque enough."""
        rng = np.random.default_rng(0)
        corners, faces, owners, count = [], [], [], 0
        footprints = np.zeros(len(casters))
        for row, caster in enumerate(casters):
            kept = np.flatnonzero(caster.splats.opacities > MIN_OCCLUDING_OPACITY)
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
                    points = radii[those, None, None] * _rotated(shape[0], int(those.sum()), rng)
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
        shifted = [points - middle + [2 * radius * number, 0, 0] for number, points in corners]
        triangles = np.concatenate([f.reshape(-1, 3) for f in faces])
        mesh = mi.Mesh("splats", count, len(triangles))
        params = mi.traverse(mesh)
        params["vertex_positions"] = wrapped(mi.Float, np.concatenate(shifted).astype(np.float32))
        params["faces"] = wrapped(mi.UInt32, triangles.astype(np.uint32))
        params.update()
        return cls(
            ray_scene({"mesh": mesh}, watertight=False),  # sooner; solids stop rays at random anyway
            mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in middle]),
            dr.opaque(mi.Float, float(radius)),
            sets,
            np.concatenate(owners, axis=1).astype(np.uint32),
            footprints,
        )

    def enter(self, ray: mi.Ray3f, key: mi.UInt32, near: mi.Float) -> tuple[mi.Ray3f, mi.Float, mi.Bool]:
        """Transform rays into one of the sets.

        Args:
            ray: World-space rays.
            key: Integer per ray that selects the set.
            near: Smallest distance at which a ray starts [m].

        Returns:
            Rays in the set, the distances at which they start, and True where they intersect the set's ball.
        """
        number = mi.UInt32(mi.sample_tea_float32(key, mi.UInt32(self.sets), 4) * self.sets)
        # Rays are clipped to the ball of their set, so that no other set occludes them.
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
    """Splats as occluders of shadow rays.

    Attributes:
        solids: Stochastic solids that rays hit.
        skip_distance: Distance from the ray origin within which splats do not occlude [m], by instance.
    """

    solids: Solids
    skip_distance: mi.Float

    @classmethod
    def build(cls, casters: Sequence[Caster], sets: int = SETS) -> SplatOccluders | None:
        """Build the occluders of splats; return None if no Gaussian is opaque enough."""
        solids = Solids.build(casters, sets)
        if solids is None:
            return None
        skip_distance = np.zeros(1 + max(c.instance for c in casters), np.float32)
        np.maximum.at(skip_distance, [c.instance for c in casters], solids.footprints.astype(np.float32))
        return cls(solids, wrapped(mi.Float, skip_distance))

    def occluded(
        self, ray: mi.Ray3f, instance: mi.UInt32, key: mi.UInt32, active: mi.Bool, *, watertight: bool = True
    ) -> mi.Bool:
        """Return True for occluded rays from points of instances; ``key`` selects the random outcome of a ray."""
        instance = mi.UInt32(instance)
        near = dr.gather(mi.Float, self.skip_distance, instance, active & (instance < dr.width(self.skip_distance)))
        inside, _, met = self.solids.enter(ray, key, near)
        return active & met & self.solids.scene.ray_test(inside, active=active & met)


def _ellipsoids(splats: Splats, world_from_splats: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return axes (N, 3, 3) and centres (N, 3) of ellipsoids.

    The columns of the axes are as long as the standard deviations, the shortest last.
    """
    turn, shift = world_from_splats[:3, :3], world_from_splats[:3, 3]
    axes = Rotation.from_quat(splats.quats).as_matrix() * splats.scales[:, None].astype(np.float64)
    order = np.argsort(-splats.scales, axis=1)
    return turn @ np.take_along_axis(axes, order[:, None], axis=2), splats.means @ turn.T + shift


def _radii(opacities: Float64Array, sets: int, rng: np.random.Generator) -> Float64Array:
    """Return the radius of every Gaussian's solid in each set, in standard deviations, shape (sets, N).

    The radius is 0 where the Gaussian is not in the set.

    The u_i of a Gaussian are stratified over the sets, in a random order per Gaussian.
    """
    order = np.argsort(rng.random((sets, len(opacities))), axis=0)
    u = np.maximum((order + rng.random(order.shape)) / sets, MIN_OCCLUDING_OPACITY)
    return np.sqrt(2 * np.log(np.maximum(opacities / u, 1)))


def _rotated(points: Float64Array, count: int, rng: np.random.Generator) -> Float64Array:
    """Return ``count`` randomly rotated copies of a shape; flat shapes rotate in their plane.

    The rotation hides the corners of the shapes.
    """
    flat = not points[:, 2].any()
    turns = (
        Rotation.from_rotvec(rng.random((count, 1)) * [0, 0, 2 * np.pi]) if flat else Rotation.random(count, rng=rng)
    )
    return np.asarray(np.einsum("nij,kj->nki", turns.as_matrix(), points))
