"""Scenes from untrusted USD stages: assets and a scene file in a folder, and the frames that the stage shows.

Rigid bodies with splats are objects, and so are particle fields with a semantic class that belong to no body. Other
particle fields are the environment. Meshes that belong to no body are visible shapes. Objects and cameras have the
poses of each time code.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.asset import Asset, opaque_core
from mitsplat.capture.lighting.panorama import HDR_SUFFIXES, read_radiance, rotated, write_radiance
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import OPENCV_FROM_OPENGL, Z_UP_FROM_Y_UP
from mitsplat.images.colour import decode_srgb, encode_srgb, temperature_colour
from mitsplat.images.picture_files import read_picture
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.scene import Scene
from mitsplat.storage.content_hash import ContentHash
from mitsplat.storage.files import JsonObject, storage_errors, write_text
from mitsplat.usd.stage_assets import body_frames, make_stage_asset, merge_fields, placed_mesh, rigid_frame
from mitsplat.usd.stage_images import fit_aperture
from mitsplat.usd.stage_physics import Record
from mitsplat.usd.stage_reader import unread_note
from mitsplat.usd.stage_records import read_records

_WIDTH = 1280
"""Image width of a stage without render settings [px]."""
_FLATNESS = 1e-3
"""Thickness of points, relative to their extent, from which they span a volume."""
_TOLERATED_ASPECT = 1e-3
"""Difference of the aspect ratios of aperture and image that is not reported, relative to them."""
_DISTANCE = 100.0
"""Distance at which a distant light is placed [m]."""
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
"""Suffixes of images of the sky whose values are encoded for display."""
_STILL = 1e-6
"""Tolerated change of scales and of matrices of prims that do not move."""


@dataclass(frozen=True, eq=False)
class StageScene:
    """Scene of a stage.

    Attributes:
        scene: The scene; its files are in a folder.
        poses: For each time code, the poses ``world_from_object`` of each asset, by its index; None where an object is
            invisible.
        cameras: For each camera of the stage, that camera at each time code.
        notes: What was not read, one sentence each.
    """

    scene: Scene
    poses: tuple[dict[str | int, list[Float64Array | None]], ...]
    cameras: tuple[tuple[Camera, ...], ...]
    notes: tuple[str, ...]


def read_stage_scene(
    path: Path, folder: Path, overrides: Mapping[str, Any] | None = None, *, images: int | None = None
) -> StageScene:
    """Read a stage, and write its assets and a scene file into a folder.

    Args:
        path: The stage.
        folder: Empty folder.
        overrides: Values that replace those of the scene, by dotted key. The default size of the images is that of the
            stage's render settings.
        images: Maximum number of time codes.

    Raises:
        InputError: If the stage is damaged, or has no camera or no labelled object.
        MissingResourceError: If OpenUSD is not installed, or the disk is full.
    """
    records, overrides = read_records(path, images), dict(overrides or {})
    size = (overrides["output.width"], overrides["output.height"]) if "output.width" in overrides else None
    notes: list[str] = list(records["notes"])
    if not records["cameras"]:
        raise InputError(f"{path}: must have a camera to be rendered (got none)")
    frames = body_frames(path, records["bodies"])
    groups: dict[str, list[Record]] = {}
    for field in records["fields"]:
        groups.setdefault(field["body"] or (field["path"] if field["label"] else ""), []).append(field)
    surroundings = groups.pop("", [])
    if not any(fields[0]["label"] for fields in groups.values()):
        raise InputError(f"{path}: must have particle fields with a semantic class, UsdSemantics.LabelsAPI (got none)")
    with storage_errors(folder):
        entries, poses = _write_objects(path, folder, records, groups, frames, notes)
        data: JsonObject = {"name": path.stem, "objects": entries, "shapes": _shapes(records, folder)}
        if hidden := [one["path"] for one in records["meshes"] if one["visible"] and one["body"] is not None]:
            notes.append(unread_note("meshes of rigid bodies, of which only splats are rendered", hidden))
        if surroundings:
            _environment(path, records, surroundings, notes).save(folder / "assets" / "environment")
            data["environment"] = "assets/environment"
        data["lights"] = _scene_lights(path, records, folder, notes)
        cameras = _camera_tracks(path, records, size, notes)
        first = cameras[0][0]
        notes.extend(_unread_motion(records))
        reach = 10.0
        data |= {
            "region": {"min": [-reach, -reach, 0.0], "max": [reach, reach, reach]},
            "camera": {
                "kind": "fixed",
                "world_from_camera": first.world_from_camera.tolist(),
                "intrinsics": {"fx": first.fx, "fy": first.fy, "cx": first.cx, "cy": first.cy},
            },
            "output": {"width": first.width, "height": first.height, "layouts": len(cameras) * len(poses), "views": 1},
        }
        write_text(folder / "scene.yaml", json.dumps(data, indent=1))  # YAML includes JSON
    return StageScene(
        load_scene(folder / "scene.yaml", overrides=overrides), tuple(poses), tuple(cameras), tuple(notes)
    )


def _write_objects(
    path: Path,
    folder: Path,
    records: Record,
    groups: Mapping[str, Sequence[Record]],
    frames: dict[str | None, Float64Array],
    notes: list[str],
) -> tuple[list[JsonObject], list[dict[str | int, list[Float64Array | None]]]]:
    """Write the objects of a stage as assets.

    Returns:
        Entries of the scene file; and for each time code, the poses of the objects by asset, None where not shown.
    """
    keys, entries = dict[str, int](), list[JsonObject]()
    poses: list[dict[str | int, list[Float64Array | None]]] = [{} for _ in records["times"]]
    owners = {record["path"]: record for record in (*records["fields"], *records["bodies"])}
    for group, fields in groups.items():
        asset = _object(path, records, group, fields, frames, notes)
        label = fields[0]["label"]
        content = ContentHash(repr((asset.class_name, label)))
        content.add_array(asset.splats.means)
        key = content.hexdigest()
        if key not in keys:
            keys[key] = len(keys)
            name = f"{re.sub(r'[^A-Za-z0-9_]', '_', asset.name)}_{keys[key]}"
            asset.save(folder / "assets" / name)
            entries.append({"asset": f"assets/{name}", "label": label is not None, "count": 0})
        entries[keys[key]]["count"] += 1
        frames_of_object = _motion(path, owners[group], records["times"], notes)
        for known, pose, shown in zip(poses, frames_of_object, _shown(group, fields, len(poses), notes), strict=True):
            known.setdefault(keys[key], []).append(pose if shown else None)
    return entries, poses


def _scene_lights(path: Path, records: Record, folder: Path, notes: list[str]) -> list[JsonObject]:
    """Return the entries of all lights of a stage, with one light of the sky at most."""
    lights: list[JsonObject] = []
    for record in records["lights"]:
        for light in _lights(path, record, folder, notes):
            if light["kind"] == "environment" and any(one["kind"] == "environment" for one in lights):
                notes.append(f"not imported: the light {record['path']}, because a scene has one light of the sky")
            else:
                lights.append(light)
    return lights


def _camera_tracks(
    path: Path, records: Record, size: tuple[int, int] | None, notes: list[str]
) -> list[tuple[Camera, ...]]:
    """Return each camera at each time code; cameras with another image size than the first one are omitted."""
    cameras = list[tuple[Camera, ...]]()
    for record in records["cameras"]:
        camera = _camera(path, record, size or record["resolution"], notes)
        frames = _motion(path, record, records["times"], notes)
        cameras.append(tuple(replace(camera, world_from_camera=frame @ OPENCV_FROM_OPENGL) for frame in frames))
    first = cameras[0][0]
    others = [
        record["path"]
        for record, (camera, *_) in zip(records["cameras"], cameras, strict=True)
        if camera.size != first.size
    ]
    if others:
        notes.append(unread_note("cameras whose images have another size than those of the first one", others))
    return [track for track in cameras if track[0].size == first.size]


def _object(
    path: Path,
    records: Record,
    group: str,
    fields: Sequence[Record],
    frames: dict[str | None, Float64Array],
    notes: list[str],
) -> Asset:
    """Return the asset of a body, or of a labelled particle field without one."""
    body = fields[0]["body"]
    frame = rigid_frame(path, fields[0])[0] if body is None else frames[body]
    splats, found = merge_fields(path, fields, frame)
    notes.extend(found)
    asset = None if body is None else make_stage_asset(path, records, body, splats, notes)
    if asset is None:
        name = group.rpartition("/")[2]
        asset = Asset(name, fields[0]["label"] or name, splats, mesh=_hull(path, group, splats))
        notes.append(f"{group} has no colliders; the convex hull of its splats casts its shadows")
    if any(field["label"] != fields[0]["label"] for field in fields):
        notes.append(f"not imported: the classes of {group} except {fields[0]['label']}")
    return replace(asset, class_name=fields[0]["label"] or asset.class_name)


def _motion(path: Path, record: Record, times: Sequence[float], notes: list[str]) -> list[Float64Array]:
    """Return the rigid frame of a record at each time code."""
    if "motion" not in record:
        return [rigid_frame(path, record)[0]] * len(times)
    frames, scales = list[Float64Array](), list[float]()
    for time, matrix in zip(times, record["motion"], strict=True):
        frame, scale = rigid_frame(path, {"path": f"{record['path']} at time code {time:g}", "matrix": matrix})
        frames.append(frame)
        scales.append(scale)
    if not np.allclose(scales, scales[0], rtol=_STILL, atol=0):
        notes.append(f"not imported: the change of the scale of {record['path']}; it has that of the first time code")
    return frames


def _shown(group: str, fields: Sequence[Record], count: int, notes: list[str]) -> Sequence[bool]:
    """Return the visibility of an object at each of ``count`` time codes: that of any of its particle fields."""
    found = {tuple(field.get("shown", [True] * count)) for field in fields}
    if len(found) > 1:
        notes.append(f"not imported: the visibility of single particle fields of {group}, which is shown as a whole")
    return [any(shown) for shown in zip(*found, strict=True)]


def _unread_motion(records: Record) -> Iterator[str]:
    """Yield a note for each prim that moves in the world or relative to its body, and that this module keeps in place.

    Labelled particle fields without a body are objects. Meshes of bodies are not rendered.
    """
    bodies = {body["path"]: body for body in records["bodies"]}
    for kind in ("fields", "meshes", "lights"):
        for record in records[kind]:
            if "motion" not in record or (kind == "fields" and record["body"] is None and record["label"]):
                continue
            body = bodies.get(record["body"], {}) if kind != "lights" else {}
            relative = np.linalg.inv(body.get("motion", body.get("matrix", np.eye(4)))) @ record["motion"]
            if not np.allclose(relative, relative[0], rtol=0, atol=_STILL):
                place = "" if not body else f" relative to {record['body']}"
                yield f"not imported: the motion of {record['path']}{place}; it stays as at the first time code"


def _hull(path: Path, name: str, splats: Splats) -> trimesh.Trimesh:
    """Return the convex hull of the centres of an object's opaque Gaussians.

    If these span no volume, as those of a card, it is that of the ends of the axes of all Gaussians.
    """
    axes = splats.scales[:, :, None] * np.swapaxes(Rotation.from_quat(splats.quats).as_matrix(), 1, 2)
    ends = np.concatenate([(splats.means[:, None] + sign * axes).reshape(-1, 3) for sign in (1, -1)])
    for points in (opaque_core(splats).astype(np.float64), ends):
        sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if len(points) > 3 else np.zeros(3)
        if sizes[2] > _FLATNESS * sizes[0]:
            return trimesh.convex.convex_hull(points)
    raise InputError(f"{path}: {name}: the Gaussians of an object must span a volume")


def _environment(path: Path, records: Record, fields: Sequence[Record], notes: list[str]) -> Asset:
    """Return the environment: splats that belong to no object, with the proxy meshes that belong to no body."""
    splats, found = merge_fields(path, fields, np.eye(4))
    notes.extend(found)
    known = {**records, "fields": list(fields), "colliders": []}
    asset = make_stage_asset(path, known, None, splats, notes)
    asset = asset or Asset("environment", "environment", splats, kind="environment", capture_light="scene")
    return replace(asset, name="environment", kind="environment", mass=None)


def _shapes(records: Record, folder: Path) -> list[JsonObject]:
    """Write the visible meshes that belong to no body; return their entries in the scene file."""
    found = []
    for number, record in enumerate(one for one in records["meshes"] if one["visible"] and one["body"] is None):
        file = f"shape_{number}.ply"
        placed_mesh(record, np.eye(4)).export(folder / file)
        colour = np.clip(encode_srgb(record["colour"] or (0.3, 0.3, 0.3)), 0, 1).tolist()
        found.append({"name": record["path"], "mesh": file, "visible": True, "collider": False, "colour": colour})
    return found


def _camera(path: Path, record: Record, size: Sequence[int] | None, notes: list[str]) -> Camera:
    """Return a camera of UsdGeom; lengths are in tenths of a unit of the stage.

    Args:
        path: The stage, for messages.
        record: Record of the camera.
        size: Width and height of the image [px], or None.
        notes: List to which notes are appended.
    """
    across, up, pixel_aspect = record["HorizontalAperture"], record["VerticalAperture"], record["pixel_aspect"]
    width, height = size or (_WIDTH, max(1, round(_WIDTH * up * pixel_aspect / across)))
    pose, scale = rigid_frame(path, record)
    image_aspect = pixel_aspect * width / height
    if size and abs(image_aspect * up / across - 1) > _TOLERATED_ASPECT:
        notes.append(
            f"the aperture of {record['path']} has the aspect ratio {across / up:.3f} and its image "
            f"{image_aspect:.3f}: fitted by the policy {record['policy']}"
        )
    across, up = fit_aperture(across, up, image_aspect, record["policy"])
    fx, fy = width * record["FocalLength"] / across, height * record["FocalLength"] / up
    sensor = 0.1 * scale
    return Camera(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=0.5 * width - fx * record["HorizontalApertureOffset"] / record["FocalLength"],
        cy=0.5 * height + fy * record["VerticalApertureOffset"] / record["FocalLength"],
        world_from_camera=pose @ OPENCV_FROM_OPENGL,
        aperture_radius=sensor * record["FocalLength"] / (2 * record["FStop"]) if record["FStop"] > 0 else 0.0,
        focus_distance=scale * record["FocusDistance"] if record["FStop"] > 0 else 1.0,
    )


def _lights(path: Path, record: Record, folder: Path, notes: list[str]) -> list[JsonObject]:
    """Return the entry of a light in the scene file; none, with a note, for lights that it does not have.

    The image of a light is written into the folder.
    """
    inputs, kind = record["inputs"], record["type"]
    frame, scale = rigid_frame(path, record)
    position, normal = frame[:3, 3], -frame[:3, 2]
    strength = inputs.get("intensity", 1.0) * 2.0 ** inputs.get("exposure", 0.0)
    colour = np.array(inputs.get("color", (1.0, 1.0, 1.0)), dtype=np.float64)
    if inputs.get("enableColorTemperature"):
        colour = colour * temperature_colour(inputs.get("colorTemperature", 6500.0))
    peak = float(colour.max())
    if strength * peak <= 0:
        return []
    entry: JsonObject = {"colour": (colour / peak).tolist()}
    strength *= peak
    is_normalised = bool(inputs.get("normalize"))
    place = {"position": position.tolist(), "target": (position + normal).tolist()}
    if kind.startswith("DomeLight"):
        image = _sky(path, record, folder, notes) if inputs.get("texture:file") else None
        if image is None:
            return [{"kind": "environment", "radiance": strength, **entry}]
        radiance, turn = image
        file = f"sky{len(list(folder.glob('sky*.exr')))}.exr"
        write_radiance(folder / file, radiance * np.asarray(entry["colour"], dtype=np.float32))
        return [{"kind": "environment", "radiance": strength, "image": file, "rotate_z": turn}]
    if kind in ("RectLight", "DiskLight"):
        sides = np.array([inputs.get("width", 1.0), inputs.get("height", 1.0)])
        if kind == "DiskLight":
            sides = np.full(2, np.sqrt(np.pi) * inputs.get("radius", 0.5))
        sides = sides * scale
        radiance = strength / sides.prod() if is_normalised else strength
        return [{"kind": "area", "size": sides.tolist(), "radiance": radiance, **place, **entry}]
    if kind == "SphereLight":
        radius = scale * inputs.get("radius", 0.5)
        intensity = strength / 4 if is_normalised else strength * np.pi * radius**2
        cone = inputs.get("shaping:cone:angle", 90.0)
        if cone < 90.0:
            return [{"kind": "spot", "cone": cone, "intensity": intensity, **place, **entry}]
        return [{"kind": "point", "position": place["position"], "intensity": intensity, **entry}]
    if kind == "DistantLight":
        half = np.radians(max(inputs.get("angle", 0.53), 0.1) / 2)
        radiance = strength / (np.pi * np.sin(half) ** 2) if is_normalised else strength
        away, side = -_DISTANCE * normal, np.sqrt(np.pi) * _DISTANCE * np.tan(half)
        sun = {"position": away.tolist(), "target": [0.0, 0.0, 0.0], "size": [side, side], "radiance": radiance}
        return [{"kind": "area", **sun, **entry}]
    notes.append(f"not imported: the light {record['path']} of type {kind}")
    return []


def _sky(path: Path, record: Record, folder: Path, notes: list[str]) -> tuple[Float32Array, float] | None:
    """Return the image of a dome light with its zenith up, and its rotation about the vertical [degrees].

    The upper border of the image is the pole, +y or +z of the prim. With the pole +y, the middle of the image is +z and
    +x is left of it, as OpenEXR defines. The pole +z adds a rotation by 90 degrees about x.
    """
    name, format = record["inputs"]["texture:file"], record["inputs"].get("texture:format", "automatic")
    suffix, place = Path(name).suffix.lower(), f"the image {name} of {record['path']}"
    if record["image"] is None or format not in ("automatic", "latlong") or suffix not in (*HDR_SUFFIXES, *_PICTURES):
        notes.append(f"not imported: {place} (format {format}); the light is uniform")
        return None
    file = folder / f"image{suffix}"
    file.write_bytes(record["image"].tobytes())
    try:
        radiance = read_radiance(file) if suffix in HDR_SUFFIXES else _read_display_encoded(file)
    except InputError as error:
        raise InputError(f"{path}: {place}: {error}") from None
    if format == "automatic" and radiance.shape[1] != 2 * radiance.shape[0]:
        notes.append(f"not imported: {place}, which is not twice as wide as high; the light is uniform")
        return None
    pose, _ = rigid_frame(path, record)
    turn = pose[:3, :3] @ (np.eye(3) if record["pole"] == "Z" else Z_UP_FROM_Y_UP[:3, :3].T)
    if turn[2, 2] > 1 - 1e-9:
        return radiance, float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0])))
    return rotated(radiance, turn), 0.0


def _read_display_encoded(file: Path) -> Float32Array:
    picture = read_picture(file)
    if picture is None:
        raise InputError(f"{file}: not a readable image")
    return decode_srgb(picture[..., ::-1] / 255).astype(np.float32)
