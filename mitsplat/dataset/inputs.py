"""Description of all inputs of a scene, compared when a dataset is resumed.

Inputs are keyed by their place in the scene file, not by name. Names need not be unique, and one asset may have another
size, scale or class in each entry.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import trimesh

from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.scene.spec.light_spec import EnvironmentLight
from mitsplat.scene.spec.named_files import image_lists
from mitsplat.storage.content_hash import ContentHash, file_hash

if TYPE_CHECKING:
    from mitsplat.asset import Asset
    from mitsplat.scene.scene import Scene

_LOCATION_FIELDS = frozenset({"folder"})
"""Fields of an asset that describe its location instead of its content."""


def describe_inputs(scene: Scene) -> dict[str, Any]:
    """Return a description of each input by its key, such as ``objects[1]``, ``environment`` or ``lights[0].image``.

    Assets are described by all their fields, after size, scale and class of the entry were applied. Splats, meshes and
    images are described by their SHA-256.
    """
    described = _Describer()
    found: dict[str, Any] = {}
    for position, pool in enumerate(scene.pools):
        for number, asset in enumerate(pool):
            key = f"objects[{position}]" + (f"[{number}]" if len(pool) > 1 else "")
            found[key] = described.asset(scene.assets[asset])
    for number, environment in enumerate(scene.environments):
        key = "environment" + (f"[{number}]" if len(scene.environments) > 1 else "")
        found[key] = described.asset(environment)
    for i, mesh in enumerate(scene.shape_meshes):
        found[f"shapes[{i}]"] = described.value(mesh)
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


class _Describer:
    """Descriptions of assets; splats and meshes that several assets share are hashed once."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[object, str]] = {}

    def asset(self, asset: Asset) -> dict[str, Any]:
        """Describe every field of an asset, so that fields added later are included."""
        return {f.name: self.value(getattr(asset, f.name)) for f in fields(asset) if f.name not in _LOCATION_FIELDS}

    def value(self, value: Any) -> Any:
        """Convert a field to JSON."""
        if isinstance(value, Splats | trimesh.Trimesh):
            if id(value) not in self._known:
                columns = [f.name for f in fields(value)] if isinstance(value, Splats) else ["vertices", "faces"]
                self._known[id(value)] = value, _hash(*[getattr(value, column) for column in columns])
            return self._known[id(value)][1]
        if isinstance(value, Mapping):
            return {name: self.value(entry) for name, entry in value.items()}
        if isinstance(value, tuple):
            return [self.value(entry) for entry in value]
        return value


def _hash(*arrays: Any) -> str:
    digest = ContentHash()
    for array in arrays:
        digest.add_array(array)
    return digest.hexdigest()
