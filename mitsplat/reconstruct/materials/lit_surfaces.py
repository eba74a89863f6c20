"""Object and support with the radiance that reflections on the object show.

Photographs show the support only near the object, and from above. Reflections also show it further away and at grazing
angles, where matt surfaces reflect windows and lamps. The radiance of the support thus follows from its material, which
the photographs determine, and from the light.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial import KDTree

from mitsplat.arrays import Float64Array
from mitsplat.reconstruct.materials.capture_light import CaptureLight
from mitsplat.reconstruct.materials.colour_fit import fit_colours, mix_materials
from mitsplat.reconstruct.materials.observations import CLIPPED, Observations, View, observe, sample_surface
from mitsplat.reconstruct.materials.surface_light import LitMesh

_GRID, _REACH = 41, 10.0
"""Vertices along the edge of the support, and half of this edge in diagonals of the object."""
_SLOPE_WEIGHT = 0.3
"""Weight, in observations, of a radiance that is equal in all directions."""
_ROUGHNESS = (0.3, 0.5, 0.7, 0.9)
"""Values among which the roughness of the support is chosen."""
_TARGETS = 100
"""Number of points of the object towards which the radiance of the support is computed if they face it."""
_OUTER = 20
"""Number of nearest photographed points that determine the base colour of a point outside the photographs."""


def lit_surfaces(mesh: trimesh.Trimesh, views: Sequence[View], light: CaptureLight, floor: float) -> LitMesh:
    """Return the object with its radiance in the photos, and its support, a plane at height ``floor``."""
    fine = trimesh.Trimesh(mesh.vertices, mesh.faces).subdivide_to_size(float(mesh.scale) / 25, max_iter=20)
    plane = _plane(mesh, floor)
    arrays = trimesh.util.append_faces([fine.vertices, plane.vertices], [fine.faces, plane.faces])
    whole = trimesh.Trimesh(*arrays, process=False)
    surfaces = LitMesh(whole, len(fine.faces), light.scene(), mesh.bounds.mean(axis=0).tolist())
    photographed = observe(surfaces, fine.vertices, np.asarray(fine.vertex_normals), views, "object")
    radiance = np.zeros((len(whole.vertices), 4, 3))
    radiance[: len(fine.vertices)] = _linear_radiance(fine.vertices, photographed)
    surfaces.set_radiance(radiance)
    radiance[len(fine.vertices) :] = _support_radiance(surfaces, plane.vertices, views, mesh)
    surfaces.set_radiance(radiance)
    return surfaces


def _plane(mesh: trimesh.Trimesh, floor: float) -> trimesh.Trimesh:
    """Return a square grid whose cells are smaller below the object, where its shadow ends."""
    centre, line = mesh.bounds.mean(axis=0), np.linspace(-1, 1, _GRID)
    line = (0.1 * line + 0.9 * line**3) * _REACH * float(mesh.scale)
    x, y = np.meshgrid(line + centre[0], line + centre[1])
    corner = np.arange(_GRID * (_GRID - 1)).reshape(-1, _GRID)[:, :-1].ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + _GRID + 1], axis=1),
            np.stack([corner, corner + _GRID + 1, corner + _GRID], axis=1),
        ]
    )
    return trimesh.Trimesh(np.stack([x.ravel(), y.ravel(), np.full(x.size, floor)], axis=1), faces, process=False)


def _support_radiance(
    surfaces: LitMesh, points: Float64Array, views: Sequence[View], mesh: trimesh.Trimesh
) -> Float64Array:
    """Return the radiance of points (N, 3) of the support towards the object, as coefficients (N, 4, 3).

    The support is a dielectric. Points outside the photographs have the base colour of the nearest ones inside.
    """
    upward = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    seen = observe(surfaces, points, upward, views, "surroundings")
    known, row = np.unique(seen.point, return_inverse=True)
    if not len(known):
        return np.zeros((len(points), 4, 3))
    light = surfaces.light(points, upward)
    traced = surfaces.reflectance(light, seen.point, seen.to_camera, _ROUGHNESS)
    # Clipped pixels count as just below the limit, because a support that is clipped everywhere must not become black.
    radiance = np.minimum(seen.radiance, 0.999 * CLIPPED)
    observed = Observations(row, radiance, seen.to_camera, np.zeros_like(seen.clipped))
    fits = [fit_colours(observed, mix_materials(traced, 0.0, k)) for k in range(len(_ROUGHNESS))]
    best = int(np.argmin([fit.errors.mean() for fit in fits]))
    nearest = KDTree(points[known]).query(points, k=min(_OUTER, len(known)))[1].reshape(len(points), -1)
    colours = np.median(fits[best].colours[nearest], axis=1)
    colours[known] = fits[best].colours
    targets, normals = sample_surface(mesh, _TARGETS)
    towards = targets - points[:, None]
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-12)
    point, target = np.nonzero((np.einsum("ntd,td->nt", towards, normals) < 0) & (towards[..., 2] > 1e-3))
    towards = towards[point, target]
    traced = surfaces.reflectance(light, point, towards, _ROUGHNESS[best : best + 1])
    tint, white = mix_materials(traced, 0.0, 0)
    radiance = colours[point] * tint + white
    # Photographs contain the light that the object reflects onto the support, and the model the grazing angles.
    modelled = Observations(point, radiance, towards, np.zeros(radiance.shape, dtype=bool))
    everything = (np.concatenate(pair) for pair in zip(seen, modelled, strict=True))
    return _linear_radiance(points, Observations(*everything).in_order())


def _linear_radiance(points: Float64Array, seen: Observations) -> Float64Array:
    """Fit the radiance of points (N, 3) towards a unit vector d, as coefficients (N, 4, 3) of 1 and d.

    Points without observations get the coefficients of the nearest observed point.
    """
    known, starts = np.unique(seen.point, return_index=True)
    if not len(known):
        return np.zeros((len(points), 4, 3))
    basis = np.insert(seen.to_camera, 0, 1.0, axis=1)[:, :, None]
    left = np.add.reduceat(basis * basis.swapaxes(1, 2), starts) + np.diag([0, *[_SLOPE_WEIGHT] * 3])
    found = np.linalg.solve(left, np.add.reduceat(basis * seen.radiance[:, None], starts))
    return np.asarray(found[KDTree(points[known]).query(points)[1]])
