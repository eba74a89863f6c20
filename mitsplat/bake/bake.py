"""Baking of CAD meshes: surface-aligned Gaussians with the outgoing radiance of Mitsuba's path tracer.

Radiance is traced in directions all over the hemisphere of each surfel (:mod:`mitsplat.gaussians.surfels`),
display-encoded, and fitted with spherical harmonics. A diffuse white surface under the ``uniform`` light has radiance
1. Materials are those of the mesh: glTF's metallic-roughness model, or diffuse vertex or face colours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial import KDTree

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.asset import Asset
from mitsplat.bake.mesh_parts import bake_lights, mitsuba_scene, read_parts, world_from_file
from mitsplat.bake.proxy_mesh import make_proxy
from mitsplat.bake.surface_materials import SurfaceFinish
from mitsplat.bake.verification import BakedView, compare_views, compare_with_textures
from mitsplat.errors import InputError
from mitsplat.fit.refine_splats import Picture, RefineSettings, refine_splats
from mitsplat.gaussians.spherical_harmonics import sh_basis
from mitsplat.gaussians.surfels import Surfels, place_surfels
from mitsplat.geometry.camera import Camera, spiral
from mitsplat.geometry.decomposition import convex_pieces
from mitsplat.images.colour import encode_srgb
from mitsplat.progress import Progress
from mitsplat.renderer.path_tracing import RAYS_PER_LAUNCH, render_mesh, trace_radiance
from mitsplat.runtime.variant import ensure_variant, one_at_a_time
from mitsplat.scene.spec.light_spec import LightSpec

_MIN_RADIANCE = 0.01
"""Radiance of a white surface under the uniform light below which a surfel counts as invisible."""
_TRIAL_GAUSSIANS = 1000
"""Number of trial Gaussians that estimate the visible fraction: accurate to 2 %, in a tenth of the time."""
_DETAIL_GAIN = 7.0
"""Additional relative density of Gaussians where the texture changes strongly."""
_MAX_GAUSSIANS = 2_000_000
_MIN_OBJECT_SIZE, _MAX_OBJECT_SIZE = 0.001, 5.0
"""Size range of objects [m]; sizes outside of it indicate wrong units."""
_MIN_SIZE, _MAX_SIZE = 1e-5, 1e5
"""Size range of any mesh [m]; 32-bit floats are too coarse outside of it."""
_STAGES = {
    "placing Gaussians": 14,
    "tracing their radiance": 16,
    "path-tracing pictures": 14,
    "fitting to the pictures": 40,
    "finding convex pieces": 25,
    "comparing with the mesh": 8,
}
"""Stages of a bake, with their relative durations."""
_MIN_BRIGHTNESS, _MAX_BRIGHTNESS = 0.6, 1.4
"""Range of brightness relative to the textures that shaded corners and highlights can explain."""
_RIDGE_WEIGHT = 0.02
"""Weight of the penalty on view dependence, relative to the data; it determines directions without rays."""


@dataclass(frozen=True, eq=False)
class BakeResult:
    """Baked asset and its difference from path-traced pictures of its mesh.

    Attributes:
        asset: Asset in metres, z up.
        psnr: PSNR over whole images of unseen views [dB]; NaN without verification.
        psnr_object: PSNR over the mesh's pixels alone [dB]; NaN without verification.
        views: Pictures of that comparison.
        surface: Baked mesh with all its parts [m], z up, or None.
        brightness: Mean brightness of the splats relative to the textures of the file and the gloss on top of them. The
            textures are read from the file independently. None without textures or under a scene's lights.
        warnings: Warnings for the user, a sentence each.
    """

    asset: Asset
    psnr: float
    psnr_object: float
    views: tuple[BakedView, ...] = ()
    surface: trimesh.Trimesh | None = None
    brightness: float | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class BakeSettings:
    """Resolution and quality of a bake.

    Attributes:
        gaussians: Target number of Gaussians.
        sh_degree: Degree of the spherical harmonics, 0 to 3; metal needs 2.
        directions: Number of traced directions per Gaussian.
        samples: Light paths per direction.
        bounces: Maximum length of a light path.
        sharpening: Iterations that compensate the blur of overlapping Gaussians.
        density: Relative density of Gaussians of each part of the mesh, by its name; 1 for other parts.
        proxy_faces: Maximum number of faces of the proxy mesh.
        fit_views: Number of path-traced pictures around the mesh for the final fit of the Gaussians.
        fit_steps: Steps of that fit; 0 skips it.
        verify_views: Number of views in which the result is compared with the mesh; 0 skips the comparison.
        seed: Seed of all random numbers.
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
        if self.gaussians > _MAX_GAUSSIANS:
            raise InputError(f"gaussians must be at most {_MAX_GAUSSIANS} (got {self.gaussians})")
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
    finish: SurfaceFinish | None = None,
    any_size: bool = False,
    progress: Progress | None = None,
) -> BakeResult:
    """Bake a textured or coloured mesh into an asset of Gaussians.

    Args:
        mesh: Mesh, scene of several parts, or file that trimesh reads.
        name: Name of the asset.
        class_name: Class label for detectors; ``name`` if None.
        kind: ``object`` or ``environment``. Objects get convex pieces for physics.
        light: ``uniform`` (radiance 1 from all directions), ``studio`` (soft boxes all around, mean radiance 1), or the
            lights of a scene. With the latter, the asset has ``capture_light: scene``.
        settings: Resolution and quality.
        metres_per_unit: Length of the mesh's unit [m].
        up: Axis that points up in the mesh (glTF: y).
        density: Mass density [kg/m^3].
        friction: Coulomb friction coefficient.
        pieces: Convex pieces of an object for physics [m], z up; by default the proxy mesh is decomposed.
        cameras: Views for the comparison; by default all around the mesh.
        fit_cameras: Views for the fit; by default all around the mesh, different from those of the comparison.
        finish: Colour and gloss that replace those of the file.
        any_size: Bake an object even if it is smaller than 1 mm or larger than 5 m, which indicates wrong units.
        progress: Callback that gets the progress, its total, and the stage.

    Raises:
        InputError: Before work starts, if the mesh cannot be read, is empty, or has a size that indicates wrong units,
            or if another value breaks a rule.
    """
    ensure_variant()
    settings = settings or BakeSettings()
    for key, value, allowed in (("kind", kind, ("object", "environment")), ("up", up, ("y", "z"))):
        if value not in allowed:
            raise InputError(f"{key} must be {' or '.join(allowed)} (got {value!r})")
    if not (density > 0 and np.isfinite(density)):
        raise InputError(f"density must be a number > 0 in kg/m^3 (got {density:g})")
    if not (friction >= 0 and np.isfinite(friction)):
        raise InputError(f"friction must be a number of at least 0 (got {friction:g})")
    stages = _Stages(progress)
    lights = bake_lights(light)
    parts = read_parts(mesh, metres_per_unit=metres_per_unit, up=up, finish=finish)
    surface = trimesh.util.concatenate([part.mesh for part in parts])
    source, size = str(mesh) if isinstance(mesh, str | Path) else name, float(surface.extents.max())
    if kind == "object" and not any_size:
        _check_size(source, size, metres_per_unit)
    if not _MIN_SIZE <= size <= _MAX_SIZE:
        raise InputError(f"{source}: a mesh must be {_MIN_SIZE:g} to {_MAX_SIZE:g} m across (got {size:.3g} m)")
    scene = mitsuba_scene(parts, lights)
    stages("placing Gaussians")
    rng = np.random.default_rng(settings.seed)
    relative = settings.density or {}
    face_density = np.concatenate(
        [relative.get(part.name, 1.0) * part.detail_density(_DETAIL_GAIN, rng) for part in parts]
    )
    clay = mitsuba_scene(parts, bake_lights("uniform"), clay=True)
    # The visible fraction of a few trial surfels determines how many surfels are placed.
    trial = place_surfels(surface, face_density, min(_TRIAL_GAUSSIANS, settings.gaussians), rng)
    share = float(_visible_surfels(clay, trial, rng).mean()) if len(trial) else 1.0
    surfels = place_surfels(surface, face_density, round(settings.gaussians / max(share, 0.2)), rng)
    surfels = surfels.subset(_visible_surfels(clay, surfels, rng))
    if not len(surfels):
        raise InputError(
            f"{name}: no point of the mesh is visible from outside; check whether its faces are inside out"
        )
    colour = _fit_radiance(scene, surfels, settings, rng, stages.step)
    splats = surfels.splats(_sharpen_colours(surfels, colour, settings.sharpening))
    if settings.fit_steps:
        stages("path-tracing pictures")
        fit_cameras = fit_cameras or _orbit(surface, settings.fit_views, turn=0.0)
        pictures = []
        for view, camera in enumerate(fit_cameras):
            stages("path-tracing pictures", view / len(fit_cameras))
            pictures.append(_trace_picture(scene, camera, settings, view))
        stages("fitting to the pictures")
        refining = RefineSettings(iterations=settings.fit_steps, seed=settings.seed)
        splats = refine_splats(
            splats,
            pictures,
            refining,
            observe=lambda step, _: stages("fitting to the pictures", step / settings.fit_steps),
        )
    stages("finding convex pieces")
    proxy = make_proxy(parts, settings.proxy_faces)
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
    warnings = [warning for part in parts for warning in part.warnings]
    if not settings.verify_views:
        stages.end()
        return BakeResult(asset, float("nan"), float("nan"), surface=surface, warnings=tuple(warnings))
    cameras = cameras or _orbit(surface, settings.verify_views)
    views, psnr, psnr_object = compare_views(
        scene, splats, cameras, bounces=settings.bounces, seed=settings.seed, progress=stages.step
    )
    brightness = None
    if isinstance(light, str) and (finish is None or finish.colour is None):
        gloss = {part.name: part.gloss for part in parts}
        brightness = compare_with_textures(mesh, splats, world_from_file(metres_per_unit, up), gloss)
    if brightness is not None and not _MIN_BRIGHTNESS < brightness < _MAX_BRIGHTNESS:
        warnings.append(
            f"the splats are {brightness:.2g} times as bright as the textures of the file: "
            "check the factors of its materials"
        )
    stages.end()
    return BakeResult(asset, psnr, psnr_object, views, surface, brightness, tuple(warnings))


class _Stages:
    """Progress of a bake in percent."""

    def __init__(self, tell: Progress | None) -> None:
        self._progress = tell

    def __call__(self, stage: str, share: float = 0.0) -> None:
        if self._progress is not None:
            names = list(_STAGES)
            before = sum(_STAGES[name] for name in names[: names.index(stage)])
            self._progress(int(100 * (before + share * _STAGES[stage]) / sum(_STAGES.values())), 100, stage)

    def step(self, done: int, total: int, stage: str) -> None:
        """Report that ``done`` of ``total`` steps of a stage are complete."""
        self(stage, done / total)

    def end(self) -> None:
        """Report the end."""
        if self._progress is not None:
            self._progress(100, 100, "done")


def _check_size(source: str, size: float, metres_per_unit: float) -> None:
    """Refuse objects whose size [m] indicates wrong units."""
    if _MIN_OBJECT_SIZE <= size <= _MAX_OBJECT_SIZE:
        return
    factor, unit = (0.001, "millimetres") if size > _MAX_OBJECT_SIZE else (1000.0, "metres")
    likely = ""
    if _MIN_OBJECT_SIZE <= size * factor <= _MAX_OBJECT_SIZE:
        likely = f"--units {metres_per_unit * factor:g} reads it in {unit}, and "
    raise InputError(
        f"{source}: an object must be {_MIN_OBJECT_SIZE:g} to {_MAX_OBJECT_SIZE:g} m across (got {size:.3g} m at "
        f"{metres_per_unit:g} metres per unit: {likely}--any-size accepts the size)"
    )


def _hemisphere(count: int) -> Float64Array:
    """Return directions (M, 3), evenly over the hemisphere around z, at least 3 degrees above the horizon."""
    return spiral(1.0 - 0.95 * (np.arange(count) + 0.5) / count)


def _rotate_directions(frames: Float64Array, directions: Float64Array, rng: np.random.Generator) -> Float64Array:
    """Return ``directions`` (M, 3) in each of ``frames`` (N, 3, 3), rotated by a random angle, shape (N, M, 3)."""
    angle = rng.uniform(0.0, 2.0 * np.pi, (len(frames), 1))
    cos, sin = np.cos(angle), np.sin(angle)
    local = np.empty((len(frames), len(directions), 3))
    local[..., 0] = cos * directions[:, 0] - sin * directions[:, 1]
    local[..., 1] = sin * directions[:, 0] + cos * directions[:, 1]
    local[..., 2] = directions[:, 2]
    return np.asarray(np.einsum("nij,nmj->nmi", frames, local))


def _visible_surfels(clay: mi.Scene, surfels: Surfels, rng: np.random.Generator) -> BoolArray:
    """Return a mask (N,) of the surfels that light from outside reaches.

    Surfels inside a solid, in a closed cavity or under a label are not reached.

    Args:
        clay: Scene in white under the uniform light, with black back faces.
        surfels: Surfels to test.
        rng: Random generator.
    """
    directions = _rotate_directions(surfels.frames, _hemisphere(8), rng)
    origins = surfels.points[:, None] + _ray_offset(clay) * directions
    radiance, _ = trace_radiance(
        clay,
        origins.reshape(-1, 3),
        -directions.reshape(-1, 3),
        samples=4,
        bounces=2,
        seed=int(rng.integers(1 << 30)),
    )
    return np.asarray(radiance.reshape(len(surfels), -1).mean(axis=1) > _MIN_RADIANCE)


def _ray_offset(scene: mi.Scene) -> float:
    """Return the distance above a surface [m] at which rays towards it start, just above the rounding of float32."""
    box = scene.bbox()
    return 1e-5 * float(max(abs(v) for v in (*box.min, *box.max)))


def _hits_nearby(
    scene: mi.Scene, origins: Float64Array, directions: Float64Array, normals: Float64Array, reach: Float64Array
) -> BoolArray:
    """Return a mask (N, M) of the rays that hit a nearby surface of similar orientation.

    The hit is within ``reach`` (N,) [m], and its normal is close to ``normals`` (N, 3).
    """
    rays = mi.Ray3f(
        mi.Point3f(origins.reshape(-1, 3).T.astype(np.float32)),
        mi.Vector3f(directions.reshape(-1, 3).T.astype(np.float32)),
    )
    hit = scene.ray_intersect_preliminary(rays)
    facing = hit.compute_surface_interaction(rays).n
    dr.eval(facing, hit.t)  # evaluated together, because a later evaluation would trace the rays again
    normal = np.asarray(facing).T.reshape(origins.shape)
    distance = np.asarray(hit.t).reshape(origins.shape[:2])
    alike = np.einsum("nmd,nd->nm", normal, normals) > 0.8
    return np.asarray((distance < reach[:, None]) & alike)


def _fit_radiance(
    scene: mi.Scene, surfels: Surfels, settings: BakeSettings, rng: np.random.Generator, progress: Progress
) -> Float64Array:
    """Fit spherical harmonics (N, K, 3) to the display-encoded radiance that leaves every surfel."""
    local = _hemisphere(settings.directions)
    weights = 0.2 + local[:, 2]
    terms = (settings.sh_degree + 1) ** 2
    penalty = _RIDGE_WEIGHT * weights.sum() * np.diag([1e-6] + [1.0] * (terms - 1)) / (4.0 * np.pi)
    coefficients = np.empty((len(surfels), terms, 3))
    step = max(1, RAYS_PER_LAUNCH // (settings.directions * settings.samples))
    for start in range(0, len(surfels), step):
        progress(start, len(surfels), "tracing their radiance")
        chunk = slice(start, start + step)
        frames, scales = surfels.frames[chunk], surfels.scales[chunk]
        towards = _rotate_directions(frames, local, rng)
        # Samples over the footprint average the texture over the Gaussian instead of aliasing it.
        offset = np.clip(rng.normal(size=(*towards.shape[:2], 2)), -1.5, 1.5) * 0.5 * scales[:, None, :2]
        origins = surfels.points[chunk, None] + np.einsum("nij,nmj->nmi", frames[:, :, :2], offset)
        origins += (0.3 * scales[:, None, :1] + _ray_offset(scene)) * towards
        on_surface = _hits_nearby(scene, origins, -towards, frames[:, :, 2], 1.2 * scales[:, 0])
        origins = np.where(on_surface[..., None], origins, surfels.points[chunk, None] + _ray_offset(scene) * towards)
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


def _sharpen_colours(surfels: Surfels, target: Float64Array, rounds: int) -> Float64Array:
    """Return colours (N, K, 3) whose blend at every surfel approximates ``target`` (N, K, 3).

    Van Cittert's iteration. Colours are clamped to the range of their neighbours, which prevents ringing.
    """
    if not rounds or len(surfels) < 2:
        return target
    neighbours = min(16, len(surfels))
    _, index = KDTree(surfels.points).query(surfels.points, k=neighbours, workers=-1)
    offset = surfels.points[:, None] - surfels.points[index]
    local = np.einsum("nkj,nkji->nki", offset, surfels.frames[index]) / surfels.scales[index]
    facing = np.einsum("nkd,nd->nk", surfels.normals[index], surfels.normals) > 0.8
    blend = np.exp(-0.5 * (local[..., :2] ** 2).sum(axis=2)) * facing
    blend /= blend.sum(axis=1, keepdims=True)
    colour = target.copy()
    for band in range(target.shape[1]):
        goal, now = target[:, band], colour[:, band]
        around = goal[index]
        low, high = around.min(axis=1), around.max(axis=1)
        for _ in range(rounds):
            now = np.clip(now + 0.7 * (goal - np.einsum("nk,nkc->nc", blend, now[index])), low, high)
        colour[:, band] = now
    return colour


def _trace_picture(scene: mi.Scene, camera: Camera, settings: BakeSettings, view: int) -> Picture:
    """Path-trace a picture of the mesh for the fit."""
    seed = settings.seed + 1000 + view
    radiance, cover = render_mesh(scene, camera, samples=16, bounces=settings.bounces, seed=seed)
    return Picture(camera, encode_srgb(radiance).astype(np.float32), cover.astype(np.float32))


def _orbit(surface: trimesh.Trimesh, count: int, *, turn: float = 0.7) -> list[Camera]:
    """Return ``count`` views from all around that frame the mesh."""
    centre = surface.bounds.mean(axis=0)
    radius = 0.5 * float(np.linalg.norm(surface.extents))
    outward = spiral(1.0 - 2.0 * (np.arange(count) + 0.5) / count, turn)
    return [
        Camera.look_at(centre + 4.5 * radius * d, centre, width=256, height=256, fov_x=29.0, near=0.1 * radius)
        for d in outward
    ]
