"""Estimation of the materials of a photographed object whose light is known.

The radiance of a surface is linear in its base colour (:mod:`mitsplat.renderer.materials.principled`). For each pair of
metalness and roughness, the base colour of every surface point follows from the photographs that show the point. Points
of similar colour form regions, and each region takes the pair whose radiance fits its photographs best. Points then
move to the region that explains their photographs best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.cluster.vq import kmeans2
from scipy.optimize import minimize
from scipy.spatial import KDTree

from mitsplat.arrays import BoolArray, Float64Array, Int64Array
from mitsplat.capture.capture import Capture
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.images.colour import encode_srgb
from mitsplat.reconstruct.materials.capture_light import CaptureLight, require_light_frame
from mitsplat.reconstruct.materials.colour_fit import ColourFit, fit_colours, mix_materials
from mitsplat.reconstruct.materials.lit_surfaces import lit_surfaces
from mitsplat.reconstruct.materials.observations import Observations, View, clear_points, observe, sample_surface
from mitsplat.reconstruct.materials.surface_light import LitMesh, Reflectance
from mitsplat.runtime.variant import ensure_variant

MIN_CONFIDENCE, MIN_EXPLAINED = 0.1, 0.25
"""Least values of :class:`MaterialEstimate` at which an asset gets estimated materials."""

_METALLIC = np.linspace(0, 1, 5)
_ROUGHNESS = np.array([0.15, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.8])
"""Grid of the search, which a local search refines."""
_POINTS, _FIT_POINTS = 12_000, 1000
"""Number of surface points with a base colour, and of those that determine metalness and roughness."""
_CLUSTERS = 6
_MERGE_LOSS = 0.1
"""Relative increase of the errors of two clusters up to which they become one region."""
_MIN_SHARE = 0.03
"""Share of the points below which a cluster is merged with another."""
_NEIGHBOURS = 12
"""Number of points over which colours and errors are averaged."""
_PHOTO_SIZE = 640
"""Longest edge of the photos [px]."""
_MIN_VIEWS = 4


@dataclass(frozen=True)
class MaterialRegion:
    """Surface of one material.

    Attributes:
        colour: Mean base colour, linear RGB.
        metallic, roughness: Parameters of ``principled``.
        confidence: Relative difference between the errors of the best metal and of the best dielectric, 0 to 1.
        share: Share of the observed surface points.
    """

    colour: tuple[float, float, float]
    metallic: float
    roughness: float
    confidence: float
    share: float

    def __str__(self) -> str:
        colour = "".join(f"{round(255 * value):02x}" for value in encode_srgb(np.clip(self.colour, 0, 1)))
        return (
            f"base colour #{colour}, metallic {self.metallic:.2f}, roughness {self.roughness:.2f}, "
            f"confidence {self.confidence:.2f}, {self.share:.0%} of the surface"
        )


@dataclass(frozen=True, eq=False)
class MaterialEstimate:
    """Estimated materials of an object.

    Attributes:
        regions: Regions by decreasing share.
        points: Surface points, shape (N, 3).
        colours: Linear base colours of the points, (N, 3).
        region: Index of the region of each point, (N,).
        explained: Relative decrease of the error of the photos if clusters of points have a common base colour under
            the light instead of a common radiance. It is small or negative if the light is wrong.
    """

    regions: tuple[MaterialRegion, ...]
    points: Float64Array
    colours: Float64Array
    region: Int64Array
    explained: float

    @property
    def confidence(self) -> float:
        """Mean confidence of the surface."""
        return sum(region.share * region.confidence for region in self.regions)

    def shortcoming(self) -> str | None:
        """Return why the materials must not be used, a clause, or None."""
        if self.explained < MIN_EXPLAINED:
            return (
                "under the light, base colours reduce the error of captured colours in the photos by "
                f"{self.explained:.0%} (at least {MIN_EXPLAINED:.0%} is required)"
            )
        if self.confidence < MIN_CONFIDENCE:
            return f"the confidence is {self.confidence:.2f} (at least {MIN_CONFIDENCE:g} is required)"
        return None

    def apply(self, splats: Splats) -> Splats:
        """Return the splats with these materials; each Gaussian gets the base colour of the nearest points."""
        distance, nearest = KDTree(self.points).query(splats.means, k=min(3, len(self.points)))
        distance, nearest = distance.reshape(len(splats), -1), nearest.reshape(len(splats), -1)
        same = self.region[nearest] == self.region[nearest[:, :1]]
        weight = same / np.maximum(distance, 1e-12)
        weight /= weight.sum(axis=1, keepdims=True)
        colours = encode_srgb(np.einsum("nk,nkc->nc", weight, self.colours[nearest]))
        table = np.array([(region.metallic, region.roughness) for region in self.regions])
        metallic, roughness = table[self.region[nearest[:, 0]]].T.astype(np.float32)
        materials = SplatMaterials(metallic, roughness, np.full(len(splats), 0.5, dtype=np.float32))
        return replace(splats, sh=rgb_to_sh(colours[:, None]).astype(np.float32), materials=materials)


def estimate_materials(capture: Capture, mesh: trimesh.Trimesh, light: CaptureLight) -> MaterialEstimate:
    """Estimate the materials of an object from its photographs.

    Args:
        capture: Photos with masks, in metres, z up.
        mesh: Surface of the object in the frame of the capture.
        light: Light of the photographs.

    Raises:
        InputError: If the capture has no metric frame, or too few photos show the object.
    """
    ensure_variant()
    require_light_frame(capture)
    views = [View.of(photo, _PHOTO_SIZE) for photo in capture.photos if photo.mask is not None]
    surfaces = lit_surfaces(mesh, views, light, floor=0.0 if capture.table else float(mesh.bounds[0, 2]))
    points, normals = sample_surface(mesh, _POINTS)
    seen = observe(surfaces, points, normals, views, "object")
    counts = np.bincount(seen.point, minlength=len(points))
    usable = np.flatnonzero(counts >= _MIN_VIEWS)
    if len(usable) < _CLUSTERS:
        raise InputError(
            f"materials need surface points that {_MIN_VIEWS} photos show (got {len(usable)}): check masks and light"
        )
    points, normals, (seen, _) = points[usable], normals[usable], seen.select(usable)
    clear = clear_points(mesh, surfaces, points, normals, views)
    # Errors of a part of the points for each metalness and roughness of the grid.
    fitted = np.sort(np.random.default_rng(0).permutation(len(points))[:_FIT_POINTS])
    observed, _ = seen.select(fitted)
    traced = _trace(surfaces, points[fitted], normals[fitted], observed, _ROUGHNESS)
    fits = [[fit_colours(observed, mix_materials(traced, m, k)) for k in range(len(_ROUGHNESS))] for m in _METALLIC]
    errors = np.stack([np.stack([fit.errors for fit in row], axis=1) for row in fits], axis=1)

    def reflected(metallic: float, roughness: float) -> tuple[Float64Array, Float64Array]:
        return mix_materials(_trace(surfaces, points, normals, seen, np.array([roughness])), metallic, 0)

    # Clusters of points of similar base colour, and the material of each region of clusters.
    best = np.unravel_index(errors.mean(axis=0).argmin(), errors.shape[1:])
    fit = fit_colours(seen, reflected(float(_METALLIC[best[0]]), float(_ROUGHNESS[best[1]])))
    near = KDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))[1]
    cluster = _clusters(fit.colours, near)
    merged = _merge(cluster[fitted], errors, clear[fitted])
    region = merged[cluster]
    regions = [
        _region(_members(region[fitted], number, clear[fitted]), errors, observed, traced)
        for number in range(int(merged.max()) + 1)
    ]
    materials = [reflected(found.metallic, found.roughness) for found in regions]
    fitted_colours = [fit_colours(seen, material) for material in materials]
    # Points change to the cluster whose colour explains the photos of their neighbourhood best.
    names = np.unique(cluster)
    means = [np.median(fitted_colours[merged[name]].colours[cluster == name], axis=0) for name in names]
    loss = [fit_colours(seen, materials[merged[name]], one).errors for name, one in zip(names, means, strict=True)]
    smooth = np.stack(loss, axis=1)[near].mean(axis=1)
    region = merged[names[smooth.argmin(axis=1)]]
    colours = _colours_of_regions(region, regions, fitted_colours, clear)
    share = np.bincount(region, minlength=len(regions)) / len(region)
    order = np.argsort(-share, kind="stable")
    regions = [replace(regions[number], share=float(share[number])) for number in order if share[number] > 0]
    explained = 1 - float(smooth.min(axis=1).mean()) / max(_captured_loss(seen, near), 1e-9)
    return MaterialEstimate(tuple(regions), points, colours, np.argsort(order)[region], explained)


def _colours_of_regions(
    region: Int64Array, regions: Sequence[MaterialRegion], fits: Sequence[ColourFit], clear: BoolArray
) -> Float64Array:
    """Return the linear base colour of each point, (N, 3), from the fit with the material of its region.

    Points that few photos show, and those of metal that mirrors itself, get the colour of their region.
    """
    colours = np.empty((len(region), 3))
    for number, (found, fit) in enumerate(zip(regions, fits, strict=True)):
        own = region == number
        prior = np.median(fit.weights, axis=0) * np.where(clear, 0.1, 0.1 + 0.9 * found.metallic)[:, None]
        colours[own] = ((fit.weights * fit.colours + prior * found.colour) / (fit.weights + prior))[own]
    return colours


def _clusters(colours: Float64Array, near: Int64Array) -> Int64Array:
    """Return the cluster of each point by its linear colour (N, 3); ``near`` (N, K) are its neighbours."""
    return np.asarray(kmeans2(np.median(encode_srgb(colours)[near], axis=1), _CLUSTERS, minit="++", seed=0)[1])


def _captured_loss(seen: Observations, near: Int64Array) -> float:
    """Return the mean error of radiances that are equal in all directions, one for each cluster of points."""
    constant = np.ones_like(seen.radiance), np.zeros_like(seen.radiance)
    radiance = fit_colours(seen, constant).colours
    cluster = _clusters(radiance, near)
    means = [np.median(radiance[cluster == name], axis=0) for name in np.unique(cluster)]
    loss = np.stack([fit_colours(seen, constant, one).errors for one in means], axis=1)
    return float(loss[near].mean(axis=1).min(axis=1).mean())


def _trace(
    surfaces: LitMesh, points: Float64Array, normals: Float64Array, seen: Observations, roughness: Float64Array
) -> Reflectance:
    light = surfaces.light(points, normals)
    return surfaces.reflectance(light, seen.point, seen.to_camera, roughness.tolist())


def _members(cluster: Int64Array, number: int, clear: BoolArray) -> Int64Array:
    """Return the clear points of a cluster, or all if there are few."""
    own = np.flatnonzero(cluster == number)
    suitable = own[clear[own]]
    return suitable if len(suitable) >= max(8, 0.1 * len(own)) else own


def _merge(cluster: Int64Array, errors: Float64Array, clear: BoolArray) -> Int64Array:
    """Return the region of each cluster.

    Clusters that one material explains almost as well are merged, and so are small ones. Clusters without points are in
    region 0.
    """
    names, own = np.unique(cluster, return_inverse=True)
    region = np.arange(len(names))
    while (count := int(region.max()) + 1) > 1:
        members = [_members(region[own], number, clear) for number in range(count)]
        sizes, means = np.bincount(region[own]), np.array([errors[rows].mean(axis=0) for rows in members])
        increase = means / np.maximum(means.min(axis=(1, 2), keepdims=True), 1e-3) - 1
        pairs = [(i, j) for i in range(count) for j in range(i)]
        loss = [float(np.maximum(increase[i], increase[j]).min()) for i, j in pairs]
        small = set(np.flatnonzero(sizes < _MIN_SHARE * len(own)).tolist())
        choices = [k for k, pair in enumerate(pairs) if not small or small.intersection(pair)]
        chosen = min(choices, key=lambda k: loss[k])
        if loss[chosen] > _MERGE_LOSS and not small:
            break
        i, j = pairs[chosen]
        region = np.where(region == i, j, region)
        region = np.where(region > i, region - 1, region)
    found = np.zeros(_CLUSTERS, dtype=np.int64)
    found[names] = region
    return found


def _region(rows: Int64Array, errors: Float64Array, seen: Observations, traced: Reflectance) -> MaterialRegion:
    """Return the material of the points ``rows``."""
    table = errors[rows].mean(axis=0)
    start = np.unravel_index(table.argmin(), table.shape)
    observed, mask = seen.select(rows)
    own = Reflectance(*[getattr(traced, name)[mask] for name in ("diffuse", "tint", "metal", "dielectric")])

    def error(values: Float64Array) -> float:
        return float(fit_colours(observed, mix_materials(own, values[0], values[1])).errors.mean())

    limits = [(0.0, 1.0), (0.0, len(_ROUGHNESS) - 1.0)]
    initial = np.array([_METALLIC[start[0]], start[1]], dtype=np.float64)
    simplex = np.clip(initial + np.array([(0, 0), (0.1, 0), (0, 0.6)]), 0, [1, len(_ROUGHNESS) - 1])
    simplex[1, 0] = initial[0] - 0.1 if initial[0] >= 0.95 else simplex[1, 0]
    simplex[2, 1] = initial[1] - 0.6 if initial[1] > limits[1][1] - 0.6 else simplex[2, 1]
    found = minimize(
        error,
        initial,
        method="Nelder-Mead",
        bounds=limits,
        options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-5, "maxfev": 40},
    )
    metallic, place = found.x
    fit = fit_colours(observed, mix_materials(own, metallic, place))
    metal = _METALLIC >= 0.5
    other = table[~metal if metallic >= 0.5 else metal].min()
    return MaterialRegion(
        colour=tuple(np.median(fit.colours, axis=0).tolist()),
        metallic=float(metallic),
        roughness=float(np.interp(place, np.arange(len(_ROUGHNESS)), _ROUGHNESS)),
        confidence=float(np.clip(1 - found.fun / max(other, 1e-9), 0, 1)),
        share=0.0,
    )
