"""Keys and paths of the files that a scene specification names."""

from __future__ import annotations

from collections.abc import Iterator

from mitsplat.scene.spec.light_spec import EnvironmentLight
from mitsplat.scene.spec.material_spec import ImageMaterial
from mitsplat.scene.spec.object_spec import ObjectSpec
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.storage.yaml_input import KeyPath


def object_assets(spec: SceneSpec) -> Iterator[tuple[KeyPath, str, ObjectSpec]]:
    """Yield key, folder and entry of every asset of the objects."""
    for position, entry in enumerate(spec.objects):
        for number, name in enumerate(entry.names):
            keys = ("asset",) if entry.asset is not None else ("pool", number)
            yield ("objects", position, *keys), name, entry


def environments(spec: SceneSpec) -> list[tuple[KeyPath, str]]:
    """Return key and folder of every environment."""
    if isinstance(spec.environment, str):
        return [(("environment",), spec.environment)]
    return [(("environment", number), name) for number, name in enumerate(spec.environment or ())]


def light_images(spec: SceneSpec) -> Iterator[tuple[KeyPath, str]]:
    """Yield key and file of every image of the lights."""
    for position, light in enumerate(spec.lights):
        if isinstance(light, EnvironmentLight):
            for number, name in enumerate(light.names):
                yield ("lights", position, *(("image",) if light.image is not None else ("pool", number))), name


def image_lists(spec: SceneSpec) -> Iterator[tuple[KeyPath, str | tuple[str, ...]]]:
    """Yield key and names of the images of each material and of the background.

    The specification of a loaded scene contains no patterns.
    """
    for position, shape in enumerate(spec.shapes):
        for number, material in enumerate(shape.materials):
            if isinstance(material, ImageMaterial):
                yield ("shapes", position, "materials", number, "images"), material.images
    if spec.backdrop is not None:
        for key in ("floor", "walls"):
            for number, material in enumerate(getattr(spec.backdrop, key)):
                if isinstance(material, ImageMaterial):
                    yield ("backdrop", key, number, "images"), material.images
    if spec.background is not None:
        yield ("background", "images"), spec.background.images


def named_images(spec: SceneSpec) -> Iterator[tuple[KeyPath, str]]:
    """Yield key and file of every image that the specification names."""
    yield from light_images(spec)
    for keys, images in image_lists(spec):
        yield from ((keys, name) for name in ([images] if isinstance(images, str) else images))
