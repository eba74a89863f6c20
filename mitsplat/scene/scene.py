"""Scenes: a specification with the assets and meshes that it names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from mitsplat.arguments import check_type, checks_arguments
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_training import trained_kernel
from mitsplat.scene.spec.object_spec import ObjectSpec
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.scene.splits import draw_environment


@checks_arguments
@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Scene specification with all files that it names.

    Attributes:
        spec: Specification of the scene file. Enclosures are expanded to shapes, and patterns to lists.
        path: Path of the scene file. For a scene made in Python, a path in its folder at which no file exists.
        environments: Environments, of which each layout draws one; empty if there are none.
        assets: Assets of each entry of ``spec.objects`` in turn, one per scale, with the class name of the entry.
        shape_meshes: Mesh of each entry of ``spec.shapes``, in world space [m].
        class_names: Sorted class names of labelled objects. The position of a name is its class index.
        images: Image files of lights, materials and the background, by their names in the specification.
    """

    spec: SceneSpec
    path: Path
    environments: tuple[Asset, ...]
    assets: tuple[Asset, ...]
    shape_meshes: tuple[trimesh.Trimesh, ...]
    class_names: tuple[str, ...]
    images: Mapping[str, Path] = field(default_factory=dict)

    def __repr__(self) -> str:
        output = self.spec.output
        return (
            f"Scene({str(self.path)!r}: {output.layouts} layouts x {output.views} views, {len(self.assets)} assets of "
            f"{len(self.class_names)} classes)"
        )

    @classmethod
    def check(cls, value: object) -> None:
        """Check that an argument is a scene.

        Raises:
            InputError: If it is not, such as the path of a scene file.
        """
        check_type(value, cls, "scene", "read a file with mitsplat.load_scene(path)")

    def environment_of(self, layout: int) -> Asset | None:
        """Return the environment of a layout; None if the scene has none."""
        return self.environments[draw_environment(self.spec, layout)] if self.environments else None

    @property
    def num_frames(self) -> int:
        """Number of frames: layouts times views. Frames of one layout have consecutive indices."""
        return self.spec.output.layouts * self.spec.output.views

    @property
    def is_lit(self) -> bool:
        """True if the scene has lights, or if all assets keep the light of their capture."""
        drawn = (*self.environments, *self.assets)
        return bool(self.spec.lights) or all(asset.capture_light == "scene" for asset in drawn)

    @cached_property
    def splat_options(self) -> dict[str, Any]:
        """Values of ``spec.rendering`` that refine a preset, with the kernel of the splats if it is not stated."""
        options = self.spec.rendering.model_dump()
        drawn = (*self.environments, *self.assets)
        return options | {"kernel": options["kernel"] or trained_kernel(asset.splats.kernel for asset in drawn)}

    @cached_property
    def asset_names(self) -> tuple[tuple[str, str], ...]:
        """For each asset, its name and its path in the scene file."""
        paths = (path for entry in self.spec.objects for path in entry.names for _ in entry.scales)
        return tuple((asset.name, path) for asset, path in zip(self.assets, paths, strict=True))

    @cached_property
    def pools(self) -> tuple[range, ...]:
        """For each entry of ``spec.objects``, the indices of its assets."""
        ends = list(accumulate((len(entry.names) * len(entry.scales) for entry in self.spec.objects), initial=0))
        return tuple(range(*ends) for ends in pairwise(ends))

    @cached_property
    def centroids(self) -> tuple[tuple[float, float, float], ...]:
        """For each asset, the centroid of its mesh in its frame, rounded to micrometres [m].

        It is inside the convex hull of the object, unlike its origin, which may be anywhere.
        """
        found = (np.zeros(3) if asset.mesh is None else asset.mesh.centroid for asset in self.assets)
        return tuple((x, y, z) for x, y, z in ((centroid.round(6) + 0.0).tolist() for centroid in found))

    def entry_of(self, asset: int) -> ObjectSpec:
        """Return the entry of ``spec.objects`` to which an asset belongs."""
        for entry, pool in zip(self.spec.objects, self.pools, strict=True):
            if asset in pool:
                return entry
        raise InputError(f"asset must be an index from 0 to {len(self.assets) - 1} (got {asset})")

    def class_index(self, asset: int) -> int | None:
        """Return the class index of an asset; None if its objects have no labels."""
        return self.class_names.index(self.assets[asset].class_name) if self.entry_of(asset).label else None
