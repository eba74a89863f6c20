"""Light that surface points of a photographed object reflect for a base colour of 1, by the lobes of ``principled``.

Rays from a point end at an emitter, or at the object and its support, whose radiance is that in the photographs: it
contains all further bounces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from mitsplat.renderer.emitters.emitter_sampling import Emitters, receiver
from mitsplat.renderer.materials.principled import (
    SpecularLobe,
    diffuse_albedo,
    diffuse_reflectance,
    lattice_point,
    power_weight,
)
from mitsplat.renderer.rays.device_arrays import plain_mesh, ray_scene, wrapped

_LOBE_LATTICE, _LIGHT_LATTICE, _OPEN_LATTICE = (55, 34), (377, 233), (89, 55)
"""Number and generator of the rays of a specular lobe, of the samples of the emitters at a point, and of openness."""


@dataclass(frozen=True, eq=False)
class IncidentLight:
    """Samples of the emitters at N points, M for each.

    Attributes:
        points, normals: The points and their unit normals, N.
        direction: Unit vectors towards the emitters, N M.
        arriving: Radiance over the density of the sample, 0 if it is occluded, N M.
        density: Sampling density [1/sr], N M.
        irradiance: Irradiance by surfaces, N.
    """

    points: mi.Point3f
    normals: mi.Vector3f
    direction: mi.Vector3f
    arriving: mi.Color3f
    density: mi.Float
    irradiance: mi.Color3f


@dataclass(frozen=True, eq=False)
class Reflectance:
    """Radiance towards cameras for each roughness: base colour * tint + white part.

    Attributes:
        diffuse: Tint of dielectrics, shape (R, K, 3) for R rays and K values of roughness.
        tint: Tint of metals, (R, K, 3).
        metal: White part of metals, (R, K, 3).
        dielectric: White part of dielectrics with ``specular`` 0.5, (R, K, 3).
    """

    diffuse: Float32Array
    tint: Float32Array
    metal: Float32Array
    dielectric: Float32Array


class LitMesh:
    """Surfaces of known radiance under emitters."""

    def __init__(self, mesh: trimesh.Trimesh, faces: int, lights: mi.Scene, centre: Sequence[float]) -> None:
        """Prepare the ray tracing.

        Args:
            mesh: All surfaces.
            faces: Number of faces of the object, which come first.
            lights: Scene with the emitters.
            centre: Point at which the emitters are compared [m].
        """
        self._scene = ray_scene({"surfaces": plain_mesh(mesh)})
        self._lights, self._emitters = lights, Emitters(lights, centre)
        self._faces = wrapped(mi.UInt32, np.asarray(mesh.faces, dtype=np.uint32))
        self._object_faces = dr.opaque(mi.UInt32, faces)
        self._offset = dr.opaque(mi.Float, 1e-4 * float(mesh.scale))
        self._radiance = [dr.zeros(mi.Float, 3 * len(mesh.vertices))] * 4

    def set_radiance(self, radiance: Float64Array) -> None:
        """Set the radiance of the vertices towards a unit vector d, as coefficients (V, 4, 3) of 1 and d."""
        self._radiance = [wrapped(mi.Float, one.astype(np.float32)) for one in radiance.swapaxes(0, 1)]

    def unoccluded(self, points: Float64Array, normals: Float64Array, target: Float64Array) -> BoolArray:
        """Return True for points (N, 3) with unit normals (N, 3) that see a ``target`` (3,)."""
        origin = _vector(points) + _vector(normals) * self._offset
        towards = mi.Vector3f(*[dr.opaque(mi.Float, float(value)) for value in target]) - origin
        ray = mi.Ray3f(mi.Point3f(origin), dr.normalize(towards))
        ray.maxt = dr.norm(towards)
        return np.asarray(~np.array(self._scene.ray_test(ray)))

    def openness(self, points: Float64Array, normals: Float64Array) -> Float64Array:
        """Return the cosine-weighted share of the hemispheres of points (N, 3) that the object does not cover."""
        samples = _OPEN_LATTICE[0]
        lane = dr.arange(mi.UInt32, len(points) * samples)
        row = lane // dr.opaque(mi.UInt32, samples)
        si = receiver(dr.gather(mi.Point3f, _point(points), row), dr.gather(mi.Vector3f, _vector(normals), row))
        towards = mi.warp.square_to_cosine_hemisphere(lattice_point(lane - row * samples, _OPEN_LATTICE))
        hit = self._scene.ray_intersect_preliminary(self._ray(si, si.to_world(towards)))
        covered = dr.select(hit.is_valid() & (hit.prim_index < self._object_faces), mi.Float(1), 0)
        return 1 - np.array(dr.block_sum(covered, samples), dtype=np.float64) / samples

    def light(self, points: Float64Array, normals: Float64Array) -> IncidentLight:
        """Return the light that arrives at points (N, 3) with unit normals (N, 3)."""
        samples, place, normal = _LIGHT_LATTICE[0], _point(points), _vector(normals)
        lane = dr.arange(mi.UInt32, len(points) * samples)
        row = lane // dr.opaque(mi.UInt32, samples)
        si = receiver(dr.gather(mi.Point3f, place, row), dr.gather(mi.Vector3f, normal, row))
        point = lattice_point(lane - row * samples, _LIGHT_LATTICE)
        beam = self._emitters.sample(si, point, mi.Bool(True))
        ray = self._ray(si, beam.direction)
        ray.maxt = beam.reach
        lost = self._scene.ray_test(ray) | ~dr.isfinite(dr.sum(beam.irradiance))
        direct = dr.select(lost, 0, beam.irradiance)
        upward = self._ray(si, si.to_world(mi.warp.square_to_cosine_hemisphere(point)))
        reflected = dr.pi * self._reflected(upward)
        irradiance = mi.Color3f(*[dr.block_sum(channel, samples) / samples for channel in reflected])
        arriving = direct / dr.maximum(dr.dot(si.n, beam.direction), 1e-6)
        light = IncidentLight(place, normal, beam.direction, arriving, beam.density, irradiance)
        dr.eval(light.direction, light.arriving, light.density, light.irradiance)
        return light

    def reflectance(
        self, light: IncidentLight, row: Int64Array, to_camera: Float64Array, roughness: Sequence[float]
    ) -> Reflectance:
        """Return the light that points reflect towards cameras.

        Samples of the emitters and of the specular lobe are combined by the power heuristic (Veach 1997, section
        9.2.4).

        Args:
            light: Light at the points.
            row: Index of the point of each ray, shape (R,).
            to_camera: Unit vectors towards the cameras, (R, 3).
            roughness: Values of roughness, K numbers.
        """
        count, rays = len(roughness), len(row)
        item = dr.arange(mi.UInt32, rays * count)
        number = item // dr.opaque(mi.UInt32, count)
        place = dr.gather(mi.UInt32, wrapped(mi.UInt32, row.astype(np.uint32)), number)
        values = wrapped(mi.Float, np.asarray(roughness, dtype=np.float32))
        rough = dr.gather(mi.Float, values, item - number * dr.opaque(mi.UInt32, count))
        normal, view = dr.gather(mi.Vector3f, light.normals, place), dr.gather(mi.Vector3f, _vector(to_camera), number)
        metal = SpecularLobe.of(normal, view, rough, mi.Float(1), mi.Float(0.5))
        plastic, si = replace(metal, metallic=mi.Float(0)), receiver(dr.gather(mi.Point3f, light.points, place), normal)
        lobe_samples, lights = dr.opaque(mi.UInt32, _LOBE_LATTICE[0]), dr.opaque(mi.UInt32, _LIGHT_LATTICE[0])
        share = dr.opaque(mi.Float, _LIGHT_LATTICE[0] / _LOBE_LATTICE[0])
        first = mi.sample_tea_32(item, dr.opaque(mi.UInt32, 0))
        shift = mi.Point2f(*[mi.Float(value >> 8) * 2.0**-24 for value in first])

        def added(sums: Sequence[mi.Color3f], radiance: mi.Color3f, cos_half: mi.Float) -> list[mi.Color3f]:
            tinted, white = metal.fresnel(cos_half), plastic.fresnel(cos_half)
            parts = [radiance * factor for factor in (tinted.tint, tinted.white, white.white)]
            # Directions along the surface yield NaN.
            return [a + dr.select(dr.isfinite(dr.sum(b)), b, 0) for a, b in zip(sums, parts, strict=True)]

        def add_light(i: mi.UInt32, *sums: mi.Color3f) -> tuple[mi.UInt32, *tuple[mi.Color3f, ...]]:
            at = place * lights + i
            direction, arriving = dr.gather(mi.Vector3f, light.direction, at), dr.gather(mi.Color3f, light.arriving, at)
            value, density, cos_half = metal.evaluate(direction)
            value *= power_weight(share * dr.gather(mi.Float, light.density, at), density)
            cosine = dr.maximum(dr.dot(normal, direction), 0)
            matt = diffuse_reflectance(cosine, metal.view.z, cos_half, rough) * cosine / dr.pi
            return i + 1, *added(sums[:3], arriving * value, cos_half), sums[3] + arriving * matt

        def add_ray(i: mi.UInt32, *sums: mi.Color3f) -> tuple[mi.UInt32, *tuple[mi.Color3f, ...]]:
            point = lattice_point(i, _LOBE_LATTICE) + shift
            direction, weight, cos_half = metal.sample(point - dr.floor(point))
            ray = self._ray(si, direction)
            radiance = self._reflected(ray)
            emitted, density = self._emitters.emission(self._lights, si, ray, weight > 0)
            radiance += emitted * power_weight(metal.evaluate(direction)[1], share * density)
            return i + 1, *added(sums[:3], radiance * weight, cos_half), sums[3]

        total = np.zeros((4, 3, rays * count))
        for add, rounds in ((add_light, lights), (add_ray, lobe_samples)):
            state = dr.zeros(mi.UInt32, rays * count), *[dr.zeros(mi.Color3f, rays * count) for _ in range(4)]
            _, *sums = dr.while_loop(state, lambda i, *_, rounds=rounds: i < rounds, add, label="reflectance")
            means = [part / mi.Float(rounds) for part in sums]
            dr.eval(means)
            total += np.array([np.array(part) for part in means])
        # Surfaces around a point reflect from many directions, so that the mean of the diffuse lobe is enough.
        irradiance = dr.gather(mi.Color3f, light.irradiance, place)
        total[3] += np.array(diffuse_albedo(metal.view.z, rough) * irradiance / dr.pi)
        *specular, diffuse = total.reshape(4, 3, rays, count).transpose(0, 2, 3, 1).astype(np.float32)
        return Reflectance(diffuse, *specular)

    def _ray(self, si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> mi.Ray3f:
        return mi.Ray3f(si.p + mi.Vector3f(si.n) * self._offset, direction)

    def _reflected(self, ray: mi.Ray3f) -> mi.Color3f:
        """Return the radiance of the surfaces that rays hit, and set ``maxt`` to the distances of the hits."""
        hit = self._scene.ray_intersect_preliminary(ray)
        valid, (u, v) = hit.is_valid(), hit.prim_uv
        vertex, colour = dr.gather(mi.Vector3u, self._faces, hit.prim_index, valid), mi.Color3f(0)
        for index, share in zip(vertex, (1 - u - v, u, v), strict=True):
            for values, factor in zip(self._radiance, (1, *-ray.d), strict=True):
                colour += dr.gather(mi.Color3f, values, index, valid) * (share * factor)
        ray.maxt = dr.select(valid, hit.t, dr.inf)
        return dr.select(valid & dr.isfinite(u + v), dr.maximum(colour, 0), 0)  # slivers yield NaN


def _vector(values: Float64Array) -> mi.Vector3f:
    return mi.Vector3f(*[wrapped(mi.Float, axis.astype(np.float32)) for axis in np.asarray(values).T])


def _point(values: Float64Array) -> mi.Point3f:
    return mi.Point3f(_vector(values))
