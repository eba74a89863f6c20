"""Start poses of a scene's objects among its static obstacles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.mesh_distance import PlacedSurface, all_clearances
from mitsplat.physics.bodies import Part
from mitsplat.physics.certificate import MAX_MEASURED_GAP
from mitsplat.physics.placement import Item, draw_poses
from mitsplat.physics.static_scene import StaticScene
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.scene.walls import pose_matrix

_MAX_START_OVERLAP = 1e-3  # maximum overlap of start poses from the scene file [m]


@dataclass(frozen=True, eq=False)
class StartPoses:
    """Start poses of a scene's objects; ``objects`` holds the physical part of each asset."""

    scene: Scene
    objects: Sequence[Part]

    def placed(self, asset: int, pose: Float64Array) -> PlacedSurface:
        """Return the mesh of an asset at a pose (4, 4)."""
        return PlacedSurface(self.scene.assets[asset].name, self.objects[asset].surface, pose)

    def item(self, asset: int, pose: Float64Array | None = None, region: int = 0) -> Item:
        """Return an object to place, with a pose (4, 4) from the scene file or in a start region."""
        return Item(asset, self.objects[asset].surface, self.objects[asset].body.outline, pose, region)

    def find(
        self, items: Sequence[Item], static: StaticScene, rng: np.random.Generator, arrangements: Sequence[Arrangement]
    ) -> Float64Array | None:
        """Draw start poses (N, 4, 4), see :func:`mitsplat.physics.placement.draw_poses`; None if there is no room.

        ``arrangements`` are those of all regions.
        """
        settle, regions = self.scene.spec.settle, [region for region, _ in self.scene.spec.all_regions]
        arranged = list(zip(regions, arrangements, strict=True))
        return draw_poses(items, static.obstacles, arranged, rng, settle.yaw, settle.turned_over)

    def draw(
        self, items: Sequence[Item], static: StaticScene, rng: np.random.Generator, arrangements: Sequence[Arrangement]
    ) -> Float64Array:
        """Draw start poses (N, 4, 4) as :meth:`find` does.

        Raises:
            InputError: If objects find no room.
        """
        poses = self.find(items, static, rng, arrangements)
        if poses is not None:
            return poses
        if self.scene.spec.regions:
            counts = Counter(self.scene.spec.region_names[item.region] for item in items if item.pose is None)
            raise InputError(
                f"{self.scene.path}: regions must be large enough to hold all objects of a layout without overlap "
                f"(got {', '.join(f'{count} objects in {name}' for name, count in counts.items())})"
            )
        size = np.subtract(self.scene.spec.region.max, self.scene.spec.region.min)
        raise InputError(
            f"{self.scene.path}: region must be large enough to hold all objects of a layout without overlap "
            f"(got {len(items)} objects in {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} m"
            f"{self._describe_obstruction(static.obstacles)}, settle.arrangement {arrangements[0]})"
        )

    def check_given(self, static: StaticScene) -> None:
        """Refuse start poses of the scene file that overlap one another or a collider.

        The simulation would push such objects apart.
        """
        keys: dict[PlacedSurface, str] = {}
        for entry, spec in enumerate(self.scene.spec.objects):
            for number, pose in enumerate(spec.poses):
                keys[self.placed(self.scene.pools[entry][0], pose_matrix(pose))] = f"objects[{entry}].poses[{number}]"
        for pair in all_clearances(list(keys), static.obstacles, reach=MAX_MEASURED_GAP):
            if -pair.distance > _MAX_START_OVERLAP:
                other = keys.get(pair.second, f"collider {pair.second.name!r}")
                raise InputError(
                    f"{self.scene.path}: {keys[pair.first]}: must not start in {other} "
                    f"(got an overlap of {-pair.distance * 1e3:.1f} mm)"
                )

    def _describe_obstruction(self, obstacles: Sequence[PlacedSurface]) -> str:
        """Describe the obstacle that fills most of the region; empty if no obstacle fills a tenth of it."""
        points = np.random.default_rng(0).uniform(self.scene.spec.region.min, self.scene.spec.region.max, (1000, 3))
        taken = [float((item.signed_distances(points) < 0).mean()) for item in obstacles]
        worst = int(np.argmax(taken))
        return f", {taken[worst]:.0%} of which are inside {obstacles[worst].name!r}" if taken[worst] >= 0.1 else ""
