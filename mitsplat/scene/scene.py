"""A scene ready to be settled and rendered, and the plan of each of its frames.

(seed, frame index) decide a plan entirely: every random value has a stream of its own, named by its purpose, so that
adding one never shifts another, and any worker may plan any frame in any order.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, Literal, SupportsIndex, cast

import numpy as np
import trimesh

from mitsplat.asset import ASSET_FILE, Asset, read_mesh, read_spec
from mitsplat.camera import Camera
from mitsplat.errors import InputError
from mitsplat.file_kinds import refuse_others
from mitsplat.files import is_inside
from mitsplat.image_lists import WILDCARDS, glob_below, image_names, names_below
from mitsplat.primitives import make_primitives
from mitsplat.scene.contents import Split, draw_environment, split_of
from mitsplat.scene.layout import Layout
from mitsplat.scene.lights import lights_at, written_out
from mitsplat.scene.spec import SCHEMA_VERSION, SceneSpec
from mitsplat.scene.spec_lights import EnvironmentLight, LightEntry, LightSpec
from mitsplat.scene.spec_materials import ImageMaterial, Material
from mitsplat.scene.spec_objects import MAIN, PRIMITIVES, ObjectSpec
from mitsplat.scene.spec_shapes import Region, Shape
from mitsplat.scene.streams import random_stream
from mitsplat.scene.viewpoints import View, camera_at, view_of
from mitsplat.scene.walls import backdrop_shapes, bin_walls, enclosure_walls, stated_pose
from mitsplat.untrusted_images import IMAGES, check_images
from mitsplat.yaml_input import FieldError, key_place, load_yaml

_DRAWN = (
    *("exposure", "vignetting", "motion_blur", "motion_angle", "iso"),
    *("white_balance", "hue", "saturation", "jpeg"),
)
"""What is drawn anew for every frame."""

_MOST_IMAGES = 500
"""Tried in one process, which is given their names as arguments."""

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
    if not allow_outside:
        _confine(spec, path)
    spec = _matched(spec, path, allow_outside=allow_outside)
    spec = _matched_skies(spec, path, allow_outside=allow_outside)
    _check_lens(spec, path)
    _check_held_out(spec, path)
    if spec.backdrop is not None:
        spec = spec.model_copy(update={"shapes": (*spec.shapes, *backdrop_shapes(spec.backdrop)), "backdrop": None})
    named = _read_named(spec, path)
    _check_images(spec, path, named)
    with _blaming(path, "environment"):
        environments = tuple(map(_metric, named.environments))
    assets = _sized_objects(spec, path, named)
    spec, shape_meshes = _walled(spec, named, assets)
    if (lights := written_out(spec)) != spec.lights:
        spec = spec.model_copy(update={"lights": lights})
    return Scene(
        spec=spec,
        path=path,
        environments=environments,
        assets=assets,
        shape_meshes=shape_meshes,
        class_names=_class_names(spec, assets),
        images=named.images,
    )


@dataclass(frozen=True, eq=False)
class _Named:
    """What a scene file names, as it is on disk; assets and images by their names in the file."""

    environments: tuple[Asset, ...]
    assets: Mapping[str, Asset]
    shape_meshes: tuple[trimesh.Trimesh, ...]
    images: Mapping[str, Path]


def _read_named(spec: SceneSpec, path: Path) -> _Named:
    """Read every asset and mesh that a scene file names, each once; images are Mitsuba's to read."""
    folder = path.parent
    environments, assets, shape_meshes = list[Asset](), dict[str, Asset](), []
    for keys, name in _environments(spec):
        with _blaming(path, *keys):
            environments.append(Asset.load(folder / name))
    for keys, name, entry in _object_assets(spec):
        if entry.pool == PRIMITIVES:
            streams = (random_stream(spec.seed, "primitive", number) for number in range(len(entry.names)))
            assets |= {} if name in assets else dict(zip(entry.names, make_primitives(streams), strict=True))
        elif name not in assets:
            with _blaming(path, *keys):
                assets[name] = Asset.load(folder / name)
    for position, shape in enumerate(spec.shapes):
        with _blaming(path, "shapes", position, "mesh"):
            shape_meshes.append(_shape_mesh(shape, folder))
    images = {name: folder / name for _, name in _images(spec)}
    return _Named(tuple(environments), assets, tuple(shape_meshes), images)


def _images(spec: SceneSpec) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Key and file of every image that is named."""
    yield from _light_images(spec)
    for keys, images in image_lists(spec):
        yield from ((keys, name) for name in ([images] if isinstance(images, str) else images))


def _light_images(spec: SceneSpec) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Key and file of every image that is named for lights."""
    for position, light in enumerate(spec.lights):
        if isinstance(light, EnvironmentLight):
            for number, name in enumerate(light.names):
                yield ("lights", position, *(("image",) if light.image is not None else ("pool", number))), name


def _check_images(spec: SceneSpec, path: Path, named: _Named) -> None:
    """Refuse images that are absent, or that Mitsuba should not be given."""
    asked = list(_images(spec))
    for keys, name in asked:
        with _blaming(path, *keys):
            if not named.images[name].is_file():
                raise InputError(f"{named.images[name]}: no such file")
    for start in range(0, len(asked), _MOST_IMAGES):
        some = asked[start : start + _MOST_IMAGES]
        for (keys, _), reason in zip(some, check_images([named.images[name] for _, name in some]), strict=True):
            if reason is not None:
                raise InputError(f"{key_place(path, keys)}: {reason}")


def _sized_objects(spec: SceneSpec, path: Path, named: _Named) -> tuple[Asset, ...]:
    """Asset of each entry, in its size; entries that differ in nothing but count and class share its arrays.

    Raises:
        InputError: If one is of unknown size, cannot be dropped, or does not fit into the region.
    """
    sized: dict[tuple[str, float | None, float], Asset] = {}
    assets = []
    for keys, name, entry in _object_assets(spec):
        for scale in entry.scales:
            key = (name, entry.size, scale)
            if key not in sized:
                with _blaming(path, *keys):
                    asset = named.assets[name]
                    asset = _metric(asset) if entry.size is None else asset.resized(entry.size)
                    sized[key] = asset if scale == 1.0 else asset.scaled(scale)
                    _check_object(sized[key])
            with _blaming(path, *keys):
                for number in spec.regions_of(entry) if not entry.poses or not spec.regions else ():
                    _check_fit(sized[key], spec.all_regions[number][0], spec.region_names[number])
            assets.append(replace(sized[key], class_name=entry.class_name or sized[key].class_name))
    return tuple(assets)


def _class_names(spec: SceneSpec, assets: Sequence[Asset]) -> tuple[str, ...]:
    """Classes of what is labelled."""
    entries = [entry for _, _, entry in _object_assets(spec) for _ in entry.scales]
    return tuple(sorted({asset.class_name for entry, asset in zip(entries, assets, strict=True) if entry.label}))


def _object_assets(spec: SceneSpec) -> Iterator[tuple[tuple[str | int, ...], str, ObjectSpec]]:
    """Key, folder and entry of every asset that is named for objects."""
    for position, entry in enumerate(spec.objects):
        for number, name in enumerate(entry.names):
            keys = ("asset",) if entry.asset is not None else ("pool", number)
            yield ("objects", position, *keys), name, entry


def _environments(spec: SceneSpec) -> list[tuple[tuple[str | int, ...], str]]:
    """Key and folder of every environment."""
    if isinstance(spec.environment, str):
        return [(("environment",), spec.environment)]
    return [(("environment", number), name) for number, name in enumerate(spec.environment or ())]


def image_lists(spec: SceneSpec) -> Iterator[tuple[tuple[str | int, ...], str | tuple[str, ...]]]:
    """Key and names of the images that materials and the background draw from; a loaded scene has no patterns."""
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


def _matched(spec: SceneSpec, path: Path, *, allow_outside: bool) -> SceneSpec:
    """The specification with patterns replaced by what they match, by name: folders of assets, and images.

    Raises:
        InputError: If there are none or not as many as weights, or one is a link to where none may be named.
    """
    spec = _matched_images(_matched_environments(spec, path, allow_outside), path, allow_outside)
    objects = list(spec.objects)
    for position, entry in enumerate(objects):
        if isinstance(entry.pool, str) and entry.pool != PRIMITIVES:
            with _blaming(path, "objects", position, "pool"):
                names = _matches(path.parent, entry.pool, "object", allow_outside=allow_outside)
            try:
                entry.check_weights(len(names))
            except FieldError as error:
                raise InputError(f"{key_place(path, ('objects', position, *error.key))}: {error}") from error
            objects[position] = entry.model_copy(update={"pool": names})
    return spec.model_copy(update={"objects": tuple(objects)}) if objects != list(spec.objects) else spec


def _matched_skies(spec: SceneSpec, path: Path, *, allow_outside: bool) -> SceneSpec:
    """The specification with patterns of skies replaced by the images that they match, by name.

    Raises:
        InputError: If there are none or not as many as weights, or one is a link to where none may be named.
    """
    lights = list(spec.lights)
    for position, light in enumerate(lights):
        if isinstance(light, EnvironmentLight) and isinstance(light.pool, str):
            with _blaming(path, "lights", position, "pool"):
                found = [file for file in glob_below(path.parent, light.pool) if file.suffix.lower() in IMAGES]
                if not found:
                    raise InputError(f"must match at least one image (got {light.pool!r}, which matches none)")
                names = names_below(path.parent, light.pool, _inside(path.parent, found, allow_outside))
            try:
                light.check_weights(len(names))
            except FieldError as error:
                raise InputError(f"{key_place(path, ('lights', position, *error.key))}: {error}") from error
            lights[position] = light.model_copy(update={"pool": names})
    return spec.model_copy(update={"lights": tuple(lights)}) if lights != list(spec.lights) else spec


def _inside(folder: Path, paths: list[Path], allow_outside: bool) -> list[Path]:
    """These paths, refused if one leads to where none may be named."""
    for path in () if allow_outside else paths:
        _refuse_outside(folder, str(path.absolute()))
    return paths


def _matched_environments(spec: SceneSpec, path: Path, allow_outside: bool) -> SceneSpec:
    pattern = spec.environment
    if not isinstance(pattern, str):
        return spec
    if WILDCARDS & set(pattern) and not (path.parent / pattern / ASSET_FILE).is_file():
        with _blaming(path, "environment"):
            names = _matches(path.parent, pattern, "environment", allow_outside=allow_outside)
        spec = spec.model_copy(update={"environment": names})
    try:
        spec.check_environment_weights()
    except FieldError as error:
        raise InputError(f"{key_place(path, error.key)}: {error}") from error
    return spec


def _matched_images(spec: SceneSpec, path: Path, allow_outside: bool) -> SceneSpec:
    found = {}
    for keys, images in image_lists(spec):
        with _blaming(path, *keys):
            found[keys] = image_names(path.parent, images)
            _inside(path.parent, [path.parent / name for name in found[keys]], allow_outside)
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
        both = {key: materials_of("backdrop", key, among=getattr(spec.backdrop, key)) for key in ("floor", "walls")}
        spec = spec.model_copy(update={"backdrop": spec.backdrop.model_copy(update=both)})
    if spec.background is None:
        return spec
    background = spec.background.model_copy(update={"images": found["background", "images"]})
    return spec.model_copy(update={"background": background})


def _matches(
    folder: Path, pattern: str, kind: Literal["object", "environment"], *, allow_outside: bool
) -> tuple[str, ...]:
    """Asset folders of a kind that a pattern matches, relative to a folder."""
    found = [path for path in glob_below(folder, pattern) if (path / ASSET_FILE).is_file()]
    named = _inside(folder, found, allow_outside)
    assets = [path for path in named if read_spec(path).kind == kind]
    if not assets:
        raise InputError(f"must match at least one folder of an {kind}'s asset (got {pattern!r}, which matches none)")
    return names_below(folder, pattern, assets)


def _walled(spec: SceneSpec, named: _Named, assets: tuple[Asset, ...]) -> tuple[SceneSpec, tuple[trimesh.Trimesh, ...]]:
    """The specification with its enclosures written out as shapes, and the mesh of every shape."""
    enclosures = (spec.enclosure, *(region.enclosure for region in spec.regions))
    if not any(enclosures):
        return spec, named.shape_meshes
    supports = [mesh for shape, mesh in zip(spec.shapes, named.shape_meshes, strict=True) if shape.collider]
    if spec.environment_collides:
        supports += [environment.mesh for environment in named.environments if environment.mesh is not None]
    around = [enclosure_walls(one, spec, assets, supports, i) for i, one in enumerate(enclosures) if one is not None]
    walls = [wall for some in around for wall in some]
    meshes = tuple(_shape_mesh(wall, Path()) for wall in walls)  # boxes, which no file holds
    regions = tuple(region.model_copy(update={"enclosure": None}) for region in spec.regions)
    update = {"shapes": (*spec.shapes, *walls), "enclosure": None, "regions": regions}
    return spec.model_copy(update=update), (*named.shape_meshes, *meshes)


def _confine(spec: SceneSpec, path: Path) -> None:
    """Refuse what is named outside of the scene's folder."""
    named: list[tuple[tuple[str | int, ...], str | None]] = [*_environments(spec)]
    named += [(keys, name) for keys, name, _ in _object_assets(spec)]
    patterns = ((i, entry.pool) for i, entry in enumerate(spec.objects))
    named += [(("objects", i, "pool"), pattern) for i, pattern in patterns if isinstance(pattern, str)]
    named += [(("shapes", position, "mesh"), shape.mesh) for position, shape in enumerate(spec.shapes)]
    named += _images(spec)
    skies = ((i, getattr(light, "pool", None)) for i, light in enumerate(spec.lights))
    named += [(("lights", i, "pool"), pattern) for i, pattern in skies if isinstance(pattern, str)]
    for keys, name in named:
        if name is not None:
            with _blaming(path, *keys):
                _refuse_outside(path.parent, name)


def _refuse_outside(folder: Path, name: str) -> None:
    if not is_inside(folder, name):
        raise InputError(f"must be inside the scene's folder (got {name}); --allow-outside lifts this")


def _check_lens(spec: SceneSpec, path: Path) -> None:
    """Refuse intrinsics that no camera of the image's size can have, such as a fisheye's that sees behind itself."""
    for keys, camera in ((("camera",), spec.camera), *((("cameras", i), one) for i, one in enumerate(spec.cameras))):
        with _blaming(path, *keys, "intrinsics"):
            try:
                camera_at(np.eye(4), camera.intrinsics, spec.output, camera.zoom[0])  # which shows most
            except ValueError as error:
                raise InputError(str(error)) from error


def _check_held_out(spec: SceneSpec, path: Path) -> None:
    """Refuse to hold out what is not named, and all environments."""
    named = {
        "assets": {name for _, name, _ in _object_assets(spec)},
        "environments": {name for _, name in _environments(spec)},
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
        if unknown := {name for _, name in _light_images(spec)} - set(scene.images):
            raise InputError(f"images of lights must be among those of the scene's own (got {min(unknown)!r})")
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
            if (bounds := (0.0, 360.0) if name == "motion_angle" else getattr(ranges, name)) is not None
        },
        seed=int(random_stream(spec.seed, "pixel noise", index).integers(2**31)),
        viewpoint=here.drawn,
    )


def scene_json_schema() -> dict[str, Any]:
    """JSON Schema of a scene file, for editors."""
    named = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"urn:mitsplat:scene:{SCHEMA_VERSION}"}
    return {**named, **SceneSpec.model_json_schema()}


@contextmanager
def _blaming(path: Path, *keys: str | int) -> Iterator[None]:
    """Begin the sentence of an InputError with the key of the scene file that led to it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{key_place(path, keys)}: {error}") from error


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


def _shape_mesh(shape: Shape, folder: Path) -> trimesh.Trimesh:
    """The shape in world space."""
    if shape.bin is not None:
        walls: trimesh.Trimesh = trimesh.boolean.union(list(bin_walls(shape.bin)))
        return walls
    if shape.box is None:
        return read_mesh(folder / str(shape.mesh))
    box: trimesh.Trimesh = trimesh.creation.box(extents=shape.box.size, transform=stated_pose(shape.box))
    return box
