"""Mitsuba scene files: export of a frame as editable XML, and rendering of XML scenes to pictures."""

from __future__ import annotations

import difflib
import importlib
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.arrays import ByteImage
from mitsplat.engine.answers import LostWorkersError
from mitsplat.engine.pool import run_in_process
from mitsplat.errors import InputError
from mitsplat.frames.camera_response import develop
from mitsplat.frames.light_properties import light_properties
from mitsplat.frames.scene_builder import NO_SPLATS, asset_properties
from mitsplat.frames.untrusted_xml import CheckedXml, check_xml
from mitsplat.gaussians.material_files import write_materials
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.images.untrusted_images import check_images
from mitsplat.physics.settle import settle_layout
from mitsplat.progress import Note
from mitsplat.renderer.layers import describe_sensor
from mitsplat.renderer.rays.sensors import view_of
from mitsplat.renderer.scene_emitters import MitsubaDict, emitter_dict
from mitsplat.renderer.textures import finished_mesh, material, texture_image
from mitsplat.runtime.device import Device
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.layout import Layout
from mitsplat.scene.planning.conveyor import layout_at_view
from mitsplat.scene.planning.frame_plan import FramePlan, layout_index_of, plan_frame
from mitsplat.scene.planning.layout_surroundings import MaterialDraw, draw_surroundings
from mitsplat.scene.planning.object_appearance import draw_appearances
from mitsplat.scene.planning.shape_poses import placed_shapes
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import library_errors, storage_errors, write_file


def export_xml(scene: Scene, index: int, path: str | Path) -> None:
    """Write one frame as a Mitsuba scene, with its splats and meshes in a folder beside it.

    The scene contains the content of the frame's layers. Exposure, tone, noise and background images are not included.

    Raises:
        InputError: If the index is out of range, or the layout cannot be settled.
        OSError: If the files cannot be written.
    """
    ensure_variant()
    path = Path(path)
    files = path.with_name(f"{path.stem}_files")
    number = layout_index_of(scene, index)
    layout = layout_at_view(scene, settle_layout(scene, number), index - number * scene.spec.output.views)
    plan = plan_frame(scene, index, layout)
    if files.is_symlink():
        raise InputError(f"{files}: must not be a link, because files are written into it; remove the link")
    files.mkdir(parents=True, exist_ok=True)
    lights = {f"light_{i}": emitter_dict(light, scene.path.parent.resolve()) for i, light in enumerate(plan.lights)}
    description = {
        "type": "scene",
        "embree_use_robust_intersections": True,  # for integrators other than splat_proxy
        "integrator": {
            "type": "splat_proxy",
            "quality": scene.spec.quality,
            **scene.splat_options,
            **light_properties(scene, number),
        },
        "sensor": describe_sensor(plan.camera),
        **_export_assets(scene, layout, files),
        **_export_shapes(scene, plan, files),
        **lights,
    }
    _register_plugin_kinds()
    state = mi.parser.parse_dict(mi.parser.ParserConfig(str(mi.variant())), description)
    with library_errors(path):
        write_file(path, lambda part: mi.parser.write_file(state, str(part)))


def _export_assets(scene: Scene, layout: Layout, folder: Path) -> MitsubaDict:
    """Write the splats and meshes of environment and objects; return the Mitsuba dictionaries of their shapes."""
    environment, shapes = scene.environment_of(layout.index), {}
    if environment is not None:
        files = _write_splats(environment.splats, environment.mesh, folder, "environment")
        shapes["environment"] = {"type": "splats", **files, **asset_properties(environment, 0)}
    # File names use positions, because asset names may repeat and need not be valid file names.
    used = {instance.asset for instance in layout.instances}
    assets = {number: scene.assets[number] for number in used}
    asset_files = {n: _write_splats(asset.splats, asset.mesh, folder, f"object_{n}") for n, asset in assets.items()}
    appearances = draw_appearances(scene, layout)
    for instance in layout.instances:
        asset, appearance = scene.assets[instance.asset], appearances.get(instance.id)
        shapes[f"instance_{instance.id}"] = {
            "type": "splats",
            **asset_files[instance.asset],
            **asset_properties(asset, instance.id, appearance),
            "to_world": mi.ScalarTransform4f(instance.world_from_object),
        }
    return shapes


def _write_splats(splats: Splats, mesh: trimesh.Trimesh | None, folder: Path, name: str) -> dict[str, str]:
    """Write splats, their materials and mesh; return their file properties for the shape plugin ``splats``."""
    splats.save(folder / f"{name}.ply")
    files = {"filename": f"{folder.name}/{name}.ply"}
    if splats.materials is not None:
        write_materials(splats.materials, folder / f"{name}_materials.ply")
        files["materials"] = f"{folder.name}/{name}_materials.ply"
    if mesh is not None:
        write_file(folder / f"{name}_proxy.ply", lambda part: mesh.export(part, file_type="ply"))
        files["proxy"] = f"{folder.name}/{name}_proxy.ply"
    return files


def _export_shapes(scene: Scene, plan: FramePlan, folder: Path) -> MitsubaDict:
    """Write the meshes and patterns of visible shapes, and the proxies; return their Mitsuba dictionaries."""
    surroundings, shapes = draw_surroundings(scene.spec, plan.index), {}
    for placed in placed_shapes(scene, plan.layout):
        name, shape = f"shape_{placed.number}", placed.shape
        if shape.visible:
            drawn, belt = surroundings.material_of(shape), plan.belt
            image = texture_image(drawn, scene.images)
            travel = belt.travel if belt is not None and shape.box == belt.box else 0.0
            made = finished_mesh(placed.stated, shape, drawn, image, travel=travel, motion=placed.motion)
            shapes[name] = _write_shape(made, drawn, image, folder, name)
        elif shape.proxy:
            shapes[name] = {"type": "splats", **_write_splats(NO_SPLATS, placed.mesh, folder, name)}
    return shapes


def _write_shape(shape: mi.Shape, drawn: MaterialDraw, image: ByteImage | None, folder: Path, name: str) -> MitsubaDict:
    """Write a mesh and the pattern of its material; return its Mitsuba dictionary."""
    write_file(folder / f"{name}.ply", lambda part: shape.write_ply(str(part)))
    texture = None
    if image is not None:
        bitmap = mi.Bitmap(image)
        write_file(folder / f"{name}.png", lambda part: bitmap.write(str(part), mi.Bitmap.FileFormat.PNG))
        texture = {"type": "bitmap", "filename": f"{folder.name}/{name}.png"}
    file = f"{folder.name}/{name}.ply"
    return {"type": "ply", "filename": file, "face_normals": True, "bsdf": material(drawn, texture)}


def render_xml(path: str | Path, out: str | Path, *, allow_outside: bool = False) -> Path:
    """Render a Mitsuba scene with the integrator, sensor and size that it specifies.

    Args:
        path: The ``.xml`` file.
        out: Picture to write (``.png``, ``.jpg`` or ``.exr``), or a folder for ``picture.png``.
        allow_outside: Accept files outside of the scene's folder, see :mod:`mitsplat.frames.untrusted_xml`.

    Returns:
        Path of the picture.

    Raises:
        InputError: If the file is missing or Mitsuba refuses it, or the picture cannot be written.
        MissingResourceError: If the disk is full.
    """
    ensure_variant()
    path, out = Path(path), Path(out)
    checked = check_xml(path, allow_outside=allow_outside)
    _check_skies(checked)
    picture = out if out.suffix.lower() in (".png", ".jpg", ".exr") else out / "picture.png"
    with storage_errors(picture):
        picture.parent.mkdir(parents=True, exist_ok=True)
    with storage_errors(Path(tempfile.gettempdir())), tempfile.TemporaryDirectory() as folder:
        names = checked.write(Path(folder))
        try:
            # The optimisation lists parts in arbitrary order, on which the noise of the light depends.
            scene = mi.load_file(str(next(iter(names))), optimize=False)
            image = np.array(_render(path, scene))
        except RuntimeError as error:
            raise InputError(describe_error(path, str(error), names)) from error
    suffix = picture.suffix.lower()
    bitmap = mi.Bitmap(image[..., :3] if suffix == ".exr" else develop(image[..., :3], {}))
    kind = getattr(mi.Bitmap.FileFormat, {".exr": "OpenEXR", ".jpg": "JPEG", ".png": "PNG"}[suffix])
    with storage_errors(picture), library_errors(picture):
        write_file(picture, lambda part: bitmap.write(str(part), kind))
    return picture


def _check_skies(checked: CheckedXml) -> None:
    """Refuse environment maps that cannot be read, or whose pixels no light has, which would take all memory.

    Raises:
        InputError: For the first such image.
    """
    emitters = [one for text in checked.texts for one in ElementTree.fromstring(text).iter("emitter")]
    skies = [
        sky
        for emitter in emitters
        if emitter.get("type") == "envmap"
        for value in emitter.iter("string")
        if value.get("name") == "filename" and (sky := Path(value.get("value", ""))).is_file()
    ]
    for reason in filter(None, check_images(skies)):
        raise InputError(reason)


def render_apart(path: Path, out: Path, *, allow_outside: bool = False, device: Device | None = None) -> Path:
    """Run :func:`render_xml` in a separate process, because a damaged mesh or image can crash Mitsuba.

    Raises:
        InputError: As in :func:`render_xml`, or if the process crashes.
        MissingResourceError: If the device cannot be used, or its memory does not suffice.
    """
    try:
        return run_in_process(_RenderOne(path, out, allow_outside), device)
    except LostWorkersError as error:
        raise InputError(f"{path}: Mitsuba's process ended at a file that the scene names ({error})") from error


@dataclass(frozen=True)
class _RenderOne:
    path: Path
    out: Path
    allow_outside: bool

    def __call__(self, index: int, note: Note, /) -> Path:
        return render_xml(self.path, self.out, allow_outside=self.allow_outside)


def _render(path: Path, scene: mi.Scene) -> mi.TensorXf:
    """Render a scene with its integrator and its first sensor."""
    from mitsplat.plugins.splat_proxy import SplatProxyIntegrator  # derives from a class of the variant

    if not scene.sensors():
        raise InputError(f"{path}: the scene must have a sensor (got none)")
    integrator, sensor = scene.integrator(), scene.sensors()[0]
    if isinstance(integrator, SplatProxyIntegrator):
        try:
            view_of(sensor)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    elif any(hasattr(shape, "world_from_splats") for shape in scene.shapes()):
        raise InputError(f"{path}: shape 'splats' needs the integrator 'splat_proxy' (got {integrator.class_name()})")
    # mi.render would replace the cause of an error by "see above".
    return integrator.render(scene, sensor)


_PLACE = re.compile(r"(?:[Ww]hile loading|At) (?P<file>.+?) \(line (?P<line>\d+), col \d+\):\s*")
_ABSENT = re.compile(
    r'instantiate (?P<kind>[\w ]+) plugin of type "(?P<type>[^"]*)".*Plugin "(?P=type)" not found', re.S
)
_UNKNOWN = re.compile(r'unreferenced propert\w+ in (?P<kind>\w+) plugin of type "(?P<type>[^"]+)"')
_PROPERTY = re.compile(r'- \S+ "(?P<name>[^"]+)"')


def describe_error(path: Path, message: str, original_paths: Mapping[Path, Path] | None = None) -> str:
    """Convert an error message of Mitsuba to one sentence with place, rule and value, without the call stack.

    Args:
        path: The scene.
        message: Text of Mitsuba's error.
        original_paths: Original file of each file that Mitsuba has read.
    """
    place = str(path)
    for match in _PLACE.finditer(message):  # an included file follows the files that include it
        file = Path(match["file"])
        place = f"{(original_paths or {}).get(file, file)}:{match['line']}"
    unknown = _UNKNOWN.search(message)
    if unknown:
        names = ", ".join(repr(name) for name in _PROPERTY.findall(message[unknown.end() :]))
        documented = _documented_properties(unknown["type"])
        known = f"; it takes {', '.join(documented)}" if documented else ""
        return f"{place}: {unknown['kind']} {unknown['type']!r} takes no {names}{known}"
    if absent := _ABSENT.search(message):
        close = difflib.get_close_matches(absent["type"], _plugin_names(), n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        return f"{place}: no {absent['kind']} plugin is called {absent['type']!r}{hint}"
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    last = lines[-1] if lines else "Mitsuba reported an error without a message"
    last = last.removeprefix(f"{InputError.__name__}: ")
    last = re.sub(r"^\[\w+\.cpp:\d+\] ", "", last)
    last = _PLACE.sub("", last.removeprefix("Error "))
    last = re.sub(r"\[\w+\] (Error while \w+ing )?", "", last)
    return last if last.startswith(place) else f"{place}: {last}"


def _plugin_names() -> list[str]:
    """Return the names of the plugins of mitsplat, and of those of Mitsuba in C++."""
    compiled = sorted(file.stem for file in (Path(mi.__file__).parent / "plugins").glob("*.so"))
    return ["splats", "splat_proxy", "opencv_camera", *compiled]


def _documented_properties(plugin: str) -> list[str]:
    """Return the documented properties of a mitsplat plugin; empty for other plugins."""
    from mitsplat.plugins import opencv_camera, splat_proxy, splats  # derive from classes of the variant

    classes = {
        "splats": splats.SplatsShape,
        "opencv_camera": opencv_camera.OpenCVCamera,
        "splat_proxy": splat_proxy.SplatProxyIntegrator,
    }
    text = classes[plugin].__doc__ if plugin in classes else None
    rows = re.findall(r"\* - ([\w, ]+)\n\s+- \|", text or "")
    return [name for row in rows for name in row.split(", ")]


def _register_plugin_kinds() -> None:
    """Register the kinds of our plugins in a scalar variant, where Mitsuba's XML writer looks them up."""
    scalar = importlib.import_module("mitsuba.scalar_rgb")

    def refuse(props: mi.Properties) -> None:
        raise RuntimeError(f"plugin {props.plugin_name()!r} needs an llvm or cuda variant")

    scalar.register_integrator("splat_proxy", refuse)
    scalar.register_sensor("opencv_camera", refuse)
    scalar.register_shape("splats", refuse)
