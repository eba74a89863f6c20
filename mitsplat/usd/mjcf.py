"""Export of assets and frames to MJCF, the model format of MuJoCo.

The model has the bodies with their convex pieces, masses and friction, static shapes, the camera and the positions of
lights. Meshes lie in a folder beside the file. MJCF has no splats, so that MuJoCo renders the proxy meshes.

Friction of a contact: MuJoCo takes the larger coefficient of two geoms with equal priority, mitsplat the geometric mean
(:mod:`mitsplat.physics.friction`). Both agree for equal coefficients; otherwise MuJoCo's contacts have more friction.
"""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import OPENCV_FROM_OPENGL
from mitsplat.images.colour import encode_srgb
from mitsplat.physics.bodies import Body, make_body
from mitsplat.physics.drop import TIMESTEP
from mitsplat.physics.friction import GRAVITY, MIN_FRICTION, ContactMaterial
from mitsplat.physics.newton_model import CONTACT_TIME, DAMPING_RATIO, IMPEDANCE_MUJOCO, WITH_ROLL
from mitsplat.physics.settle import warp_settings
from mitsplat.progress import discard_note
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import storage_errors, write_text
from mitsplat.usd.frame_content import FrameContent, PlacedObject, frame_content
from mitsplat.usd.simulator_poses import identifier

_VISUAL = {"contype": "0", "conaffinity": "0", "group": "2", "mass": "0"}
_COLLISION_GROUP = "3"


def export_asset_mjcf(asset: Asset, path: Path) -> tuple[str, ...]:
    """Write an asset as a model with one free body.

    Returns:
        What the model does not hold, one sentence each.

    Raises:
        InputError: If the asset is no object, has unknown units, or the file cannot be written.
        MissingResourceError: If the disk is full.
    """
    if asset.kind != "object" or asset.units == "unknown":
        got = "an environment" if asset.kind != "object" else "unknown units"
        raise InputError(f"asset {asset.name!r} must be an object of known size for MJCF (got {got})")
    with warp_settings():
        body = make_body(asset, discard_note)
    place = PlacedObject(1, 0, np.eye(4), labelled=True)
    return _write_model(FrameContent(asset.name, {0: (asset, body)}, (place,)), path)


def export_scene_mjcf(scene: Scene, index: int, path: Path) -> tuple[str, ...]:
    """Write frame ``index`` of a scene as a model; see :func:`export_asset_mjcf`.

    Raises:
        InputError: If there is no such frame, its layout does not settle, or the file cannot be written.
        MissingResourceError: If the disk is full.
    """
    return _write_model(frame_content(scene, index), path)


def _write_model(content: FrameContent, path: Path) -> tuple[str, ...]:
    """Write the XML file and its folder of meshes."""
    files = path.with_name(f"{path.stem}_files")
    if files.is_symlink():
        raise InputError(f"{files}: must not be a link, because files are written into it; remove the link")
    with storage_errors(path), tempfile.TemporaryDirectory(prefix=".mjcf-", dir=path.parent) as folder:
        text = _ModelWriter(Path(folder), files.name).write(content)
        files.mkdir(exist_ok=True)
        for file in Path(folder).iterdir():
            file.replace(files / file.name)
        write_text(path, text)
    notes = [*content.notes, "splats; their proxy meshes are visible"]
    if content.lights:
        notes.append("sizes, radiances and images of lights; MuJoCo has positions and colours")
    return tuple(notes)


class _ModelWriter:
    """Writer of one model."""

    def __init__(self, folder: Path, meshdir: str) -> None:
        self._folder, self._meshdir = folder, meshdir
        self._meshes = ET.Element("asset")
        self._written: dict[str, str] = {}

    def write(self, content: FrameContent) -> str:
        """Return the XML text; meshes are written into the folder."""
        root = ET.Element("mujoco", model=content.name)
        root.append(ET.Comment(" Friction of a contact in mitsplat: the geometric mean of both coefficients. "))
        ET.SubElement(root, "compiler", angle="radian", meshdir=self._meshdir)
        options: dict[str, npt.ArrayLike] = {"timestep": TIMESTEP, "gravity": (0.0, 0.0, -GRAVITY), "impratio": 100.0}
        option = ET.SubElement(root, "option", {name: _text(value) for name, value in options.items()})
        option.attrib.update({"integrator": "implicitfast", "cone": "elliptic", "solver": "Newton"})
        ET.SubElement(option, "flag", multiccd="enable")
        default = ET.SubElement(root, "default")
        reference = (CONTACT_TIME, DAMPING_RATIO)
        ET.SubElement(default, "geom", solref=_text(reference), solimp=_text(IMPEDANCE_MUJOCO), condim=str(WITH_ROLL))
        root.append(self._meshes)
        custom, world = ET.Element("custom"), ET.SubElement(root, "worldbody")
        if content.environment is not None and content.environment.mesh is not None:
            self._geom(world, "environment", content.environment.mesh, _VISUAL)
        if content.ground is not None:
            for number, piece in enumerate(content.ground.pieces):
                self._geom(world, f"environment_{number}", piece, _contact(content.ground.material, 0.0))
        self._shapes(world, content)
        for one in content.objects:
            asset, body = content.assets[one.asset]
            name = f"{identifier(asset.name)}_{one.id}"
            self._body(world, name, f"{identifier(asset.name)}_{one.asset}", asset, body, one.pose)
            if one.labelled:
                ET.SubElement(custom, "text", name=f"class_{name}", data=asset.class_name)
        if content.camera is not None:
            world.append(_camera(content.camera))
        self._lights(world, content)
        if len(custom):
            root.append(custom)
        if not len(self._meshes):
            root.remove(self._meshes)
        ET.indent(root)
        return ET.tostring(root, encoding="unicode") + "\n"

    def _shapes(self, world: ET.Element, content: FrameContent) -> None:
        """Add static shapes: colliders, and visible meshes."""
        for number, shape in enumerate(content.shapes):
            name = f"{identifier(shape.name)}_{number}"
            colour = None if shape.colour is None else {"rgba": _text((*encode_srgb(shape.colour), 1.0))}
            if colour is not None:
                self._geom(world, f"{name}_visual", shape.mesh, _VISUAL | colour)
            if shape.collider is None:
                continue
            contact = _contact(shape.collider.material, 0.0)
            for piece_number, piece in enumerate(shape.collider.pieces):
                self._geom(world, f"{name}_{piece_number}", piece, contact)
            if shape.collider.box is not None:
                size, pose = shape.collider.box
                geom = {"name": name, "type": "box", "size": _text(np.divide(size, 2)), **_pose(pose)}
                ET.SubElement(world, "geom", geom | contact)

    def _body(self, world: ET.Element, name: str, stem: str, asset: Asset, body: Body, pose: Float64Array) -> None:
        """Add a free body with its inertia, its convex pieces and its proxy mesh."""
        element = ET.SubElement(world, "body", {"name": name, **_pose(pose)})
        ET.SubElement(element, "freejoint")
        inertia = body.mass.inertia
        moments = [inertia[row, column] for row, column in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        values: dict[str, npt.ArrayLike] = {"pos": body.mass.centre, "mass": body.mass.mass, "fullinertia": moments}
        ET.SubElement(element, "inertial", {key: _text(value) for key, value in values.items()})
        if asset.mesh is not None:
            self._geom(element, stem, asset.mesh, _VISUAL)
        contact = _contact(body.material, body.size)
        for number, piece in enumerate(body.pieces):
            self._geom(element, f"{stem}_{number}", piece, contact)

    def _geom(self, parent: ET.Element, name: str, mesh: trimesh.Trimesh, values: dict[str, str]) -> None:
        """Add a mesh to an element; the mesh is written once."""
        if name not in self._written:
            self._written[name] = f"{name}.stl"
            (self._folder / f"{name}.stl").write_bytes(trimesh.exchange.stl.export_stl(mesh))
            # The mass of geoms is not used; a mesh that is not closed has no volume.
            ET.SubElement(self._meshes, "mesh", name=name, file=f"{name}.stl", inertia="shell")
        ET.SubElement(parent, "geom", {"type": "mesh", "mesh": name, **values})

    @staticmethod
    def _lights(world: ET.Element, content: FrameContent) -> None:
        """Add lights with a position; all have equal brightness, because MuJoCo has no radiometric units."""
        lights = [light for light in content.lights if light.kind != "environment"]
        for light in lights:
            target = getattr(light, "target", (*light.position[:2], light.position[2] - 1.0))
            values = {"pos": light.position, "dir": np.subtract(target, light.position)}
            values["diffuse"] = np.divide(light.colour, max(*light.colour, 1e-6) * len(lights))
            ET.SubElement(world, "light", {key: _text(value) for key, value in values.items()})


def _camera(camera: Camera) -> ET.Element:
    """Return MuJoCo's camera, which looks along -z; its principal point is the window's offset, with y up."""
    frame = camera.world_from_camera @ OPENCV_FROM_OPENGL
    offset = (0.5 * camera.width - camera.cx, 0.5 * camera.height - camera.cy)
    values: dict[str, npt.ArrayLike] = {
        "resolution": camera.size,
        "focalpixel": (camera.fx, camera.fy),
        "principalpixel": offset,
        "sensorsize": (0.036, 0.036 * camera.height / camera.width),
    }
    return ET.Element("camera", {"name": "camera", **_pose(frame), **{key: _text(one) for key, one in values.items()}})


def _contact(material: ContactMaterial, size: float) -> dict[str, str]:
    """Return the friction of a collision geom: sliding coefficient, spin radius times it, and rolling length."""
    config = material.shape_config(0.0, 0.0, size=size)
    friction = np.maximum((material.friction, material.friction * config.mu_torsional, config.mu_rolling), MIN_FRICTION)
    return {"friction": _text(friction), "group": _COLLISION_GROUP, "mass": "0"}


def _pose(pose: Float64Array) -> dict[str, str]:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {"pos": _text(pose[:3, 3]), "quat": _text((w, x, y, z))}


def _text(value: npt.ArrayLike) -> str:
    """Return numbers as text that reads back exactly."""
    numbers = np.atleast_1d(np.asarray(value, dtype=np.float64)).tolist()
    return " ".join(str(int(one)) if one == int(one) else repr(one) for one in numbers)
