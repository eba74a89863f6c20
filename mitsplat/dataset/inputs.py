"""Description of all inputs of a scene, compared when a dataset is resumed.

Inputs are keyed by their place in the scene file, not by name. Names need not be unique, and one asset may have another
size, scale or class in each entry.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import trimesh

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.scene.spec.light_spec import EnvironmentLight
from mitsplat.scene.spec.named_files import image_lists
from mitsplat.storage.content_hash import ContentHash, file_hash
from mitsplat.storage.files import JsonObject

if TYPE_CHECKING:
    from mitsplat.asset import Asset
    from mitsplat.scene.scene import Scene

_LOCATION_FIELDS = frozenset({"folder"})
"""Fields of an asset that describe its location instead of its content."""


def describe_inputs(scene: Scene) -> JsonObject:
    """Return a description of each input by its key, such as ``objects[1]``, ``environment`` or ``lights[0].image``.

    Assets are described by all their fields, after size, scale and class of the entry were applied. Splats, meshes and
    images are described by their SHA-256.
    """
    hashes = _InputHashes()
    found: JsonObject = {}
    for position, pool in enumerate(scene.pools):
        for number, asset in enumerate(pool):
            key = f"objects[{position}]" + (f"[{number}]" if len(pool) > 1 else "")
            found[key] = hashes.describe_asset(scene.assets[asset])
    for number, environment in enumerate(scene.environments):
        key = "environment" + (f"[{number}]" if len(scene.environments) > 1 else "")
        found[key] = hashes.describe_asset(environment)
    for i, mesh in enumerate(scene.shape_meshes):
        found[f"shapes[{i}]"] = hashes.describe_value(mesh)
    for i, light in enumerate(scene.spec.lights):
        if isinstance(light, EnvironmentLight):
            for number, image in enumerate(light.names):
                key = "image" if light.image is not None else f"pool[{number}]"
                found[f"lights[{i}].{key}"] = file_hash(scene.images[image])
    for keys, images in image_lists(scene.spec):
        digest = ContentHash()
        for name in images:
            digest.add(file_hash(scene.images[name]))
        found[".".join(map(str, keys))] = digest.hexdigest()
    return found


class _InputHashes:
    """Descriptions of assets with hashes; splats and meshes that several assets share are hashed once."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[object, str]] = {}

    def describe_asset(self, asset: Asset) -> JsonObject:
        """Describe every field of an asset, so that fields added later are included."""
        names = [field.name for field in fields(asset) if field.name not in _LOCATION_FIELDS]
        return {name: self.describe_value(getattr(asset, name)) for name in names}

    def describe_value(self, value: object) -> object:
        """Convert a field to JSON."""
        if isinstance(value, Splats | trimesh.Trimesh):
            if id(value) not in self._known:
                digest = ContentHash()
                for array in _arrays_of(value):
                    digest.add_array(array)
                self._known[id(value)] = value, digest.hexdigest()  # holding the value keeps its id unique
            return self._known[id(value)][1]
        if isinstance(value, Mapping):
            return {name: self.describe_value(entry) for name, entry in value.items()}
        if isinstance(value, tuple):
            return [self.describe_value(entry) for entry in value]
        return value


def _arrays_of(value: Splats | SplatMaterials | trimesh.Trimesh) -> Iterator[npt.NDArray[np.generic]]:
    """Yield all arrays of splats, materials or a mesh."""
    if isinstance(value, trimesh.Trimesh):
        yield from (value.vertices, value.faces)
        return
    for field in fields(value):
        part = getattr(value, field.name)
        if isinstance(part, SplatMaterials):
            yield from _arrays_of(part)
        elif part is not None:
            yield part
