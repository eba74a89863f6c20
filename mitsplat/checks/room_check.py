"""Check that the objects of a scene find room in their regions: by volume, and by start poses of the first layouts."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from mitsplat.errors import InputError
from mitsplat.findings import Finding
from mitsplat.physics.placement import Item
from mitsplat.physics.settle import warp_settings
from mitsplat.physics.start_poses import StartPoses
from mitsplat.physics.static_scene import StaticScene
from mitsplat.progress import discard_note
from mitsplat.scene.planning.contents import draw_arrangements, draw_objects, draw_regions
from mitsplat.scene.scene import Scene
from mitsplat.scene.streams import random_stream

MAX_FILL = 0.35
"""Maximum fraction of the region's volume for dropped objects; loose packing of boxes ends at about 0.6."""
MAX_LAYOUTS = 8
"""Maximum number of layouts whose start poses are drawn."""


def check_room(scene: Scene, *, draw: bool) -> Finding:
    """Compare the volume of the objects with that of the regions; with ``draw``, draw start poses too."""
    spec = scene.spec
    most = [entry.count[1] for entry in spec.objects]
    meshes = [[asset.mesh for i in pool if (asset := scene.assets[i]).mesh is not None] for pool in scene.pools]
    volumes = [max(float(np.prod(mesh.extents)) for mesh in pool) for pool in meshes]
    space = sum(float(np.prod(np.subtract(region.max, region.min))) for region, _ in spec.all_regions)
    fill = float(np.dot(most, volumes)) / space
    text, ok = f"at most {sum(most)} objects take {fill:.0%} of the region", fill <= MAX_FILL or not spec.objects
    if ok and draw:
        with suppress(InputError):  # another finding reports it
            crowded = _first_crowded_layout(scene)
            if crowded:
                text, ok = crowded, False
    return Finding("room", ok, text, "make the region larger, lower objects[].count, or use settle.arrangement: pile")


def _first_crowded_layout(scene: Scene) -> str:
    """Return a text about the first layout whose objects find no room, if such layouts would end a run; else empty.

    They do if their share exceeds ``settle.incomplete``, or if one of them has no room for half of its objects.
    """
    with warp_settings():
        from mitsplat.physics.drop import drop_of  # Newton reads these settings when it compiles

        drop, first, crowded = drop_of(scene, discard_note), "", 0
        layouts = min(scene.spec.output.layouts, MAX_LAYOUTS)
        for layout in range(layouts):
            static = drop.static_scenes[drop.static_key(layout)]
            text, half_fits = _crowded_regions(scene, layout, drop.start_poses, static)
            if not text:
                continue
            crowded += 1
            first = first or text
            if not half_fits:
                return text
            if crowded > scene.spec.settle.incomplete * layouts:
                return first
    return ""


def _crowded_regions(scene: Scene, layout: int, start_poses: StartPoses, static: StaticScene) -> tuple[str, bool]:
    """Describe the regions that are too small for the objects of a layout; empty if all objects find room.

    The text begins with the key of the first of them. These are all regions of its objects if each of them has room
    without the others. The second value is True if half of the objects find room.
    """
    spec = scene.spec
    arrangements = draw_arrangements(spec, layout)

    def has_room(items: list[Item]) -> bool:
        rng = random_stream(spec.seed, "object poses", layout, 0)
        return start_poses.find(items, static, rng, arrangements) is not None

    drawn = zip(*draw_objects(scene, layout), draw_regions(spec, layout), strict=True)
    items = [start_poses.item(*one) for one in drawn]
    if has_room(items):
        return "", True
    contents = {region: [item for item in items if item.region == region] for region in {item.region for item in items}}
    crowded = [region for region, some in contents.items() if len(contents) > 1 and not has_room(some)]
    shown = crowded or list(contents)
    texts = [f"{len(contents[one])} objects in {spec.region_names[one]}, {arrangements[one]}" for one in shown]
    key = "region" if shown[0] == 0 else f"regions[{shown[0] - 1}]"
    text = f"{key} has no room for all objects of layout {layout} at the start: {'; '.join(texts)}"
    return text, has_room(items[: -(-len(items) // 2)])
