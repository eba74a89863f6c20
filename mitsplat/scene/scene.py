"""A scene ready to be settled and rendered, and the plan of each of its frames.

(seed, frame index) decide a plan entirely: every random value has a stream of its own, named by its purpose, so that
adding one never shifts another, and any worker may plan any frame in any order.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, SupportsIndex, cast

import numpy as np
import trimesh

from mitsplat.asset import Asset
from mitsplat.camera import Camera
from mitsplat.errors import InputError
from mitsplat.file_kinds import refuse_others
from mitsplat.scene.contents import Split, draw_environment, split_of
from mitsplat.scene.conveyor import Belt, belt_of, check_belt
from mitsplat.scene.layout import Layout
from mitsplat.scene.lights import lights_at, written_out
from mitsplat.scene.references import (
    Named,
    blaming,
    environments,
    light_images,
    matched,
    object_assets,
    read_named,
    shape_mesh,
)
from mitsplat.scene.streams import random_stream
from mitsplat.scene.viewpoints import View, camera_at, view_of
from mitsplat.scene.walls import backdrop_shapes, enclosure_walls
from mitsplat.spec.image import Randomise
from mitsplat.spec.lights import EnvironmentLight, LightEntry, LightSpec
from mitsplat.spec.objects import MAIN, ObjectSpec
from mitsplat.spec.shapes import Region
from mitsplat.spec.spec import SCHEMA_VERSION, SceneSpec
from mitsplat.yaml_input import key_place, load_yaml

_DRAWN = (
    *("exposure", "vignetting", "chromatic_aberration", "motion_blur", "motion_angle", "iso"),
    *("white_balance", "hue", "saturation", "chroma_stretch", "chroma_angle", "sharpening", "jpeg"),
)
"""What is drawn anew for every frame."""

_MADE_IN_PYTHON = "<python>.yaml"
"""Name of the scene file that a scene made in Python has not: errors begin with it, datasets keep such a file."""


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


@dataclass(frozen=True, eq=False)
class FramePlan:
    """Everything about a frame but where its objects came to rest.

    Attributes:
        index: Index of the frame.
        layout, view: Index of its layout, and of the view in it.
        split: Split that the whole layout belongs to.
        camera: Where the image is taken from.
        next_camera: Where the layout's next image is taken from, None for its last.
        lights: Lights as they are in this frame: paths and random factors applied.
        draws: Random values by name, see :func:`mitsplat.frames.camera_response.develop`.
        seed: Seed of the pixel noise.
        viewpoint: What the camera was drawn or chosen by, see :class:`mitsplat.scene.viewpoints.View`.
        belt: The conveyor at the moment of the frame, if the scene has one.
    """

    index: int
    layout: int
    view: int
    split: Split
    camera: Camera
    next_camera: Camera | None
    lights: tuple[LightSpec, ...]
    draws: dict[str, float]
    seed: int
    viewpoint: Mapping[str, Any] = field(default_factory=dict)
    belt: Belt | None = None


def load_scene(path: str | Path, *, overrides: Mapping[str, Any] | None = None, allow_outside: bool = False) -> Scene:
    """Read a scene file, then every asset and mesh that it names, and then judge what was read.

    Args:
        path: The YAML file.
        overrides: Values that replace the file's, by dotted key, such as ``{"output.width": 640}``.
        allow_outside: Whether it may name assets, meshes and images outside of its folder.

    Raises:
        InputError: If the file or something that it names is missing or breaks a rule.
    """
    path = Path(path)
    refuse_others(path, "a scene file (.yaml)", ".yaml", ".yml")
    return _scene_of(load_yaml(path, SceneSpec, overrides=overrides), path, allow_outside=allow_outside)


def make_scene(spec: SceneSpec, folder: str | Path = ".") -> Scene:
    """A scene of a specification that was made in Python; no file is read but what it names.

    Args:
        spec: The scene, as ``ms.SceneSpec(name=..., region={"min": ...}, ...)`` makes it: its keys are those of scene
            files, and a mapping stands for each part that is not made of its own model. It may name files anywhere.
        folder: What its paths are relative to [the working directory].

    Raises:
        InputError: If something that it names is missing or breaks a rule.
    """
    return _scene_of(spec, Path(folder) / _MADE_IN_PYTHON, allow_outside=True)


def _scene_of(spec: SceneSpec, path: Path, *, allow_outside: bool) -> Scene:
    """The scene of what a file says, or of what stands for one."""
    spec = matched(spec, path, allow_outside=allow_outside)
    _check_lens(spec, path)
    _check_held_out(spec, path)
    with blaming(path, "conveyor", "belt"):
        check_belt(spec)
    if spec.backdrop is not None:
        spec = spec.model_copy(update={"shapes": (*spec.shapes, *backdrop_shapes(spec.backdrop)), "backdrop": None})
    named = read_named(spec, path)
    with blaming(path, "environment"):
        surroundings = tuple(map(_metric, named.environments))
    assets = _sized_objects(spec, path, named)
    spec, shape_meshes = _walled(spec, named, assets)
    if (lights := written_out(spec)) != spec.lights:
        spec = spec.model_copy(update={"lights": lights})
    return Scene(
        spec=spec,
        path=path,
        environments=surroundings,
        assets=assets,
        shape_meshes=shape_meshes,
        class_names=_class_names(spec, assets),
        images=named.images,
    )


def _sized_objects(spec: SceneSpec, path: Path, named: Named) -> tuple[Asset, ...]:
    """Asset of each entry, in its size; entries that differ in nothing but count and class share its arrays.

    Raises:
        InputError: If one is of unknown size, cannot be dropped, or does not fit into the region.
    """
    sized: dict[tuple[str, float | None, float], Asset] = {}
    assets = []
    for keys, name, entry in object_assets(spec):
        for scale in entry.scales:
            key = (name, entry.size, scale)
            if key not in sized:
                with blaming(path, *keys):
                    asset = named.assets[name]
                    asset = _metric(asset) if entry.size is None else asset.resized(entry.size)
                    sized[key] = asset if scale == 1.0 else asset.scaled(scale)
                    _check_object(sized[key])
            with blaming(path, *keys):
                for number in spec.regions_of(entry) if not entry.poses or not spec.regions else ():
                    _check_fit(sized[key], spec.all_regions[number][0], spec.region_names[number])
            assets.append(replace(sized[key], class_name=entry.class_name or sized[key].class_name))
    return tuple(assets)


def _class_names(spec: SceneSpec, assets: Sequence[Asset]) -> tuple[str, ...]:
    """Classes of what is labelled."""
    entries = [entry for _, _, entry in object_assets(spec) for _ in entry.scales]
    return tuple(sorted({asset.class_name for entry, asset in zip(entries, assets, strict=True) if entry.label}))


def _walled(spec: SceneSpec, named: Named, assets: tuple[Asset, ...]) -> tuple[SceneSpec, tuple[trimesh.Trimesh, ...]]:
    """The specification with its enclosures written out as shapes, and the mesh of every shape."""
    enclosures = (spec.enclosure, *(region.enclosure for region in spec.regions))
    if not any(enclosures):
        return spec, named.shape_meshes
    supports = [mesh for shape, mesh in zip(spec.shapes, named.shape_meshes, strict=True) if shape.collider]
    if spec.environment_collides:
        supports += [environment.mesh for environment in named.environments if environment.mesh is not None]
    around = [enclosure_walls(one, spec, assets, supports, i) for i, one in enumerate(enclosures) if one is not None]
    walls = [wall for some in around for wall in some]
    meshes = tuple(shape_mesh(wall, Path()) for wall in walls)  # boxes, which no file holds
    regions = tuple(region.model_copy(update={"enclosure": None}) for region in spec.regions)
    update = {"shapes": (*spec.shapes, *walls), "enclosure": None, "regions": regions}
    return spec.model_copy(update=update), (*named.shape_meshes, *meshes)


def _check_lens(spec: SceneSpec, path: Path) -> None:
    """Refuse intrinsics that no camera of the image's size can have, such as a fisheye's that sees behind itself."""
    for keys, camera in spec.camera_entries:
        with blaming(path, *keys, "intrinsics"):
            try:
                camera_at(np.eye(4), camera.intrinsics, spec.output, camera.zoom[0])  # which shows most
            except ValueError as error:
                raise InputError(str(error)) from error


def _check_held_out(spec: SceneSpec, path: Path) -> None:
    """Refuse to hold out what is not named, and all environments."""
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
        raise InputError(f"{place}: must leave an environment to training (got all {len(named['environments'])})")


def whole(index: SupportsIndex, name: str) -> int:
    """An index that an integer of any kind gives.

    Raises:
        InputError: If it is something else, such as text.
    """
    try:
        return operator.index(index)
    except TypeError:
        raise InputError(f"{name} must be a whole number (got {index!r})") from None


def layout_of(scene: Scene, index: int) -> int:
    """Layout that frame ``index`` shows."""
    index = whole(index, "frame")
    if not 0 <= index < scene.num_frames:
        raise InputError(f"{scene.path}: frame must be in 0 to {scene.num_frames - 1} (got {index})")
    return index // scene.spec.output.views


def plan_frame(
    scene: Scene,
    index: int,
    layout: Layout | None = None,
    *,
    camera: Camera | None = None,
    next_layout: Layout | None = None,
    next_camera: Camera | None = None,
    lights: Sequence[LightEntry] | None = None,
) -> FramePlan:
    """The plan of frame ``index``, from the seed and the index alone, which decide its layout as well.

    Args:
        scene: The scene.
        index: Index of the frame.
        layout: Where its objects lie. Without it, cameras that are chosen by what lies there are ones that may be.
        camera: In place of the scene's; nothing is then drawn or chosen of it.
        next_layout: Where its objects lie in the next image, if they move.
        next_camera: Where the next image is taken from. Without it that is the scene's next view of the layout, or
            ``camera`` if that is given and objects move.
        lights: Entries in place of the scene's, drawn and moved as those would be.

    Raises:
        InputError: If there is no such frame, none of its views is as the scene file says that they must be, or the
            lights break a rule.
    """
    index = whole(index, "frame")
    spec, number = scene.spec, layout_of(scene, index)
    if lights is not None:
        spec = SceneSpec(**{**dict(spec), "lights": tuple(lights)})  # by which they are checked
        if unknown := {name for _, name in light_images(spec)} - set(scene.images):
            raise InputError(f"images of lights must be among those of the scene's own (got {min(unknown)!r})")
        for light in spec.lights:
            if isinstance(light, EnvironmentLight) and isinstance(light.pool, str):
                raise InputError(f"pools of lights must be lists of the scene's own images (got {light.pool!r})")
    view = index - number * spec.output.views
    time = view / max(1, spec.output.views - 1)
    ranges = spec.randomise
    here = view_of(scene, index, layout) if camera is None else View(camera)
    if next_camera is None and camera is not None:
        next_camera = None if next_layout is None else camera
    elif next_camera is None and view + 1 < spec.output.views:
        next_camera = view_of(scene, index + 1, layout if next_layout is None else next_layout).camera
    return FramePlan(
        index=index,
        layout=number,
        view=view,
        split=split_of(number, spec.output.validation, spec.output.test),
        camera=here.camera,
        next_camera=next_camera,
        lights=lights_at(spec, number, index, time),
        draws={
            name: float(random_stream(spec.seed, name, index).uniform(*bounds))
            for name in _DRAWN
            if (bounds := _drawn_from(ranges, name)) is not None
        },
        seed=int(random_stream(spec.seed, "pixel noise", index).integers(2**31)),
        viewpoint=here.drawn,
        belt=belt_of(spec, view),
    )


def _drawn_from(ranges: Randomise, name: str) -> tuple[float, float] | None:
    """The range of what is drawn for a frame, None if the scene has none of it."""
    if name in ("chromatic_aberration", "sharpening") and not any(getattr(ranges, name)):
        return None
    if name in ("chroma_stretch", "chroma_angle") and ranges.chroma_stretch == (1.0, 1.0):
        return None
    bounds: tuple[float, float] | None = (0.0, 360.0) if name == "motion_angle" else getattr(ranges, name)
    return bounds


def scene_json_schema() -> dict[str, Any]:
    """JSON Schema of a scene file, for editors."""
    named = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"urn:mitsplat:scene:{SCHEMA_VERSION}"}
    return {**named, **SceneSpec.model_json_schema()}


def _metric(asset: Asset) -> Asset:
    """The asset, unless nothing says how large it is."""
    if asset.units == "unknown":
        raise InputError(
            f"asset {asset.name!r} is of unknown units: give its longest extent [m] as size, here or in asset.yaml"
        )
    return asset


def _check_object(asset: Asset) -> None:
    """Refuse an object that physics cannot move."""
    if asset.kind != "object" or asset.mesh is None:
        raise InputError(f"asset {asset.name!r} must be of kind object and have a mesh to be dropped")


def _check_fit(asset: Asset, region: Region, name: str) -> None:
    """Refuse an object that could not lie in a region on its largest side."""
    where = "the region" if name == MAIN else f"region {name!r}"
    footprint = np.sort(cast(trimesh.Trimesh, asset.mesh).extents)[1:]  # no object is without
    space = np.sort(np.subtract(region.max, region.min)[:2])
    if (footprint > space).any():
        raise InputError(
            f"asset {asset.name!r} must fit into {where} of {space[0]:.3g} x {space[1]:.3g} m "
            f"(it measures {footprint[0]:.3g} x {footprint[1]:.3g} m)"
        )
