"""CAD meshes to assets: surface-aligned Gaussians whose outgoing radiance Mitsuba's path tracer bakes.

Surfels (:mod:`mitsplat.surfels`) are seen from directions all over their hemispheres. The radiance that leaves them
towards each, display-encoded, is fitted with spherical harmonics. A diffuse white surface under the ``uniform`` light
has radiance 1. Materials are those of the mesh: glTF's metallic-roughness model, or diffuse vertex or face colours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import shapely
import trimesh
from scipy.spatial import KDTree

from mitsplat.assets import Asset
from mitsplat.cad import Part, bake_lights, mitsuba_scene, read_parts
from mitsplat.camera import Camera
from mitsplat.colour import encode_srgb
from mitsplat.errors import InputError
from mitsplat.mesh import convex_pieces
from mitsplat.metrics import psnr_of
from mitsplat.plugins.proxies import Occluder, Proxies
from mitsplat.refine import Picture, RefineSettings, refine_splats
from mitsplat.scene import LightSpec
from mitsplat.splats import Splats, sh_basis
from mitsplat.surfels import Surfels, place_surfels
from mitsplat.trace import RAYS_PER_LAUNCH, render_mesh, trace_radiance
from mitsplat.variant import one_at_a_time

FloatArray = npt.NDArray[np.float64]

_OPACITY = 0.98
_HIDDEN = 0.01
"""Radiance of a white surface under the uniform light below which nobody sees it."""
_DETAIL = 7.0
"""How many times denser Gaussians are where the texture changes strongly."""
_RIDGE = 0.02
"""Weight of the penalty on view dependence, relative to the data: decides what no ray has seen."""

_LABEL_GAP = 0.01
"""Distance from a solid, relative to its own size, within which a sheet is a label on it."""


@dataclass(frozen=True, eq=False)
class BakeResult:
    """A baked asset and how close it comes to a path-traced picture of its mesh.

    Attributes:
        asset: The asset, in metres, z up.
        psnr: Over whole images of unseen views [dB]; NaN without verification.
        psnr_object: Over the mesh's pixels alone [dB]; NaN without verification.
    """

    asset: Asset
    psnr: float
    psnr_object: float


@dataclass(frozen=True)
class BakeSettings:
    """How finely a mesh is baked.

    Attributes:
        gaussians: Number of Gaussians aimed for.
        sh_degree: Degree of the spherical harmonics, 0 to 3; metal needs 2.
        directions: Directions in which every Gaussian is seen.
        samples: Light paths per direction.
        bounces: Longest light path.
        sharpening: Rounds that undo the blur which overlapping Gaussians cause.
        density: Relative density of Gaussians of a part of the mesh, by its name; 1 where unnamed.
        proxy_faces: Most faces of the proxy mesh.
        fit_views: Path-traced pictures all around the mesh that the Gaussians are fitted to at last.
        fit_steps: Steps of that fit; 0 skips it.
        verify_views: Views in which the result is compared with the mesh; 0 skips it.
        seed: Decides every random number.
    """

    gaussians: int = 20000
    sh_degree: int = 2
    directions: int = 32
    samples: int = 16
    bounces: int = 6
    sharpening: int = 4
    density: Mapping[str, float] | None = None
    proxy_faces: int = 10000
    fit_views: int = 32
    fit_steps: int = 300
    verify_views: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("gaussians", "directions", "samples", "bounces", "proxy_faces"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1 (got {getattr(self, name)})")
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree must be 0, 1, 2 or 3 (got {self.sh_degree})")


@one_at_a_time
def bake_asset(
    mesh: trimesh.Trimesh | trimesh.Scene | str | Path,
    *,
    name: str,
    class_name: str | None = None,
    kind: Literal["object", "environment"] = "object",
    light: str | Sequence[LightSpec] = "uniform",
    settings: BakeSettings | None = None,
    metres_per_unit: float = 1.0,
    up: Literal["y", "z"] = "z",
    density: float = 1000.0,
    friction: float = 0.5,
    pieces: Sequence[trimesh.Trimesh] = (),
    cameras: Sequence[Camera] = (),
    fit_cameras: Sequence[Camera] = (),
) -> BakeResult:
    """Bake a textured or coloured mesh into an asset of Gaussians.

    Args:
        mesh: A mesh, a scene of several parts, or a file that trimesh reads.
        name: Name of the asset.
        class_name: Class that detectors learn; ``name`` if None.
        kind: Objects get convex pieces for physics.
        light: ``uniform`` (radiance 1 from everywhere), ``studio`` (soft boxes all around, mean radiance 1), or the
            lights of a scene, which the asset then carries as ``capture_light: scene``.
        settings: How finely to bake.
        metres_per_unit: Length of the mesh's unit [m].
        up: Axis that points up in the mesh (glTF: y).
        density: Mass density [kg/m^3].
        friction: Coulomb friction coefficient.
        pieces: Convex pieces of an object for physics [m], z up; by default the proxy mesh is decomposed.
        cameras: Views for the comparison; by default all around the mesh.
        fit_cameras: Views of the pictures that the fit takes; by default all around the mesh, others than for the
            comparison.

    Raises:
        InputError: If the mesh cannot be read or is empty, or the light is unknown.
    """
    settings = settings or BakeSettings()
    parts = read_parts(mesh, metres_per_unit=metres_per_unit, up=up)
    scene = mitsuba_scene(parts, bake_lights(light))
    rng = np.random.default_rng(settings.seed)
    surface = trimesh.util.concatenate([part.mesh for part in parts])
    relative = settings.density or {}
    face_density = np.concatenate([relative.get(part.name, 1.0) * part.detail_density(_DETAIL, rng) for part in parts])
    clay = mitsuba_scene(parts, bake_lights("uniform"), clay=True)
    wanted = settings.gaussians
    for _ in range(2):
        surfels = place_surfels(surface, face_density, wanted, rng)
        surfels = surfels.subset(_seen(clay, surfels, settings, rng))
        if len(surfels) > 0.9 * settings.gaussians:
            break
        wanted = round(wanted * settings.gaussians / max(len(surfels), 0.2 * settings.gaussians))
    if not len(surfels):
        raise InputError(f"{name}: no point of the mesh can be seen; are its faces inside out?")
    colour = _fit_radiance(scene, surfels, settings, rng)
    splats = Splats(
        means=surfels.centres.astype(np.float32),
        quats=surfels.quats.astype(np.float32),
        scales=surfels.scales.astype(np.float32),
        opacities=np.full(len(surfels), _OPACITY, dtype=np.float32),
        sh=_sharpened(surfels, colour, settings.sharpening).astype(np.float32),
    )
    if settings.fit_steps:
        fit_cameras = fit_cameras or _orbit(surface, settings.fit_views, turn=0.0)
        pictures = [_picture(scene, camera, settings, view) for view, camera in enumerate(fit_cameras)]
        splats = refine_splats(splats, pictures, RefineSettings(iterations=settings.fit_steps, seed=settings.seed))
    proxy = _proxy_mesh(parts, settings.proxy_faces)
    area = np.array([part.mesh.area for part in parts])
    asset = Asset(
        name=name,
        class_name=class_name or name,
        splats=splats,
        mesh=proxy,
        pieces=tuple(pieces) or (convex_pieces(proxy) if kind == "object" else ()),
        kind=kind,
        density=density,
        friction=friction,
        roughness=float(np.average([part.roughness for part in parts], weights=area)),
        specular=float(np.average([part.specular for part in parts], weights=area)),
        capture_light="uniform" if isinstance(light, str) else "scene",
        white=None if isinstance(light, str) else float(np.pi),
    )
    if not settings.verify_views:
        return BakeResult(asset, float("nan"), float("nan"))
    cameras = cameras or _orbit(surface, settings.verify_views)
    return BakeResult(asset, *_compare(scene, splats, cameras, settings))


def _hemisphere(count: int) -> FloatArray:
    """Directions (M, 3) evenly over the hemisphere around z, none closer than 3 degrees to the horizon."""
    height = 1.0 - 0.95 * (np.arange(count) + 0.5) / count
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)


def _turned(frames: FloatArray, directions: FloatArray, rng: np.random.Generator) -> FloatArray:
    """``directions`` (M, 3) in every one of ``frames`` (N, 3, 3), each turned by a random angle: (N, M, 3)."""
    angle = rng.uniform(0.0, 2.0 * np.pi, (len(frames), 1))
    cos, sin = np.cos(angle), np.sin(angle)
    local = np.empty((len(frames), len(directions), 3))
    local[..., 0] = cos * directions[:, 0] - sin * directions[:, 1]
    local[..., 1] = sin * directions[:, 0] + cos * directions[:, 1]
    local[..., 2] = directions[:, 2]
    return np.asarray(np.einsum("nij,nmj->nmi", frames, local))


def _seen(clay: mi.Scene, surfels: Surfels, settings: BakeSettings, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Whether light from outside finds its way to a surfel (N,): not inside a solid, a closed hollow or under a label.

    ``clay`` is the scene in white, under the uniform light, its faces black from behind.
    """
    directions = _turned(surfels.frames, _hemisphere(8), rng)
    origins = surfels.points[:, None] + _lift(clay) * directions
    radiance, _ = trace_radiance(
        clay,
        origins.reshape(-1, 3),
        -directions.reshape(-1, 3),
        samples=4,
        bounces=2,
        seed=int(rng.integers(1 << 30)),
    )
    return np.asarray(radiance.reshape(len(surfels), -1).mean(axis=1) > _HIDDEN)


def _lift(scene: mi.Scene) -> float:
    """Distance above a surface [m] at which rays towards it start: little, but more than float32's rounding."""
    box = scene.bbox()
    return 1e-5 * float(max(abs(v) for v in (*box.min, *box.max)))


def _hits_nearby(
    scene: mi.Scene, origins: FloatArray, directions: FloatArray, normals: FloatArray, reach: FloatArray
) -> npt.NDArray[np.bool_]:
    """Whether rays (N, M, 3) hit a surface within ``reach`` (N,) [m] that faces much as ``normals`` (N, 3) do."""
    rays = mi.Ray3f(
        mi.Point3f(origins.reshape(-1, 3).T.astype(np.float32)),
        mi.Vector3f(directions.reshape(-1, 3).T.astype(np.float32)),
    )
    hit = scene.ray_intersect_preliminary(rays)
    normal = np.asarray(hit.compute_surface_interaction(rays).n).T.reshape(origins.shape)
    distance = np.asarray(hit.t).reshape(origins.shape[:2])
    alike = np.einsum("nmd,nd->nm", normal, normals) > 0.8
    return np.asarray((distance < reach[:, None]) & alike)


def _fit_radiance(scene: mi.Scene, surfels: Surfels, settings: BakeSettings, rng: np.random.Generator) -> FloatArray:
    """Spherical-harmonic coefficients (N, K, 3) of the display-encoded radiance that leaves every surfel."""
    local = _hemisphere(settings.directions)
    weights = 0.2 + local[:, 2]
    terms = (settings.sh_degree + 1) ** 2
    penalty = _RIDGE * weights.sum() * np.diag([1e-6] + [1.0] * (terms - 1)) / (4.0 * np.pi)
    coefficients = np.empty((len(surfels), terms, 3))
    step = max(1, RAYS_PER_LAUNCH // (settings.directions * settings.samples))
    for start in range(0, len(surfels), step):
        chunk = slice(start, start + step)
        frames, scales = surfels.frames[chunk], surfels.scales[chunk]
        towards = _turned(frames, local, rng)
        # Footprint samples average the texture over the Gaussian instead of aliasing it.
        offset = np.clip(rng.normal(size=(*towards.shape[:2], 2)), -1.5, 1.5) * 0.5 * scales[:, None, :2]
        origins = surfels.points[chunk, None] + np.einsum("nij,nmj->nmi", frames[:, :, :2], offset)
        origins += (0.3 * scales[:, None, :1] + _lift(scene)) * towards
        on_surface = _hits_nearby(scene, origins, -towards, frames[:, :, 2], 1.2 * scales[:, 0])
        origins = np.where(on_surface[..., None], origins, surfels.points[chunk, None] + _lift(scene) * towards)
        radiance, _ = trace_radiance(
            scene,
            origins.reshape(-1, 3),
            -towards.reshape(-1, 3),
            samples=settings.samples,
            bounces=settings.bounces,
            seed=int(rng.integers(1 << 30)),
        )
        basis = sh_basis(-towards.reshape(-1, 3), settings.sh_degree).reshape(*towards.shape[:2], terms)
        weighted = weights[:, None] * basis
        target = encode_srgb(radiance).reshape(*towards.shape) - 0.5
        coefficients[chunk] = np.linalg.solve(
            np.einsum("nmk,nml->nkl", weighted, basis) + penalty, np.einsum("nmk,nmc->nkc", weighted, target)
        )
    return coefficients


def _sharpened(surfels: Surfels, target: FloatArray, rounds: int) -> FloatArray:
    """Colours (N, K, 3) whose blend at every surfel comes close to ``target`` (N, K, 3).

    Van Cittert's iteration; colours stay within those of their neighbours, so that nothing rings.
    """
    if not rounds or len(surfels) < 2:
        return target
    neighbours = min(16, len(surfels))
    _, index = KDTree(surfels.points).query(surfels.points, k=neighbours)
    offset = surfels.points[:, None] - surfels.points[index]
    local = np.einsum("nkj,nkji->nki", offset, surfels.frames[index]) / surfels.scales[index]
    facing = np.einsum("nkd,nd->nk", surfels.normals[index], surfels.normals) > 0.8
    blend = np.exp(-0.5 * (local[..., :2] ** 2).sum(axis=2)) * facing
    blend /= blend.sum(axis=1, keepdims=True)
    colour = target.copy()
    for band in range(target.shape[1]):
        wanted, now = target[:, band], colour[:, band]
        around = wanted[index]
        low, high = around.min(axis=1), around.max(axis=1)
        for _ in range(rounds):
            now = np.clip(now + 0.7 * (wanted - np.einsum("nk,nkc->nc", blend, now[index])), low, high)
        colour[:, band] = now
    return colour


def _proxy_mesh(parts: Sequence[Part], most_faces: int) -> trimesh.Trimesh:
    """One surface of all parts, of at most about ``most_faces`` faces; labels on solids are left out.

    Decimation eats open sheets from their edges, so they keep all faces, the flat ones only as many as they need.
    """
    solids = [part.mesh for part in parts if part.mesh.is_volume]
    sheets = [part.mesh for part in parts if not part.mesh.is_volume]
    if len(solids) > 1:
        solids = [trimesh.boolean.union(solids, engine="manifold")]
    if solids:
        sheets = [sheet for sheet in sheets if not _lies_on(sheet, solids[0])]
    sheets = [_flattened(sheet) for sheet in sheets]
    room = max(most_faces - sum(len(sheet.faces) for sheet in sheets), most_faces // 2)
    solids = [s if len(s.faces) <= room else s.simplify_quadric_decimation(face_count=room) for s in solids]
    proxy = trimesh.util.concatenate(solids + sheets)
    return trimesh.Trimesh(proxy.vertices, proxy.faces)


def _flattened(sheet: trimesh.Trimesh) -> trimesh.Trimesh:
    """A sheet in a plane with no more faces than its outline needs; any other sheet as it is."""
    normal = sheet.face_normals[0]
    height = (sheet.vertices - sheet.vertices[0]) @ normal
    if (sheet.face_normals @ normal < 0.999).any() or np.ptp(height) > 1e-5 * sheet.scale:
        return sheet
    to_plane = trimesh.geometry.plane_transform(sheet.vertices[0], normal)
    corners = trimesh.transform_points(sheet.vertices, to_plane)[sheet.faces, :2]
    outline = shapely.coverage_union_all(shapely.polygons(corners)).simplify(1e-6 * sheet.scale)
    flat = [trimesh.creation.triangulate_polygon(polygon, engine="earcut") for polygon in shapely.get_parts(outline)]
    vertices, faces = trimesh.util.append_faces([v for v, _ in flat], [f for _, f in flat])
    vertices = np.pad(vertices, ((0, 0), (0, 1)))
    return trimesh.Trimesh(trimesh.transform_points(vertices, np.linalg.inv(to_plane)), faces)


def _lies_on(sheet: trimesh.Trimesh, solid: trimesh.Trimesh) -> bool:
    """Whether an open sheet hugs a solid, as a label does: everywhere within a hundredth of its size."""
    origins, down = sheet.triangles_center, -sheet.face_normals
    rays = mi.Ray3f(mi.Point3f(origins.T.astype(np.float32)), mi.Vector3f(down.T.astype(np.float32)))
    hit, _ = Proxies([Occluder(solid, 0, dynamic=False)]).nearest(rays)
    return bool((np.array(hit.distance) < _LABEL_GAP * sheet.scale).all())


def _picture(scene: mi.Scene, camera: Camera, settings: BakeSettings, view: int) -> Picture:
    """A path-traced picture of the mesh to fit to."""
    seed = settings.seed + 1000 + view
    radiance, cover = render_mesh(scene, camera, samples=16, bounces=settings.bounces, seed=seed)
    return Picture(camera, encode_srgb(radiance).astype(np.float32), cover.astype(np.float32))


def _orbit(surface: trimesh.Trimesh, count: int, *, turn: float = 0.7) -> list[Camera]:
    """Views (``count``) from all around that frame the mesh."""
    centre = surface.bounds.mean(axis=0)
    radius = 0.5 * float(np.linalg.norm(surface.extents))
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    azimuth = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count) + turn
    ring = np.sqrt(1.0 - height**2)
    outward = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], axis=1)
    return [
        Camera.look_at(centre + 4.5 * radius * d, centre, width=256, height=256, fov_x=29.0, near=0.1 * radius)
        for d in outward
    ]


def _compare(scene: mi.Scene, splats: Splats, cameras: Sequence[Camera], settings: BakeSettings) -> tuple[float, float]:
    """PSNR [dB] of the splats against the path-traced mesh: whole images, and the mesh's pixels alone."""
    from mitsplat.render import render_splats

    errors, on_object = [], []
    for view, camera in enumerate(cameras):
        truth, cover = render_mesh(scene, camera, samples=36, bounces=settings.bounces, seed=settings.seed + view)
        layers = render_splats(splats, camera)
        error = (np.clip(encode_srgb(layers.rgb), 0, 1) - np.clip(encode_srgb(truth), 0, 1)) ** 2
        errors.append(error.mean())
        on_object.append(error[cover > 0].mean() if cover.any() else np.nan)
    return psnr_of(float(np.mean(errors))), psnr_of(float(np.nanmean(on_object)))
