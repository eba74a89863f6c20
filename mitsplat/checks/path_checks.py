"""Checks of an asset or a scene before a long run, with a remedy for each problem."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import QhullError

from mitsplat.arrays import Float64Array
from mitsplat.asset import ASSET_FILE, Asset, opaque_core
from mitsplat.checks.exposure_check import check_exposure
from mitsplat.checks.lamp_check import check_lamps
from mitsplat.checks.room_check import check_room
from mitsplat.checks.scene_warnings import scene_warnings
from mitsplat.dataset.preflight import run_faults
from mitsplat.errors import InputError
from mitsplat.findings import Finding
from mitsplat.formats.registry import Catalogue
from mitsplat.geometry.coplanar import coplanar_place
from mitsplat.geometry.mesh import closed_solid
from mitsplat.geometry.solids import is_closed, signed_volume
from mitsplat.physics.settle import try_alone, warp_settings
from mitsplat.reconstruct.registration import measure_offset
from mitsplat.reconstruct.segment_splats import find_floaters, long_needles, visible_area
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.planning.view_diagnosis import pose_cause
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.named_files import environments, object_assets
from mitsplat.scene.spec.scene_spec import BACKDROP, SceneSpec
from mitsplat.storage.yaml_input import KeyPath, key_place

SIZE_LIMITS = {"object": (0.002, 2.0), "environment": (0.2, 100.0)}
"""Expected range of the longest extent by kind of asset [m]."""
DENSITY_LIMITS = (20.0, 22600.0)
"""Expected range of mass density, from foam to osmium [kg/m^3]."""
MAX_FAULTY = 0.01
"""Fraction of Gaussians up to which needles and floaters are acceptable."""
MIN_OPACITY = 1 / 255
MIN_OVERLAP = 0.5
MAX_OFFSET = 0.02
MAX_KEYPOINT_DISTANCE = 10.0
"""Maximum distance of keypoints from the object, in longest extents; the poses of a gripper can lie beside it."""
MAX_SPREAD = 0.05
"""Maximum median distance between splats and mesh, as a fraction of the mesh's diagonal."""
MIN_SPREAD_DIFFERENCE = 0.5
"""Relative difference of spreads above which an environment that is thinner along x or y seems to lie on its side."""


_ASSET_KEYS: Mapping[str, KeyPath] = {
    "units": ("units",),
    "up axis": ("up",),
    **dict.fromkeys(("splats", "needles", "floaters", "opacity", "spherical harmonics"), ("splats",)),
    **dict.fromkeys(("mesh", "overlap", "offset", "watertightness"), ("mesh",)),
    "mass": ("mass",),
    "colliders": ("pieces",),
    "keypoints": ("keypoints",),
}
"""Keys of ``asset.yaml`` by the names of findings."""
_SCENE_KEYS: Mapping[str, KeyPath] = {
    "formats": ("output", "formats"),
    **dict.fromkeys(("count", "rest", "settling", "size"), ("objects",)),
    **dict.fromkeys(("frames", "memory", "disk"), ("output",)),
    **dict.fromkeys(("visibility", "views", "labels"), ("camera",)),
    **dict.fromkeys(("shape", "bin", "support", "surfaces"), ("shapes",)),
    **dict.fromkeys(("light", "lights", "exposure"), ("lights",)),
    **dict.fromkeys(("room", "region"), ("region",)),
    "time": ("settle",),
    "lens": ("camera", "intrinsics"),
    "backdrop": ("backdrop",),
    "kernel": ("rendering",),
}
"""Keys of scene files by the names of findings."""


def check_path(path: Path, *, allow_outside: bool = False) -> Iterator[Finding]:
    """Yield the findings for an asset folder, or for a scene file with all files that it names.

    Raises:
        InputError: If it cannot be read at all.
    """
    if path.is_dir():
        yield from check_asset(Asset.load(path))
        return
    for finding in check_scene(load_scene(path, allow_outside=allow_outside)):
        yield _located(finding, path, _SCENE_KEYS)


def _located(finding: Finding, file: Path, keys: Mapping[str, KeyPath]) -> Finding:
    """Return a problem with the line of the key to change: the one that its text begins with, or that of its name."""
    if finding.ok or finding.place:
        return finding
    begin = re.match(r"([a-z_]+)(?:\[(\d+)\])?((?:\.[a-z_]+)*)(?=[: ])", finding.text)
    key = keys.get(finding.name, ())
    if begin and begin[1] in SceneSpec.model_fields and file.name != ASSET_FILE:
        number = () if begin[2] is None else (int(begin[2]),)
        key = (begin[1], *number, *begin[3].split(".")[1:])
    return replace(finding, place=key_place(file, key)) if key else finding


def check_asset(asset: Asset) -> Iterator[Finding]:
    """Yield one finding for each property of an asset that is checked."""
    for finding in _asset_findings(asset):
        yield finding if asset.folder is None else _located(finding, asset.folder / ASSET_FILE, _ASSET_KEYS)


def _asset_findings(asset: Asset) -> Iterator[Finding]:
    """Yield the findings for splats, units, up axis, mesh, mass and keypoints of an asset."""
    splats = asset.splats
    core = opaque_core(splats).astype(np.float64)
    if not len(core):
        yield Finding("splats", False, f"none of {len(splats)} is opaque", "fit or bake the asset again")
        return
    yield Finding("splats", True, f"{len(splats)}, all values finite")  # loading refuses non-finite values
    extents = np.ptp(core, axis=0) if asset.mesh is None else asset.mesh.extents
    size = float(extents.max())
    yield _units(asset, size)
    yield _up(asset, core)
    yield from _gaussians(asset, size)
    yield from _mesh(asset, core)
    if asset.keypoints:
        yield _keypoints(asset, core)


def _units(asset: Asset, size: float) -> Finding:
    low, high = SIZE_LIMITS[asset.kind]
    if asset.units == "unknown":
        return Finding("units", False, "unknown", "measure the longest extent and give it as size [m] in asset.yaml")
    factor = next((factor for factor in (1e-3, 1e3, 0.01, 100.0) if low <= size * factor <= high), None)
    hint = "set units or size in asset.yaml"
    if factor is not None:
        error = f"{factor:g} times too small" if factor > 1 else f"{1 / factor:g} times too large"
        hint = f"are units (1 by default) or size in asset.yaml {error}?"
    return Finding("units", low <= size <= high, f"the longest extent is {size:.4g} m", hint)


def _up(asset: Asset, core: Float64Array) -> Finding:
    spread = core.std(axis=0)
    if asset.kind == "object":
        return Finding("up axis", True, "z; physics determines the resting pose of an object")
    thin = int(np.argmin(spread))
    tilted = thin != 2 and spread[thin] < (1 - MIN_SPREAD_DIFFERENCE) * spread[2]
    text = f"z; the environment is thinnest along {'xyz'[thin]}"
    return Finding("up axis", not tilted, text, f"if it lies on its side, set up: {'xyz'[thin]} (or -) in asset.yaml")


def _gaussians(asset: Asset, size: float) -> Iterator[Finding]:
    """Check the shares of long, isolated and invisible Gaussians, for an asset of a ``size`` [m], and its SH degree."""
    splats = asset.splats
    needles = long_needles(splats, size)
    share = float(needles.mean())
    remedy = "`mitsplat import` removes them; `mitsplat mesh` removes those outside of the object's masks"
    yield Finding("needles", share <= MAX_FAULTY, f"{needles.sum()} long ones ({share:.1%})", remedy)
    floaters = len(find_floaters(splats, visible_area(splats))) / len(splats)
    yield Finding(
        "floaters", floaters <= MAX_FAULTY, f"{floaters:.1%} of the Gaussians are connected to no large part", remedy
    )
    faint = float((splats.opacities < MIN_OPACITY).mean())
    yield Finding("opacity", faint <= 0.2, f"{faint:.0%} are invisible", "prune them: they only cost time")
    unused = splats.sh_degree > 0 and not splats.sh[:, 1:].any()
    text = f"degree {splats.sh_degree}{', but all coefficients are zero' if unused else ''}"
    yield Finding("spherical harmonics", not unused, text, "store degree 0: the colours do not change with the view")


def _mesh(asset: Asset, core: Float64Array) -> Iterator[Finding]:
    """Check that a mesh exists and agrees with the centres ``core`` (N, 3) of opaque Gaussians [m]."""
    mesh = asset.mesh
    if mesh is None:
        remedy = "nothing casts shadows, occludes or supports objects; `mitsplat mesh` creates a mesh"
        yield Finding("mesh", asset.kind == "environment", "none", remedy)
        return
    if asset.kind == "object":  # splats and mesh of an environment may each be incomplete
        overlap = _overlap(np.stack([core.min(axis=0), core.max(axis=0)]), mesh.bounds)
        yield Finding(
            "overlap", overlap > MIN_OVERLAP, f"the boxes of splats and mesh have an IoU of {overlap:.0%}",
            "make the mesh from the same photographs, or register it: `mitsplat mesh --import`",
        )  # fmt: skip
    with warp_settings():
        offset = measure_offset(mesh, core[:: max(1, len(core) // 4000)])
    yield Finding(
        "offset", offset.shift <= MAX_OFFSET and offset.spread <= MAX_SPREAD,
        f"splats are shifted by {offset.shift:.2%} and off by {offset.spread:.2%} of the mesh's diagonal",
        "register the mesh to the splats: `mitsplat mesh --import`",
    )  # fmt: skip
    closed = is_closed(mesh)
    yield Finding(
        "watertightness", closed or asset.kind == "environment",
        "closed" if closed else "open",
        "close it (`mitsplat mesh`, or a mesh editor); otherwise mass and inertia are those of its convex pieces",
    )  # fmt: skip
    if asset.kind == "object":
        yield from _mass(asset, mesh)
    if not asset.pieces:
        yield Finding("colliders", True, "none stored; convex pieces are computed at the first use")
        return
    joint = np.stack(
        [np.min([p.bounds[0] for p in asset.pieces], axis=0), np.max([p.bounds[1] for p in asset.pieces], axis=0)]
    )
    yield Finding(
        "colliders", _overlap(joint, mesh.bounds) > 0.8,
        f"{len(asset.pieces)} convex pieces; IoU of their box and the mesh's: {_overlap(joint, mesh.bounds):.0%}",
        "remove pieces from asset.yaml, so that they are computed from the mesh",
    )  # fmt: skip


def _keypoints(asset: Asset, core: Float64Array) -> Finding:
    """Find named points that seem to be in another unit: far from the object, or on it only if they are in metres."""
    points, names = asset.keypoint_array, list(asset.keypoints)
    low, high = (core.min(axis=0), core.max(axis=0)) if asset.mesh is None else asset.mesh.bounds
    size = float((high - low).max())

    def outside(points: Float64Array) -> Float64Array:
        distances: Float64Array = np.linalg.norm(np.maximum(0.0, np.maximum(low - points, points - high)), axis=1)
        return distances

    distances = outside(points)
    is_far = bool(distances.max() > MAX_KEYPOINT_DISTANCE * size)
    # One point at the origin is a common choice.
    is_small = len(points) > 1 and bool(outside(1000 * points).max() <= size)
    text = f"{len(points)} named points on the object or near it"
    if is_far:
        farthest = int(np.argmax(distances))
        text = f"{names[farthest]} lies {distances[farthest]:.3g} m from the object, which measures {size:.3g} m"
    elif is_small:
        reach = 1000 * float(np.linalg.norm(points, axis=1).max())
        text = f"all {len(points)} lie within {reach:.3g} mm of the origin, but the object measures {size:.3g} m"
    remedy = "give keypoints in the units of the asset's files, see units in asset.yaml"
    return Finding("keypoints", not (is_far or is_small), text, remedy)


def _mass(asset: Asset, mesh: trimesh.Trimesh) -> Iterator[Finding]:
    """Check the density that follows from the mass of an object and the volume of its mesh."""
    try:
        pieces = asset.pieces or (mesh.convex_hull,)
        volume = abs(signed_volume(closed_solid(mesh, pieces)))
    except QhullError:
        volume = 0.0
    if not 0 < volume < np.inf:
        yield Finding("mass", False, "its mesh spans no volume", "give it another mesh, or another size")
        return
    mass = asset.density * volume if asset.mass is None else asset.mass
    density = mass / volume
    has_solid = is_closed(mesh) or bool(asset.pieces)
    hull = "" if has_solid else " if it fills its convex hull; its convex pieces are not computed yet"
    yield Finding(
        "mass", DENSITY_LIMITS[0] <= density <= DENSITY_LIMITS[1], f"{mass:.3g} kg, of {density:.0f} kg/m^3{hull}",
        "set mass [kg] or density [kg/m^3] in asset.yaml; a wrong unit of length shows here too",
    )  # fmt: skip


def check_scene(scene: Scene) -> Iterator[Finding]:
    """Yield the findings for a scene, and the problems of each of its assets, prefixed with the asset's name."""
    spec = scene.spec
    try:
        Catalogue.of(scene)
    except InputError as error:
        yield Finding("formats", False, str(error), "change output.formats, or meet their requirements")
    faults = list(run_faults(scene))
    yield from faults or scene_warnings(scene)
    for sizes in _assets_by_folder(scene):
        name = sizes[0].name
        wrong = dict.fromkeys(finding for asset in sizes for finding in check_asset(asset) if not finding.ok)
        for finding in wrong:
            yield replace(finding, name=f"{name}: {finding.name}")
        if not wrong:
            yield Finding(name, True, f"{len(sizes[0].splats)} Gaussians, no problems")
    support = any(shape.collider and not shape.name.startswith("enclosure ") for shape in spec.shapes)
    support |= spec.environment_collides and bool(scene.environments)
    text = "a collider supports objects" if support else "there is no collider below objects"
    yield Finding("support", support or not spec.objects, text, "add a table to shapes, or set environment_collides")
    yield check_room(scene, draw=support and not faults)
    if support and not faults:
        yield from _check_rest(scene)
    yield _check_view(scene)
    yield from _check_surfaces(scene)
    yield from _list_mesh_sizes(scene)
    yield from _check_kernel(scene)
    remedy = "add one to lights, or set capture_light: scene in assets"
    yield Finding("light", scene.is_lit, f"{len(spec.lights)} lights", remedy)
    if scene.is_lit and not faults:
        yield from check_lamps(scene)
        yield check_exposure(scene)


def _assets_by_folder(scene: Scene) -> Iterator[list[Asset]]:
    """Yield each asset in all its sizes in a scene, grouped by folder because names need not be unique."""
    folders = [folder for _, folder in environments(scene.spec)]
    folders += [folder for _, folder, entry in object_assets(scene.spec) for _ in entry.scales]
    found: dict[str, dict[int, Asset]] = {}
    for folder, asset in zip(folders, (*scene.environments, *scene.assets), strict=True):
        found.setdefault(folder, {})[id(asset.splats)] = asset
    for sizes in found.values():
        yield list(sizes.values())


def _check_rest(scene: Scene) -> Iterator[Finding]:
    """Report the objects that do not come to rest even if they are settled alone."""
    rested = set()
    try:
        for name, arrangement, refused in try_alone(scene):
            if not refused:
                rested.add(name)
                continue
            reason, times = Counter(refused).most_common(1)[0]
            problem = f"it{reason.removeprefix(name)}" if reason.startswith(f"{name} ") else reason
            text = f"{name} cannot take arrangement {arrangement}: {problem} in {times} of {len(refused)} tries"
            remedy = "choose another settle.arrangement, correct its mesh or up axis, or remove it from objects"
            yield Finding("rest", False, text, remedy)
    except InputError as error:
        yield Finding("rest", False, str(error), "change what objects rest on, or their region")
    if rested:
        yield Finding("rest", True, f"{len(rested)} of the objects, each tried alone, come to rest")


def _list_mesh_sizes(scene: Scene) -> Iterator[Finding]:
    """List the sizes of shapes from mesh files, which show wrong units and axes."""
    sizes = [
        f"{shape.name} is {' x '.join(f'{extent:.3g}' for extent in mesh.extents)} m"
        for shape, mesh in zip(scene.spec.shapes, scene.shape_meshes, strict=True)
        if shape.mesh is not None
    ]
    if sizes:
        yield Finding("shapes", True, "; ".join(sizes))


def _check_surfaces(scene: Scene) -> Iterator[Finding]:
    """Name the pairs of visible shapes of different looks that share a plane, so that it is random which one shows."""
    eyes = [plan_frame(scene, index).camera.centre for index in _sampled_views(scene)]
    shown = [pair for pair in zip(scene.spec.shapes, scene.shape_meshes, strict=True) if pair[0].visible]
    for (one, mesh), (other, beside) in combinations(shown, 2):
        of_backdrop = all(shape.name.startswith(BACKDROP) for shape in (one, other))
        if of_backdrop or (one.colour == other.colour and not one.materials and not other.materials):
            continue
        if (place := coplanar_place(mesh, beside, eyes)) is not None:
            at = ", ".join(f"{value:.4g}" for value in place)
            text = f"shapes {one.name!r} and {other.name!r} have faces in one plane, for example at [{at}]"
            yield Finding("surfaces", False, text, "move one of them by 0.1 mm or more: both show in random spots")


def _check_kernel(scene: Scene) -> Iterator[Finding]:
    """Compare the kernel of the scene with those that its splat files state."""
    drawn, kernel = (*scene.environments, *scene.assets), scene.splat_options["kernel"]
    stated = {asset.name: asset.splats.kernel for asset in drawn if asset.splats.kernel}
    if stated:
        text = ", ".join(f"{name}: {trained}" for name, trained in stated.items())
        yield Finding(
            "kernel", kernel == "mip" or "mip" not in stated.values(),
            f"rendering.kernel is {kernel}; kernels of the training: {text}",
            "set rendering.kernel to mip, or leave it out: such splats look dotted or too dense with other kernels",
        )  # fmt: skip


def _sampled_views(scene: Scene) -> range:
    return range(0, scene.num_frames, max(1, scene.num_frames // 24))


def _check_view(scene: Scene) -> Finding:
    """Check that most views show the place where objects are dropped: the centre of a region, at its bottom."""
    corners = np.array([(region.min, region.max) for region, _ in scene.spec.all_regions])
    middles = np.column_stack([corners.mean(axis=1)[:, :2], corners[:, 0, 2]])
    views = _sampled_views(scene)
    blind = []
    for index in views:
        camera = plan_frame(scene, index).camera
        pixels, depths = camera.project(middles)
        inside = camera.contains(pixels)
        if not (inside & (depths > camera.near)).any():
            blind.append(index)
    where = "a region" if len(middles) > 1 else "the region"
    text = f"{len(views) - len(blind)} of {len(views)} views show the middle of {where}"
    remedy = f"turn the camera there: `mitsplat preview --frame {blind[0] if blind else 0}` shows one that does not"
    if blind and getattr(scene.spec.camera, "world_from_camera", None) is not None:
        camera = plan_frame(scene, blind[0]).camera
        remedy = pose_cause(camera, middles.min(axis=0), middles.max(axis=0)) or remedy
    return Finding("visibility", len(blind) * 2 <= len(views), text, remedy)


def _overlap(one: Float64Array, other: Float64Array) -> float:
    """Return the intersection over union of two boxes (2, 3); flat boxes get a small thickness."""
    thin = 1e-3 * float(max(np.ptp(one, axis=0).max(), np.ptp(other, axis=0).max()))
    grown = [box + np.array([[-thin], [thin]]) for box in (one, other)]
    common = np.minimum(grown[0][1], grown[1][1]) - np.maximum(grown[0][0], grown[1][0])
    shared = float(np.prod(np.maximum(common, 0)))
    return shared / (sum(float(np.prod(np.ptp(box, axis=0))) for box in grown) - shared)
