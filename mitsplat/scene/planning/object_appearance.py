"""Random appearance of the objects of a layout.

The seed, the index of the layout and the instance id determine the appearance. Every value has a random stream of its
own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mitsplat.images.colour import hue_matrix, saturation_matrix
from mitsplat.scene.layout import Instance, Layout
from mitsplat.scene.scene import Scene
from mitsplat.scene.streams import random_stream
from mitsplat.storage.files import JsonObject

WEAR_SEEDS = 1 << 23
"""Number of dirt patterns. Their indices are exact in single precision."""


@dataclass(frozen=True)
class ObjectAppearance:
    """Appearance drawn for an object.

    Attributes:
        id: Instance id.
        entry: Index of its entry in ``objects`` of the scene file.
        hue: Rotation about the grey axis [degrees].
        saturation: Factor on the distance from grey.
        value: Factor on the reflectance.
        gain: Factors on red, green and blue.
        roughness: GGX roughness of the highlight.
        specular: Specular reflectance at normal incidence.
        wear: Share of light that dirt absorbs where it is thickest.
        wear_seed: Seed of the dirt pattern.
    """

    id: int
    entry: int
    hue: float
    saturation: float
    value: float
    gain: tuple[float, float, float]
    roughness: float
    specular: float
    wear: float
    wear_seed: int

    def to_json(self) -> JsonObject:
        """Return the appearance as JSON values for the manifest."""
        return {**vars(self), "gain": list(self.gain)}

    def properties(self) -> dict[str, float | str]:
        """Return properties for the shape plugin ``splats``. Unchanged colours and absent dirt have no property."""
        matrix = np.diag(np.multiply(self.gain, self.value)) @ saturation_matrix(self.saturation) @ hue_matrix(self.hue)
        found: dict[str, float | str] = {"roughness": self.roughness, "specular": self.specular}
        if (self.hue, self.saturation, self.value, *self.gain) != (0.0, 1.0, 1.0, 1.0, 1.0, 1.0):
            found["colours"] = " ".join(repr(float(number)) for number in matrix.ravel())
        if self.wear:
            found |= {"wear": self.wear, "wear_seed": self.wear_seed}
        return found


@lru_cache(maxsize=2)
def draw_appearances(scene: Scene, layout: Layout) -> dict[int, ObjectAppearance]:
    """Draw the appearances of the objects of a layout whose entries define ranges; cached for its next frame.

    Returns:
        Appearances by instance id.
    """
    if not any(entry.appearance for entry in scene.spec.objects):
        return {}
    entries = {asset: entry for entry, pool in enumerate(scene.pools) for asset in pool}
    found = (_draw(scene, layout.index, one, entries[one.asset]) for one in layout.instances)
    return {one.id: one for one in found if one is not None}


def _draw(scene: Scene, layout: int, instance: Instance, entry: int) -> ObjectAppearance | None:
    """Draw the appearance of one object; None if its entry defines no ranges."""
    ranges, asset = scene.spec.objects[entry].appearance, scene.assets[instance.asset]
    if ranges is None:
        return None

    def stream(name: str) -> np.random.Generator:
        return random_stream(scene.spec.seed, f"appearance {name}", layout, instance.id)

    def uniform(name: str, bounds: tuple[float, float] | None, asset_value: float) -> float:
        return asset_value if bounds is None else float(stream(name).uniform(*bounds))

    red, green, blue = stream("gain").uniform(*ranges.gain, 3).tolist()
    return ObjectAppearance(
        id=instance.id,
        entry=entry,
        hue=uniform("hue", ranges.hue, 0.0),
        saturation=uniform("saturation", ranges.saturation, 1.0),
        value=uniform("value", ranges.value, 1.0),
        gain=(red, green, blue),
        roughness=uniform("roughness", ranges.roughness, float(asset.roughness)),
        specular=uniform("specular", ranges.specular, float(asset.specular)),
        wear=uniform("wear", ranges.wear, 0.0),
        wear_seed=int(stream("wear seed").integers(WEAR_SEEDS)),
    )
