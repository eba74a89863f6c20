"""Loading of scene files: from YAML or Python to a checked :class:`~mitsplat.scene.scene.Scene`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import trimesh

from mitsplat.arguments import check_type, path_of
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.scene.loading.references import LoadedFiles, errors_at_key, expand_patterns, load_files, shape_mesh
from mitsplat.scene.planning.conveyor import check_belt
from mitsplat.scene.planning.viewpoints import camera_at
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.named_files import environments, object_assets
from mitsplat.scene.spec.object_spec import MAIN_REGION
from mitsplat.scene.spec.scene_spec import SCHEMA_VERSION, SceneSpec
from mitsplat.scene.spec.shape_spec import Region
from mitsplat.scene.walls import backdrop_shapes, enclosure_walls
from mitsplat.storage.calibration_files import refuse_calibration
from mitsplat.storage.field_types import validate_again
from mitsplat.storage.file_kinds import refuse_other_kinds
from mitsplat.storage.files import JsonObject
from mitsplat.storage.yaml_input import key_place, load_yaml

_PYTHON_SCENE_NAME = "<python>.yaml"
"""File name of scenes made in Python. No such file exists; error messages begin with it, and datasets store the scene
there.
"""


def load_scene(
    path: str | Path, *, overrides: Mapping[str, object] | None = None, allow_outside: bool = False
) -> Scene:
    """Read a scene file and all assets, meshes and images that it names, and validate them.

    Args:
        path: The YAML file.
        overrides: Values that replace those of the file, by dotted key, such as ``{"output.width": 640}``.
        allow_outside: Allow assets, meshes and images outside of the scene's folder.

    Raises:
        InputError: If the scene file or a file that it names is missing or invalid.
    """
    path = path_of(path, "path")
    refuse_calibration(path, "must be a scene file (.yaml)")
    refuse_other_kinds(path, "a scene file (.yaml)", ".yaml", ".yml")
    return _build_scene(load_yaml(path, SceneSpec, overrides=overrides), path, allow_outside=allow_outside)


def make_scene(spec: SceneSpec, folder: str | Path = ".") -> Scene:
    """Create a scene from a specification made in Python. Only the files that it names are read.

    Args:
        spec: The scene, created by ``ms.SceneSpec(name=..., region={"min": ...}, ...)``. Its keys are those of scene
            files; a part can be a model or a mapping. It may name files anywhere. A changed copy of another
            specification is made by ``scene.spec.model_copy(update={"composite": {"exposure": "fixed"}})``.
        folder: Folder to which paths are relative [the working directory].

    Raises:
        InputError: If a value of the specification is invalid, or a named file is missing or invalid.
    """
    check_type(
        spec, SceneSpec, "spec", "create it by mitsplat.SceneSpec(name=..., ...), or use mitsplat.load_scene(path)"
    )
    return _build_scene(validate_again(spec), Path(folder) / _PYTHON_SCENE_NAME, allow_outside=True)


def _build_scene(spec: SceneSpec, path: Path, *, allow_outside: bool) -> Scene:
    """Return the scene of a specification."""
    spec = expand_patterns(spec, path, allow_outside=allow_outside)
    _check_lens(spec, path)
    _check_hold_out(spec, path)
    with errors_at_key(path, "conveyor", "belt"):
        check_belt(spec)
    if spec.backdrop is not None:
        spec = spec.model_copy(update={"shapes": (*spec.shapes, *backdrop_shapes(spec.backdrop)), "backdrop": None})
    named = load_files(spec, path)
    with errors_at_key(path, "environment"):
        surroundings = tuple(map(_check_units, named.environments))
    assets = _sized_objects(spec, path, named)
    spec, shape_meshes = _expand_enclosures(spec, named, assets)
    return Scene(
        spec=spec,
        path=path,
        environments=surroundings,
        assets=assets,
        shape_meshes=shape_meshes,
        class_names=_class_names(spec, assets),
        images=named.images,
    )


def _sized_objects(spec: SceneSpec, path: Path, named: LoadedFiles) -> tuple[Asset, ...]:
    """Return the asset of each entry at each of its scales. Entries that differ only in count and class share arrays.

    Raises:
        InputError: If an asset has unknown size, cannot be dropped, or does not fit into its region.
    """
    sized: dict[tuple[str, float | None, float], Asset] = {}
    assets = []
    for keys, name, entry in object_assets(spec):
        for scale in entry.scales:
            key = (name, entry.size, scale)
            if key not in sized:
                with errors_at_key(path, *keys):
                    asset = named.assets[name]
                    asset = _check_units(asset) if entry.size is None else asset.resized(entry.size)
                    sized[key] = asset if scale == 1.0 else asset.scaled(scale)
                    _check_object(sized[key])
            with errors_at_key(path, *keys):
                for number in spec.regions_of(entry) if not entry.poses or not spec.regions else ():
                    _check_fit(sized[key], spec.all_regions[number][0], spec.region_names[number])
            assets.append(replace(sized[key], class_name=entry.class_name or sized[key].class_name))
    return tuple(assets)


def _class_names(spec: SceneSpec, assets: Sequence[Asset]) -> tuple[str, ...]:
    """Return the sorted class names of labelled objects."""
    entries = [entry for _, _, entry in object_assets(spec) for _ in entry.scales]
    return tuple(sorted({asset.class_name for entry, asset in zip(entries, assets, strict=True) if entry.label}))


def _expand_enclosures(
    spec: SceneSpec, named: LoadedFiles, assets: tuple[Asset, ...]
) -> tuple[SceneSpec, tuple[trimesh.Trimesh, ...]]:
    """Return the specification with enclosures expanded to shapes, and the mesh of every shape."""
    enclosures = (spec.enclosure, *(region.enclosure for region in spec.regions))
    if not any(enclosures):
        return spec, named.shape_meshes
    supports = [mesh for shape, mesh in zip(spec.shapes, named.shape_meshes, strict=True) if shape.collider]
    if spec.environment_collides:
        supports += [environment.mesh for environment in named.environments if environment.mesh is not None]
    around = [enclosure_walls(one, spec, assets, supports, i) for i, one in enumerate(enclosures) if one is not None]
    walls = [wall for some in around for wall in some]
    meshes = tuple(shape_mesh(wall, Path()) for wall in walls)  # boxes, without files
    regions = tuple(region.model_copy(update={"enclosure": None}) for region in spec.regions)
    update = {"shapes": (*spec.shapes, *walls), "enclosure": None, "regions": regions}
    return spec.model_copy(update=update), (*named.shape_meshes, *meshes)


def _check_lens(spec: SceneSpec, path: Path) -> None:
    """Check that the intrinsics are valid for the image size: the distortion must not fold inside the image."""
    with errors_at_key(path, "camera", "intrinsics", *(["distortion"] if spec.camera.intrinsics.distortion else [])):
        try:
            camera_at(np.eye(4), spec.camera.intrinsics, spec.output)
        except ValueError as error:
            raise InputError(str(error)) from error


def _check_hold_out(spec: SceneSpec, path: Path) -> None:
    """Check that held-out assets and environments exist, and that training keeps an environment."""
    named = {
        "assets": {name for _, name, _ in object_assets(spec)},
        "environments": {name for _, name in environments(spec)},
    }
    for kind, known in named.items():
        held_out = getattr(spec.hold_out, kind)
        for number, name in enumerate(held_out):
            if name not in known:
                place, listed = key_place(path, ("hold_out", kind, number)), ", ".join(sorted(known)) or "none"
                raise InputError(f"{place}: must be among the {kind} of the scene, {listed} (got {name})")
    if spec.hold_out.environments and named["environments"] <= set(spec.hold_out.environments):
        place = key_place(path, ("hold_out", "environments"))
        raise InputError(
            f"{place}: must leave at least one environment for training (got all {len(named['environments'])})"
        )


def scene_json_schema() -> JsonObject:
    """Return the JSON schema of scene files, for editors."""
    named = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"urn:mitsplat:scene:{SCHEMA_VERSION}"}
    return {**named, **SceneSpec.model_json_schema()}


def _check_units(asset: Asset) -> Asset:
    """Return the asset unchanged if its units are known.

    Raises:
        InputError: If its units are unknown.
    """
    if asset.units == "unknown":
        raise InputError(
            f"asset {asset.name!r} has unknown units: set size, its longest extent [m], here or in asset.yaml"
        )
    return asset


def _check_object(asset: Asset) -> None:
    """Check that physics can move the asset."""
    if asset.kind != "object" or asset.mesh is None:
        raise InputError(f"asset {asset.name!r} must be of kind object and have a mesh for physics")


def _check_fit(asset: Asset, region: Region, name: str) -> None:
    """Check that an object fits into the region when it lies on its largest side."""
    where = "the region" if name == MAIN_REGION else f"region {name!r}"
    footprint = np.sort(cast(trimesh.Trimesh, asset.mesh).extents)[1:]  # every object has a mesh
    space = np.sort(np.subtract(region.max, region.min)[:2])
    if (footprint > space).any():
        raise InputError(
            f"asset {asset.name!r} must fit into {where} of {space[0]:.3g} x {space[1]:.3g} m "
            f"(it measures {footprint[0]:.3g} x {footprint[1]:.3g} m)"
        )
