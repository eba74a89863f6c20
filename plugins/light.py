"""Traced light on splats: irradiance with and without the dynamic occluders, and a highlight.

A splat stores what the camera saw, shadows included. Rendering it among new objects therefore needs no light transport
from scratch but a factor per visible point x with normal n,

    captured under the scene's light:   ratio = E(x, n | static and dynamic occluders) / E(x, n | static occluders)
    captured under uniform light:       ratio = E(x, n | static and dynamic occluders) / E_ref

with irradiance E = integral of V(x, w) L(w) max(0, n.w) dw over all emitters. The first is exactly 1 where no dynamic
object takes light away, so shadows that were captured are not applied twice. E_ref is the irradiance of an unoccluded
horizontal surface at the scene's reference point: an object taken in a light tent keeps its colours there, and is
darker where less light arrives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.plugins.rays import View

BLOCK = 8
"""Pixels of a BLOCK x BLOCK neighbourhood take consecutive points of one low-discrepancy sequence, so that the filter
that follows averages a stratified set."""

R2 = (0.7548776662466927, 0.5698402909980532)
"""Additive recurrence of the two-dimensional golden ratio (Roberts 2018, "The unreasonable effectiveness of quasirandom
sequences")."""

NOISE_LIMIT = 6.0
"""Squared standard deviations within which two neighbours' shadows may be averaged."""

GUESS_WEIGHT = 1e-3
"""How much a point counts that is not known to lie on a surface, beside ones that are."""

OPEN_LATTICE = (377, 233)
"""Points and generator of the Fibonacci lattice that integrates light without occluders: consecutive Fibonacci numbers
give the best two-dimensional lattices (Niederreiter 1992, section 5.3), here within 0.5 % for two lights."""

REFERENCE_LATTICE = (4181, 2584)


@dataclass(frozen=True, eq=False)
class Occluder:
    """A proxy surface in world space.

    Attributes:
        mesh: Surface [m].
        instance: Instance id, 0 for the environment.
        dynamic: Whether its shadow is missing in what was captured.
    """

    mesh: trimesh.Trimesh
    instance: int
    dynamic: bool


class Proxies:
    """Ray-traceable proxy surfaces: one scene of the static and one of the dynamic ones."""

    def __init__(self, occluders: Sequence[Occluder], visible: Sequence[Any] = ()) -> None:
        """Proxies from meshes, and visible Mitsuba shapes, which are static."""
        self.static = _TraceScene.build([o for o in occluders if not o.dynamic], visible)
        self.dynamic = _TraceScene.build([o for o in occluders if o.dynamic])

    def nearest(self, ray: Any) -> tuple[Hit, Hit]:
        """What rays meet first, and what they would meet without the dynamic proxies."""
        static = _TraceScene.nearest(self.static, ray, Hit.nothing())
        return _TraceScene.nearest(self.dynamic, ray, static), static


@dataclass(frozen=True, eq=False)
class Hit:
    """Where rays meet a proxy.

    Attributes:
        distance: Along the ray [m], infinite for a miss.
        normal: Unit normal towards the ray's origin.
        instance: Instance id, 0 for a miss.
    """

    distance: Any
    normal: Any
    instance: Any

    @classmethod
    def nothing(cls) -> Hit:
        """A miss."""
        return cls(mi.Float(dr.inf), mi.Normal3f(0), mi.UInt32(0))


@dataclass(frozen=True, eq=False)
class _TraceScene:
    """All meshes as one (or None), with the instance id of every triangle, beside visible shapes."""

    scene: Any
    mesh: Any
    instances: Any

    def nearest(self: _TraceScene | None, ray: Any, other: Hit) -> Hit:
        """The nearer of ``other`` and what the rays meet here."""
        if self is None:
            return other
        si = self.scene.ray_intersect(ray)
        closer = si.t < other.distance
        facing = dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n)
        proxy = closer & (si.shape == self.mesh) if self.mesh is not None else mi.Bool(False)
        number = dr.gather(mi.UInt32, self.instances, si.prim_index, proxy)
        return Hit(
            dr.select(closer, si.t, other.distance),
            dr.select(closer, facing, other.normal),
            dr.select(closer, number, other.instance),
        )

    @classmethod
    def build(cls, occluders: Sequence[Occluder], visible: Sequence[Any] = ()) -> _TraceScene | None:
        others = {f"visible_{i}": shape for i, shape in enumerate(visible)}
        occluders = [o for o in occluders if len(o.mesh.faces)]
        if not occluders:
            nothing = mi.UInt32([0])
            return cls(mi.load_dict({"type": "scene", **others}), None, nothing) if others else None
        vertices, faces = trimesh.util.append_faces(
            [o.mesh.vertices for o in occluders], [o.mesh.faces for o in occluders]
        )
        mesh = mi.Mesh("proxies", len(vertices), len(faces))
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(np.asarray(vertices, dtype=np.float32).ravel())
        params["faces"] = mi.UInt32(np.asarray(faces, dtype=np.uint32).ravel())
        params.update()
        instances = np.repeat([o.instance for o in occluders], [len(o.mesh.faces) for o in occluders])
        scene = mi.load_dict({"type": "scene", "mesh": mesh, **others})
        return cls(scene, mi.ShapePtr(mesh), mi.UInt32(instances.astype(np.uint32)))


@dataclass(eq=False)
class Surface:
    """Visible points of all pixels, flat and row-major.

    Attributes:
        position, normal: Point [m] and unit normal towards the camera.
        to_camera: Unit vector towards the camera.
        offset: How far shadow rays start off the surface [m].
        relit: Whether the point is lit anew (uniform capture) rather than only shadowed.
        roughness, specular: GGX roughness and reflectance at normal incidence.
        known: Whether the proxy of what is seen says so; else position and normal are a guess.
        valid: Whether there is a point at all.
    """

    position: Any
    normal: Any
    to_camera: Any
    offset: Any
    relit: Any
    roughness: Any
    specular: Any
    known: Any
    valid: Any


def light_factor(
    scene: Any, proxies: Proxies, surface: Surface, group: Any, view: View, *, samples: int, seed: int, reference: Any
) -> tuple[Any, Any]:
    """Light factor and highlight (Color3f) of every visible point, see the module docstring.

    Sums over rays are averaged over neighbours before they are divided, so that points with little light do not turn
    black by chance. A relit point takes its irradiance without occluders from one fixed set of directions, which has no
    noise, and only the share that arrives from its rays.

    Args:
        scene: Mitsuba scene whose emitters give the light.
        proxies: What can stand in its way.
        surface: Visible points of an image.
        group: Instance id per pixel; light is not averaged across its borders.
        view: Camera.
        samples: Shadow rays per pixel.
        seed: Offset into the low-discrepancy sequence.
        reference: Irradiance (Color3f) that a uniformly captured object's colours stand for.
    """
    lit, base, shine, squares = _trace_light(scene, proxies, surface, view.width, samples=samples, seed=seed)
    lit, base, shine = _smooth_light(lit, base, shine, squares, surface, group, view)
    share = dr.select(base > 0, lit / base, 1)
    factor = dr.select(surface.relit, share * _open_irradiance(scene, surface) / reference, share)
    return dr.select(surface.valid, factor, 1), shine * (dr.pi / (samples * reference))


def _trace_light(
    scene: Any, proxies: Proxies, surface: Surface, width: int, *, samples: int, seed: int
) -> tuple[Any, Any, Any, Any]:
    """Sums over shadow rays: light that arrives, light to compare with, highlight; and squares of the second."""
    count = dr.width(surface.valid)
    pixel = dr.arange(mi.UInt32, count)
    x, y = pixel % width, pixel // width
    start = dr.opaque(mi.UInt32, seed * samples * BLOCK * BLOCK % (1 << 20)) + _bayer(x, y)
    si = _receiver(surface.position, surface.normal)
    origin = dr.fma(surface.normal, surface.offset, surface.position)
    alpha2 = dr.square(dr.square(surface.roughness))
    cos_camera = dr.maximum(dr.dot(surface.normal, surface.to_camera), 1e-3)

    def body(i: Any, lit: Any, base: Any, shine: Any, squares: Any) -> tuple[Any, Any, Any, Any, Any]:
        index = mi.Float((start + i * (BLOCK * BLOCK)) & 0xFFFFF) + 1.0
        point = mi.Point2f(*[index * step - dr.floor(index * step) for step in R2])
        sample, radiance = scene.sample_emitter_direction(si, point, False, surface.valid)
        cosine = dr.dot(surface.normal, sample.d)
        active = surface.valid & (cosine > 0) & (sample.pdf > 0)
        ray = mi.Ray3f(origin, sample.d)
        # The distance to a light at infinity comes from the extent of visible meshes, which proxies are not part of.
        infinite = mi.has_flag(sample.emitter.flags(), mi.EmitterFlags.Infinite)
        ray.maxt = dr.select(infinite, dr.inf, dr.maximum(sample.dist - 2 * surface.offset, 0))
        blocked = mi.Bool(False)
        if proxies.static is not None:
            blocked = proxies.static.scene.ray_test(ray, active=active)
        open_light = dr.select(active, radiance * cosine, 0)
        static_light = dr.select(blocked, 0, open_light)
        shadowed = mi.Bool(False)
        if proxies.dynamic is not None:
            shadowed = proxies.dynamic.scene.ray_test(ray, active=active & ~blocked)
        light = dr.select(shadowed, 0, static_light)
        compared = dr.select(surface.relit, open_light, static_light)
        lit += light
        base += compared
        shine += light * _ggx(surface, sample.d, cosine, cos_camera, alpha2)
        squares += dr.square(dr.sum(compared))
        return i + 1, lit, base, shine, squares

    rounds = dr.opaque(mi.UInt32, samples)
    state = dr.zeros(mi.UInt32, count), mi.Color3f(0), mi.Color3f(0), mi.Color3f(0), mi.Float(0)
    _, lit, base, shine, squares = dr.while_loop(state, lambda i, *_: i < rounds, body, label="light")
    return lit, base, shine, squares


def _open_irradiance(scene: Any, surface: Surface) -> Any:
    """Irradiance (Color3f) of relit points without any occluder, from the same directions for all."""
    wanted = surface.relit & surface.valid
    si = _receiver(surface.position, surface.normal)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        sample, radiance = scene.sample_emitter_direction(si, _lattice(i, OPEN_LATTICE), False, wanted)
        return i + 1, total + radiance * dr.maximum(dr.dot(surface.normal, sample.d), 0)

    rounds = dr.opaque(mi.UInt32, OPEN_LATTICE[0])
    state = dr.zeros(mi.UInt32, dr.width(wanted)), mi.Color3f(0)
    _, total = dr.while_loop(state, lambda i, total: wanted & (i < rounds), body, label="open light")
    return total / OPEN_LATTICE[0]


def _receiver(position: Any, normal: Any) -> Any:
    """Surface interaction that light is sampled for."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(position))
    si.p = position
    si.n = mi.Normal3f(normal)
    si.sh_frame = mi.Frame3f(si.n)
    return si


def _lattice(i: Any, lattice: tuple[int, int]) -> Any:
    """Point ``i`` of a centred rank-1 lattice in the unit square."""
    count, generator = lattice
    return mi.Point2f((mi.Float(i) + 0.5) / count, (mi.Float(i * generator % count) + 0.5) / count)


def _ggx(surface: Surface, to_light: Any, cos_light: Any, cos_camera: Any, alpha2: Any) -> Any:
    """GGX microfacet reflection with height-correlated masking (Walter 2007; Heitz 2014) and Schlick's Fresnel term."""
    half = dr.normalize(to_light + surface.to_camera)
    cos_half = dr.dot(surface.normal, half)
    spread = dr.fma(cos_half * cos_half, alpha2 - 1, 1)
    distribution = alpha2 / (dr.pi * dr.square(spread))
    masking = cos_light * dr.sqrt(dr.fma(cos_camera * cos_camera, 1 - alpha2, alpha2)) + cos_camera * dr.sqrt(
        dr.fma(cos_light * cos_light, 1 - alpha2, alpha2)
    )
    grazing = dr.power(dr.clip(1 - dr.dot(half, to_light), 0, 1), 5)
    fresnel = dr.select(surface.specular > 0, dr.fma(1 - surface.specular, grazing, surface.specular), 0)
    return dr.select(cos_light > 0, distribution * fresnel * 0.5 / dr.maximum(masking, 1e-6), 0)


def reference_irradiance(scene: Any, point: Sequence[float], normal: Sequence[float] = (0.0, 0.0, 1.0)) -> Any:
    """Unoccluded irradiance (Color3f) of the scene's emitters on a surface element.

    Where next to nothing reaches that element, it is the mean over all orientations, a quarter of the fluence.
    """
    i = dr.arange(mi.UInt32, REFERENCE_LATTICE[0])
    si = _receiver(mi.Point3f(*[dr.opaque(mi.Float, float(v)) for v in point]), mi.Vector3f(*normal))
    sample, radiance = scene.sample_emitter_direction(si, _lattice(i, REFERENCE_LATTICE), False)
    irradiance = mi.Color3f(*[dr.mean(c) for c in radiance * dr.maximum(dr.dot(mi.Vector3f(si.n), sample.d), 0)])
    mean = mi.Color3f(*[0.25 * dr.mean(c) for c in radiance])
    return dr.maximum(dr.select(irradiance > 1e-3 * mean, irradiance, mean), 1e-12)


def _bayer(x: Any, y: Any) -> Any:
    """Rank of a pixel in an 8x8 ordered-dither matrix: neighbours take far-apart points of the sequence."""
    result = mi.UInt32(0)
    for bit in range(3):
        a, b = (x >> bit) & 1, (y >> bit) & 1
        result |= ((a ^ b) << (5 - 2 * bit)) | (b << (4 - 2 * bit))
    return result


def _smooth_light(
    lit: Any, base: Any, shine: Any, squares: Any, surface: Surface, group: Any, view: View, *, radius: int = 4
) -> tuple[Any, Any, Any]:
    """Average sums of light over neighbours on the same surface: a separable filter that keeps edges.

    A neighbour counts where it belongs to the same ``group``, its normal agrees, it lies in the tangent plane, and its
    share of light differs by no more than noise explains, so that a hard shadow keeps its edge while a penumbra becomes
    smooth. A few rays per pixel say too little about that share; both are taken from 3 x 3 pixels. Their noise is that
    of as many binary draws as equal weights would need for the same variance (Kish 1965, section 11.7). Equal sums stay
    equal, so that the ratio of an unshadowed point is exactly 1.

    At a silhouette a pixel may show one thing and its ray meet the proxy of another. Such a point has its light from
    the known neighbours that show the same thing.
    """
    pixel = dr.arange(mi.UInt32, dr.width(group))
    x, y = mi.Int32(pixel % view.width), mi.Int32(pixel // view.width)
    footprint = surface.offset * 8

    def average(values: list[Any], radius: int, alike: Callable[[Any, Any], Any] = lambda _, same: same) -> list[Any]:
        for horizontal in (True, False):
            weights = dr.select(surface.known, 1, GUESS_WEIGHT)
            sums = [mi.Float(0) for _ in values]
            for step in [s for r in range(1, radius + 1) for s in (-r, r)]:
                nx, ny = (x + step, y) if horizontal else (x, y + step)
                inside = (nx >= 0) & (nx < view.width) & (ny >= 0) & (ny < view.height) & surface.valid
                other = mi.UInt32(ny * view.width + nx)
                position = dr.gather(mi.Point3f, surface.position, other, inside)
                normal = dr.gather(mi.Vector3f, surface.normal, other, inside)
                same = inside & (dr.gather(mi.UInt32, group, other, inside) == group)
                plane = dr.abs(dr.dot(surface.normal, position - surface.position))
                known = dr.gather(mi.Bool, surface.known, other, same)
                near = (dr.dot(surface.normal, normal) > 0.95) & (plane < footprint * abs(step)) & alike(other, same)
                same &= (near & (known == surface.known)) | (known & ~surface.known)
                # Halves at the ends: the filter spans one period of the dither, not one pixel more.
                weight = dr.select(same, dr.select(known, 1.0, GUESS_WEIGHT), 0) * (0.5 if abs(step) == radius else 1.0)
                weights += weight
                # Differences from the middle, so that equal neighbours leave it bit for bit as it was.
                sums = [
                    dr.fma(weight, dr.gather(mi.Float, v, other, same) - v, s)
                    for v, s in zip(values, sums, strict=True)
                ]
            values = [v + s / weights for v, s in zip(values, sums, strict=True)]
            dr.eval(values)
        return values

    values = [*lit, *base, *shine]
    dr.eval(values, squares, surface.position, surface.normal)
    near_lit, near_base, near_squares = average([dr.sum(lit), dr.sum(base), squares], 1)
    share = dr.select(near_base > 0, near_lit / near_base, 1)
    draws = dr.maximum(9 * dr.square(near_base) / dr.maximum(near_squares, 1e-20), 1)
    likely = (share * draws + 0.5) / (draws + 1)
    variance = likely * (1 - likely) / draws
    dr.eval(share, variance)

    def alike(other: Any, same: Any) -> Any:
        noise = variance + dr.gather(mi.Float, variance, other, same)
        return dr.square(dr.gather(mi.Float, share, other, same) - share) <= NOISE_LIMIT * noise

    values = average(values, radius, alike)
    return mi.Color3f(*values[:3]), mi.Color3f(*values[3:6]), mi.Color3f(*values[6:])
