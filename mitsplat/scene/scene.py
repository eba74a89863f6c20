"""Scenes: a specification with the assets and meshes that it names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path

import trimesh

from mitsplat.asset import Asset
from mitsplat.scene.spec.object_spec import ObjectSpec
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.splits import draw_environment


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene file with everything that it refers to.

    Attributes:
        spec: What the file says, its enclosure written out as shapes, rooms as lights, and patterns of pools as what
            they match.
        path: The scene file; of a scene that was made in Python, one that does not exist, in its folder.
        environments: The surroundings, of which each layout has one; empty if there are none.
        assets: Assets of each entry of ``spec.objects`` in turn, in each of its scales, with its class name.
        shape_meshes: Mesh of each entry of ``spec.shapes``, in world space [m].
        class_names: Of what is labelled, sorted; the position in it is the class index.
        images: Files of the images that lights, materials and the background name, by those names.
    """

    spec: SceneSpec
    path: Path
    environments: tuple[Asset, ...]
    assets: tuple[Asset, ...]
    shape_meshes: tuple[trimesh.Trimesh, ...]
    class_names: tuple[str, ...]
    images: Mapping[str, Path] = field(default_factory=dict)

    def environment_of(self, layout: int) -> Asset | None:
        """The surroundings of a layout."""
        return self.environments[draw_environment(self.spec, layout)] if self.environments else None

    @property
    def num_frames(self) -> int:
        """Layouts times views; frames of one layout are neighbours."""
        return self.spec.output.layouts * self.spec.output.views

    @cached_property
    def pools(self) -> tuple[range, ...]:
        """Positions among the assets that each entry of ``spec.objects`` draws from."""
        ends = list(accumulate((len(entry.names) * len(entry.scales) for entry in self.spec.objects), initial=0))
        return tuple(range(*ends) for ends in pairwise(ends))

    def entry_of(self, asset: int) -> ObjectSpec:
        """The entry of ``spec.objects`` that draws an asset."""
        return next(entry for entry, pool in zip(self.spec.objects, self.pools, strict=True) if asset in pool)

    def class_index(self, asset: int) -> int | None:
        """Class index that objects of an asset are labelled with; None if they are not."""
        return self.class_names.index(self.assets[asset].class_name) if self.entry_of(asset).label else None
