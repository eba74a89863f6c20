"""Files that a scene file names: asset folders, meshes, images, and patterns that select them.

Errors name the key of the scene file that refers to the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import trimesh

from mitsplat.asset import ASSET_FILE, Asset, read_spec
from mitsplat.errors import InputError
from mitsplat.images.untrusted_images import check_images
from mitsplat.mesh_files.mesh_file import MeshFrame
from mitsplat.mesh_files.mesh_reading import read_mesh
from mitsplat.scene.loading.image_lists import WILDCARDS, glob_below, image_names, names_below
from mitsplat.scene.loading.primitives import make_primitives
from mitsplat.scene.spec.light_spec import EnvironmentLight
from mitsplat.scene.spec.material_spec import Material
from mitsplat.scene.spec.named_files import environments, image_lists, named_images, object_assets
from mitsplat.scene.spec.object_spec import PRIMITIVES
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.spec.shape_spec import Shape
from mitsplat.scene.streams import random_stream
from mitsplat.scene.walls import bin_walls, pose_matrix
from mitsplat.storage.files import is_inside
from mitsplat.storage.yaml_input import FieldError, KeyPath, key_place

_MAX_IMAGES_PER_PROCESS = 500
"""Maximum number of images that are tested in one process; their names are its arguments."""


@dataclass(frozen=True, eq=False)
class LoadedFiles:
    """Loaded files of a scene.

    Attributes:
        environments: Assets of the environments.
        assets: Assets of the objects, by their names in the scene file.
        shape_meshes: Mesh of each shape, in world space [m].
        images: Paths of the images, by their names in the scene file.
    """

    environments: tuple[Asset, ...]
    assets: Mapping[str, Asset]
    shape_meshes: tuple[trimesh.Trimesh, ...]
    images: Mapping[str, Path]


@contextmanager
def errors_at_key(path: Path, *keys: str | int) -> Iterator[None]:
    """Prepend the key of the scene file to the message of an input error."""
    try:
        yield
    except FieldError as error:
        raise InputError(f"{key_place(path, (*keys, *error.key))}: {error}") from error
    except InputError as error:
        raise InputError(f"{key_place(path, keys)}: {error}") from error


def expand_patterns(spec: SceneSpec, path: Path, *, allow_outside: bool) -> SceneSpec:
    """Return the specification with patterns replaced by the sorted names of the folders or images that they match.

    Raises:
        InputError: If nothing matches, or if a file is outside of the allowed folder.
    """
    if not allow_outside:
        _check_inside_folder(spec, path)
    spec = _matched_images(_matched_environments(spec, path, allow_outside), path, allow_outside)
    objects, lights = list(spec.objects), list(spec.lights)
    for position, entry in enumerate(objects):
        if isinstance(entry.pool, str) and entry.pool != PRIMITIVES:
            with errors_at_key(path, "objects", position, "pool"):
                names = _matched_assets(path.parent, entry.pool, "object", allow_outside=allow_outside)
            objects[position] = entry.model_copy(update={"pool": names})
    for position, light in enumerate(lights):
        if isinstance(light, EnvironmentLight) and isinstance(light.pool, str):
            with errors_at_key(path, "lights", position, "pool"):
                names = _checked_names(path.parent, image_names(path.parent, light.pool), allow_outside)
            lights[position] = light.model_copy(update={"pool": names})
    return spec.model_copy(update={"objects": tuple(objects), "lights": tuple(lights)})


def _checked_names(folder: Path, names: tuple[str, ...], allow_outside: bool) -> tuple[str, ...]:
    """Check that names do not lead out of the folder, unless that is allowed, and return them."""
    for name in () if allow_outside else names:
        _refuse_outside(folder, name)
    return names


def _matched_environments(spec: SceneSpec, path: Path, allow_outside: bool) -> SceneSpec:
    """Replace a pattern of environments by the names that match it."""
    pattern = spec.environment
    if not isinstance(pattern, str):
        return spec
    if WILDCARDS & set(pattern) and not (path.parent / pattern / ASSET_FILE).is_file():
        with errors_at_key(path, "environment"):
            names = _matched_assets(path.parent, pattern, "environment", allow_outside=allow_outside)
        spec = spec.model_copy(update={"environment": names})
    return spec


def _matched_images(spec: SceneSpec, path: Path, allow_outside: bool) -> SceneSpec:
    """Replace the patterns of images of materials and of the background by the names that match them."""
    found = {}
    for keys, images in image_lists(spec):
        with errors_at_key(path, *keys):
            found[keys] = _checked_names(path.parent, image_names(path.parent, images), allow_outside)
    if not found:
        return spec

    def materials_of(*keys: str | int, among: Sequence[Material]) -> tuple[Material, ...]:
        lists = (found.get((*keys, number, "images")) for number in range(len(among)))
        return tuple(
            material if images is None else material.model_copy(update={"images": images})
            for material, images in zip(among, lists, strict=True)
        )

    shapes = tuple(
        shape.model_copy(update={"materials": materials_of("shapes", number, "materials", among=shape.materials)})
        for number, shape in enumerate(spec.shapes)
    )
    spec = spec.model_copy(update={"shapes": shapes})
    if spec.backdrop is not None:
        materials = {
            key: materials_of("backdrop", key, among=getattr(spec.backdrop, key)) for key in ("floor", "walls")
        }
        spec = spec.model_copy(update={"backdrop": spec.backdrop.model_copy(update=materials)})
    if spec.background is None:
        return spec
    background = spec.background.model_copy(update={"images": found["background", "images"]})
    return spec.model_copy(update={"background": background})


def _matched_assets(
    folder: Path, pattern: str, kind: Literal["object", "environment"], *, allow_outside: bool
) -> tuple[str, ...]:
    """Return the names of the assets of a kind that match a pattern: their folders, relative to ``folder``."""
    found = [path for path in glob_below(folder, pattern) if (path / ASSET_FILE).is_file()]
    named = _checked_names(folder, names_below(folder, pattern, found), allow_outside)
    names = tuple(name for name in named if read_spec(folder / name).kind == kind)
    if not names:
        raise InputError(f"must match at least one asset folder of kind {kind} (got {pattern!r}, which matches none)")
    return names


def _check_inside_folder(spec: SceneSpec, path: Path) -> None:
    """Check that all named files are inside the scene's folder."""
    named: list[tuple[KeyPath, str | None]] = [*environments(spec)]
    named += [(keys, name) for keys, name, _ in object_assets(spec)]
    patterns = ((i, entry.pool) for i, entry in enumerate(spec.objects))
    named += [(("objects", i, "pool"), pattern) for i, pattern in patterns if isinstance(pattern, str)]
    named += [(("shapes", position, "mesh"), shape.mesh) for position, shape in enumerate(spec.shapes)]
    named += named_images(spec)
    skies = ((i, getattr(light, "pool", None)) for i, light in enumerate(spec.lights))
    named += [(("lights", i, "pool"), pattern) for i, pattern in skies if isinstance(pattern, str)]
    for keys, name in named:
        if name is not None:
            with errors_at_key(path, *keys):
                _refuse_outside(path.parent, name)


def _refuse_outside(folder: Path, name: str) -> None:
    if not is_inside(folder, name):
        raise InputError(f"must be inside the scene's folder (got {name:.200}); --allow-outside permits other folders")


def load_files(spec: SceneSpec, path: Path) -> LoadedFiles:
    """Read every asset and mesh that a scene file names once, and test the images, which Mitsuba reads later.

    Raises:
        InputError: If a file is missing or damaged.
    """
    folder = path.parent
    places, assets, shape_meshes = list[Asset](), dict[str, Asset](), []
    for keys, name in environments(spec):
        with errors_at_key(path, *keys):
            places.append(Asset.load(folder / name))
    for keys, name, entry in object_assets(spec):
        if entry.pool == PRIMITIVES:
            streams = (random_stream(spec.seed, "primitive", number) for number in range(len(entry.names)))
            assets |= {} if name in assets else dict(zip(entry.names, make_primitives(streams), strict=True))
        elif name not in assets:
            with errors_at_key(path, *keys):
                assets[name] = Asset.load(folder / name)
    for position, shape in enumerate(spec.shapes):
        with errors_at_key(path, "shapes", position, "mesh"):
            shape_meshes.append(shape_mesh(shape, folder))
    images = {name: folder / name for _, name in named_images(spec)}
    _check_images(spec, path, images)
    return LoadedFiles(tuple(places), assets, tuple(shape_meshes), images)


def _check_images(spec: SceneSpec, path: Path, images: Mapping[str, Path]) -> None:
    """Check that images exist and that Mitsuba can read them safely."""
    named = list(named_images(spec))
    for keys, name in named:
        with errors_at_key(path, *keys):
            if not images[name].is_file():
                raise InputError(f"{images[name]}: no such file")
    for start in range(0, len(named), _MAX_IMAGES_PER_PROCESS):
        batch = named[start : start + _MAX_IMAGES_PER_PROCESS]
        for (keys, _), reason in zip(batch, check_images([images[name] for _, name in batch]), strict=True):
            if reason is not None:
                raise InputError(f"{key_place(path, keys)}: {reason}")


def shape_mesh(shape: Shape, folder: Path) -> trimesh.Trimesh:
    """Return the mesh of a shape in world space [m]. File names are relative to ``folder``."""
    if shape.bin is not None:
        walls: trimesh.Trimesh = trimesh.boolean.union(list(bin_walls(shape.bin)))
        return walls
    if shape.box is None:
        return read_mesh(folder / str(shape.mesh), frame=MeshFrame(shape.units, shape.up))
    box: trimesh.Trimesh = trimesh.creation.box(extents=shape.box.size, transform=pose_matrix(shape.box))
    return box
