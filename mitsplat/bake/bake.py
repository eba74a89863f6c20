"""Baking of meshes: surface-aligned Gaussians with the materials of a CAD file or a scan.

Gaussians are placed on the surface (:mod:`mitsplat.gaussians.surfels`). Their base colours, metalness, roughness and
specular are those of the mesh: glTF's metallic-roughness model, MTL, or matt vertex or face colours. An environment
under the lights of a scene has path-traced radiance instead (:mod:`mitsplat.bake.radiance`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arguments import check_fields, check_least, check_list, check_number, check_text, check_type
from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.asset import Asset
from mitsplat.bake.file_normals import with_normals
from mitsplat.bake.mesh_parts import MeshModel, MeshPart, read_model
from mitsplat.bake.mesh_surface import MeshSurface
from mitsplat.bake.part_shapes import UNIFORM_LIGHT, bake_lights, mitsuba_scene
from mitsplat.bake.proxy_mesh import make_proxy
from mitsplat.bake.radiance import BOUNCES, bake_radiance, hemisphere, ray_offset, rotate_directions
from mitsplat.bake.size_checks import check_size, mass_warnings
from mitsplat.bake.surface_materials import SurfaceFinish
from mitsplat.bake.verification import BakedView, MeshPictures, compare_views, compare_with_textures
from mitsplat.errors import InputError
from mitsplat.fit.refine_splats import Picture, refine_splats
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.gaussians.surfels import Surfels
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import spiral
from mitsplat.geometry.decomposition import convex_pieces
from mitsplat.images.colour import encode_srgb
from mitsplat.mesh_files.mesh_file import MeshFile
from mitsplat.progress import Progress
from mitsplat.renderer.path_tracing import render_mesh, trace_radiance
from mitsplat.renderer.scene_emitters import MitsubaDict
from mitsplat.runtime.variant import ensure_variant, one_at_a_time
from mitsplat.scene.spec.light_spec import DrawnLight, LightSpec

_MIN_RADIANCE = 0.01
"""Radiance of a white surface under the uniform light below which a surfel counts as invisible."""
_TRIAL_GAUSSIANS = 1000
"""Number of trial Gaussians that estimate the visible fraction: accurate to 2 %, in a tenth of the time."""
_DETAIL_GAIN = 7.0
"""Additional relative density of Gaussians where the texture changes strongly."""
_MAX_GAUSSIANS = 2_000_000
_FIT_VIEWS = 12
_BASE_COLOUR_SAMPLES, _RADIANCE_SAMPLES = (4, 9), (16, 36)
"""Rays per pixel of the pictures for the fit and for the comparison."""
_STAGES = {
    "placing Gaussians": 40,
    "tracing their radiance": 16,
    "rendering pictures": 14,
    "fitting to the pictures": 40,
    "finding convex pieces": 25,
    "comparing with the mesh": 8,
}
"""Stages of a bake, with their relative durations."""
_MIN_PSNR = 24.0
"""PSNR on unseen views below which splats differ clearly from the mesh: an RMSE of 10^(-24/20), 6.3 % of the range."""
_MAX_BACKS = 0.02
"""Maximum share of visible points of an object that are backs of one-sided faces."""


@dataclass(frozen=True, eq=False)
class BakeResult:
    """Baked asset and its difference from pictures of its mesh: base colours, or radiance under a scene's lights.

    Attributes:
        asset: Asset in metres, z up.
        psnr: PSNR over whole images of unseen views [dB]; NaN without verification.
        psnr_object: PSNR over the mesh's pixels alone [dB]; NaN without verification.
        views: Pictures of that comparison.
        surface: Baked mesh with all its parts [m], z up, or None.
        brightness: Mean brightness of the splats relative to the textures of the file, without the factors of its
            materials. None without textures or under a scene's lights.
        warnings: Warnings for the user, a sentence each.
        units: Unit and up axis of the mesh, and which of them its file states.
    """

    asset: Asset
    psnr: float = math.nan
    psnr_object: float = math.nan
    views: tuple[BakedView, ...] = field(default=(), repr=False)
    surface: trimesh.Trimesh | None = field(default=None, repr=False)
    brightness: float | None = None
    warnings: tuple[str, ...] = ()
    units: str = ""


@dataclass(frozen=True)
class BakeSettings:
    """Resolution of a bake.

    Attributes:
        gaussians: Target number of Gaussians.
        density: Relative density of Gaussians of each part of the mesh, by its name; 1 for other parts.
        proxy_faces: Maximum number of faces of the proxy mesh.
        fit_steps: Steps of the fit of the Gaussians to pictures of the mesh; 0 skips it.
        verify_views: Number of views in which the result is compared with the mesh; 0 skips the comparison.
        seed: Seed of all random numbers.
    """

    gaussians: int = 20000
    density: Mapping[str, float] | None = None
    proxy_faces: int = 10000
    fit_steps: int = 40
    verify_views: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        check_least(self, gaussians=1, proxy_faces=1)
        if self.gaussians > _MAX_GAUSSIANS:
            raise InputError(f"gaussians must be at most {_MAX_GAUSSIANS} (got {self.gaussians})")


@one_at_a_time
def bake_asset(
    mesh: trimesh.Trimesh | trimesh.Scene | MeshFile | str | Path,
    *,
    name: str,
    class_name: str | None = None,
    kind: Literal["object", "environment"] = "object",
    lights: Sequence[LightSpec] | None = None,
    settings: BakeSettings | None = None,
    metres_per_unit: float | None = None,
    up: Literal["y", "z"] | None = None,
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
        mesh: Mesh, scene of several parts, mesh file, or the content of one.
        name: Name of the asset.
        class_name: Class label for detectors; ``name`` if None.
        kind: ``object`` or ``environment``. Objects get convex pieces for physics.
        lights: Lights of a scene whose radiance is baked into an asset with ``capture_light: scene``. By default the
            asset has materials, and scenes light it.
        settings: Resolution.
        metres_per_unit: Length of the mesh's unit [m]; by default that which the file states (STEP, glTF, 3MF,
            COLLADA), or 1 m.
        up: Axis that points up in the mesh; by default that which the file states (glTF: y), or z.
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
    settings = BakeSettings() if settings is None else settings
    check_type(settings, BakeSettings, "settings", "for example mitsplat.BakeSettings(gaussians=10000)")
    check_text(name, "name")
    check_list(cameras, Camera, "cameras")
    check_list(fit_cameras, Camera, "fit_cameras")
    check_list(pieces, trimesh.Trimesh, "pieces")
    if lights is not None:
        check_list(lights, DrawnLight, "lights")
    _check_values(kind, metres_per_unit, up, density, friction)
    stages = _Stages(progress)
    emitters = None if lights is None else bake_lights(lights)
    model = read_model(mesh, metres_per_unit=metres_per_unit, up=up, finish=finish)
    surface = MeshSurface(model.parts)
    source = str(mesh) if isinstance(mesh, str | Path) else name
    check_size(source, surface.mesh, model.units, kind, any_size=any_size, has_pieces=bool(pieces))
    stages("placing Gaussians")
    rng = np.random.default_rng(settings.seed)
    surfels = _place_visible_surfels(name, surface, model.parts, settings, rng)
    splats, materials, pictures = _surfel_splats(surface, model.parts, surfels, emitters, rng, stages)
    if settings.fit_steps:
        fit_cameras = fit_cameras or _orbit(surface.mesh, _FIT_VIEWS, turn=0.0)
        splats = _fit_splats(splats, pictures, fit_cameras, settings, stages)
    splats = replace(splats, materials=materials)
    stages("finding convex pieces")
    proxy = with_normals(make_proxy(model.parts, settings.proxy_faces), [part.mesh for part in model.parts])
    asset = Asset(
        name=name,
        class_name=class_name or name,
        splats=splats,
        mesh=proxy,
        pieces=tuple(pieces) or (convex_pieces(proxy) if kind == "object" else ()),
        kind=kind,
        density=density,
        friction=friction,
        roughness=_mean_over_area(model.parts, "roughness"),
        specular=_mean_over_area(model.parts, "specular"),
        capture_light="uniform" if lights is None else "scene",
        white=None if lights is None else float(np.pi),
    )
    warnings = _mesh_warnings(model, surface if kind == "object" else None, settings.seed)
    warnings += mass_warnings(asset, model.units)
    result = BakeResult(asset, surface=surface.mesh, units=_describe_units(model))
    if settings.verify_views:
        cameras = cameras or _orbit(surface.mesh, settings.verify_views)
        views, psnr, psnr_object = compare_views(pictures, splats, cameras, settings.seed, stages.step)
        result = replace(result, views=views, psnr=psnr, psnr_object=psnr_object)
        if psnr < _MIN_PSNR:
            warnings.append(
                f"the splats have a PSNR of {psnr:.1f} dB on unseen views, below {_MIN_PSNR:g} dB: compare them with "
                "the mesh in report.html; likely causes are too few Gaussians for its colours and thin features "
                "(--gaussians), or surfaces that lie in each other"
            )
    if settings.verify_views and lights is None:
        brightness, different = compare_with_textures(model.parts, splats, surface.parts_of(surfels.faces))
        result = replace(result, brightness=brightness)
        warnings += _texture_warnings(different)
    if progress is not None:
        progress(100, 100, "done")
    return replace(result, warnings=tuple(warnings))


def _check_values(kind: str, metres_per_unit: float | None, up: str | None, density: float, friction: float) -> None:
    """Raise InputError if a value of a bake breaks a rule."""
    if metres_per_unit is not None:
        check_number(metres_per_unit, "metres_per_unit")
    check_number(density, "density")
    check_number(friction, "friction")
    if kind not in ("object", "environment"):
        raise InputError(f"kind must be object or environment (got {kind!r})")
    if up not in (None, "y", "z"):
        raise InputError(f"up must be y or z (got {up!r})")
    if not (density > 0 and np.isfinite(density)):
        raise InputError(f"density must be a number > 0 in kg/m^3 (got {density:g})")
    if not (friction >= 0 and np.isfinite(friction)):
        raise InputError(f"friction must be a number of at least 0 (got {friction:g})")


def _place_visible_surfels(
    name: str, surface: MeshSurface, parts: Sequence[MeshPart], settings: BakeSettings, rng: np.random.Generator
) -> Surfels:
    """Place surfels on the visible surface of an asset, about as many as the settings state.

    Raises:
        InputError: If no point of the surface is visible.
    """
    relative = settings.density or {}
    face_density = np.concatenate(
        [relative.get(part.name, 1.0) * part.detail_density(_DETAIL_GAIN, rng) for part in parts]
    )
    clay = mitsuba_scene(parts, UNIFORM_LIGHT, clay=True)
    # The visible fraction of a few trial surfels determines how many surfels are placed.
    trial = surface.place_surfels(face_density, min(_TRIAL_GAUSSIANS, settings.gaussians), rng)
    share = float(_visible_surfels(clay, trial, rng).mean()) if len(trial) else 1.0
    surfels = surface.place_surfels(face_density, round(settings.gaussians / max(share, 0.2)), rng)
    visible = surfels.subset(_visible_surfels(clay, surfels, rng))
    if not len(visible):
        raise InputError(
            f"{name}: no point of the mesh is visible from outside; check whether its faces are inside out"
        )
    return visible


def _surfel_splats(
    surface: MeshSurface,
    parts: Sequence[MeshPart],
    surfels: Surfels,
    emitters: MitsubaDict | None,
    rng: np.random.Generator,
    stages: _Stages,
) -> tuple[Splats, SplatMaterials | None, MeshPictures]:
    """Return Gaussians at the surfels, their materials, and pictures of the mesh.

    With ``emitters``, the Gaussians show the radiance under these lights and have no materials.
    """
    if emitters is None:
        colours, materials = surface.sample_surfels(surfels, rng)
        splats = surfels.splats(rgb_to_sh(colours[:, None]))
        return splats, materials, MeshPictures(surface.picture, *_BASE_COLOUR_SAMPLES)
    scene = mitsuba_scene(parts, emitters)
    splats = bake_radiance(scene, surfels, rng, stages.step)
    return splats, None, MeshPictures(partial(_trace_picture, scene), *_RADIANCE_SAMPLES)


def _mean_over_area(parts: Sequence[MeshPart], name: Literal["roughness", "specular"]) -> float:
    """Return the mean of a material parameter over the area of all parts."""
    return float(np.average([getattr(part, name) for part in parts], weights=[part.mesh.area for part in parts]))


def _mesh_warnings(model: MeshModel, solid: MeshSurface | None, seed: int) -> list[str]:
    """Return the warnings of a mesh file; ``solid`` is the surface of an object, whose backs should be invisible."""
    warnings = [*model.warnings, *(warning for part in model.parts for warning in part.warnings)]
    backs = 0.0 if solid is None else solid.share_of_backs(np.random.default_rng(seed))
    if backs > _MAX_BACKS and not any("inside out" in warning for warning in warnings):
        warnings.append(
            f"{backs:.0%} of the visible points are backs of faces, which stay empty: the surface is open; close it, "
            "give it a thickness, or state doubleSided in a glTF file"
        )
    return warnings


def _texture_warnings(different: Mapping[str, float]) -> list[str]:
    """Return the warnings of parts whose splats are brighter or darker than their textures, by the ratio of both."""
    return [
        f"the splats of part {part!r} are {ratio:.2g} times as bright as its texture in the file: check the factor of "
        "its material"
        for part, ratio in different.items()
    ]


class _Stages:
    """Progress of a bake in percent."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress

    def __call__(self, stage: str, share: float = 0.0) -> None:
        if self._progress is not None:
            names = list(_STAGES)
            before = sum(_STAGES[name] for name in names[: names.index(stage)])
            self._progress(int(100 * (before + share * _STAGES[stage]) / sum(_STAGES.values())), 100, stage)

    def step(self, done: int, total: int, stage: str) -> None:
        """Report that ``done`` of ``total`` steps of a stage are complete."""
        self(stage, done / total)


def _describe_units(model: MeshModel) -> str:
    """Return a description such as "0.0254 m, z up (stated by the file)"."""
    text = f"{model.units:g} m, {model.up} up"
    if not model.stated:
        return text
    part = "" if len(model.stated) == 2 else f"{model.stated[0]} "
    return f"{text} ({part}stated by the file)"


def _visible_surfels(clay: mi.Scene, surfels: Surfels, rng: np.random.Generator) -> BoolArray:
    """Return a mask (N,) of the surfels that light from outside reaches.

    Surfels inside a solid, in a closed cavity or under a label are not reached.

    Args:
        clay: Scene in white under the uniform light, with black back faces.
        surfels: Surfels to test.
        rng: Random generator.
    """
    directions = rotate_directions(surfels.frames, hemisphere(8), rng)
    origins = surfels.points[:, None] + ray_offset(clay) * directions
    radiance, _ = trace_radiance(
        clay, origins.reshape(-1, 3), -directions.reshape(-1, 3), samples=4, bounces=2, seed=int(rng.integers(1 << 30))
    )
    return np.asarray(radiance.reshape(len(surfels), -1).mean(axis=1) > _MIN_RADIANCE)


def _trace_picture(scene: mi.Scene, camera: Camera, samples: int, seed: int) -> tuple[Float64Array, Float64Array]:
    return render_mesh(scene, camera, samples=samples, bounces=BOUNCES, seed=seed)


def _fit_splats(
    splats: Splats, pictures: MeshPictures, cameras: Sequence[Camera], settings: BakeSettings, stages: _Stages
) -> Splats:
    """Fit splats to pictures of the mesh, which corrects their outlines most."""
    targets = []
    for view, camera in enumerate(cameras):
        stages("rendering pictures", view / len(cameras))
        colour, cover = pictures.render(camera, pictures.fit_samples, settings.seed + 1000 + view)
        targets.append(Picture(camera, encode_srgb(colour).astype(np.float32), cover.astype(np.float32)))
    stages("fitting to the pictures")
    return refine_splats(
        splats,
        targets,
        iterations=settings.fit_steps,
        seed=settings.seed,
        observe=lambda step, _: stages("fitting to the pictures", step / settings.fit_steps),
    )


def _orbit(surface: trimesh.Trimesh, count: int, *, turn: float = 0.7) -> list[Camera]:
    """Return ``count`` views from all around that frame the mesh."""
    centre = surface.bounds.mean(axis=0)
    radius = 0.5 * float(np.linalg.norm(surface.extents))
    outward = spiral(1.0 - 2.0 * (np.arange(count) + 0.5) / count, turn)
    return [
        Camera.look_at(centre + 4.5 * radius * d, centre, width=256, height=256, fov_x=29.0, near=0.1 * radius)
        for d in outward
    ]
