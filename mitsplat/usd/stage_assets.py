"""Assets from untrusted USD stages."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from pydantic import ValidationError
from scipy.spatial import QhullError

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.asset import COMMON_KEYS, Asset, AssetSpec
from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import encode_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.geometry.decomposition import convex_pieces
from mitsplat.geometry.mesh import mass_properties, prepare_mesh
from mitsplat.geometry.rigid import homogeneous_matrix, split_similarity
from mitsplat.storage.files import JsonObject
from mitsplat.usd.stage_physics import Record
from mitsplat.usd.stage_reader import unread_note
from mitsplat.usd.stage_records import read_records

_ENCODED = ("", "srgb_rec709_scene", "srgb_rec709_display", "srgb_texture", "sRGB", "auto", "raw")
"""Colour spaces whose coefficients are taken as they are. Files that state none are 3DGS files as a rule."""
_LINEAR = ("lin_rec709_scene", "lin_rec709", "lin_srgb")
_FLAT = 0.01
"""Thickness of Gaussians without any, relative to the smallest of their other scales."""
_INERTIA_TOLERANCE = 0.02
"""Tolerated difference of the inertia, and of the centre of mass over the size, from those of a uniform density."""
_DEFAULT_FRICTION = 0.5

_STATED = ("rolling_friction", "torsional_friction", "roughness", "specular", "white")
"""Values of an asset that the stage states alone, if at all."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class StageAsset:
    """Content of a stage with one object or environment.

    Attributes:
        splats: All splats in metres with z up, in the frame of the object's rigid body or else of the stage.
        asset: The asset, if the stage has its geometry: a proxy mesh or colliders; else None.
        notes: What was not read, one sentence each.
    """

    splats: Splats
    asset: Asset | None
    notes: tuple[str, ...]


def read_stage_asset(path: Path) -> StageAsset:
    """Read the splats of all particle fields of a stage, and the asset if the stage states its geometry.

    Raises:
        InputError: If the stage is damaged, has no particle field or several rigid bodies, or breaks a rule.
        MissingResourceError: If OpenUSD is not installed.
    """
    records = read_records(path)
    fields, notes = records["fields"], list(records["notes"])
    if not any(len(field["means"]) for field in fields):
        raise InputError(f"{path}: must have a ParticleField3DGaussianSplat with Gaussians (got none)")
    bodies = {field["body"] for field in fields}
    if len(bodies) > 1:
        raise InputError(
            f"{path}: must have one object (its splats belong to {len(bodies)} rigid bodies and surroundings)"
        )
    notes += [
        unread_note(kind, [record["path"] for record in records[kind]])
        for kind in ("cameras", "lights")
        if records[kind]
    ]
    if any("motion" in record for record in (*fields, *records["bodies"])):
        notes.append("not imported: the motion of prims, which are read at the first time code")
    frame = body_frames(path, records["bodies"]).get(bodies.pop(), np.eye(4))
    splats, found_notes = merge_fields(path, fields, frame)
    asset = make_stage_asset(path, records, fields[0]["body"], splats, notes)
    notes += found_notes
    for note in notes:
        _logger.warning("%s: %s", path, note)
    return StageAsset(splats, asset, tuple(notes))


def body_frames(path: Path, bodies: Sequence[Record]) -> dict[str | None, Float64Array]:
    """Return the rigid frames ``world_from_body`` (4, 4) of rigid bodies, without the scale of their prims."""
    return {body["path"]: rigid_frame(path, body)[0] for body in bodies}


def rigid_frame(path: Path, record: Record) -> tuple[Float64Array, float]:
    """Return the rigid transform (4, 4) of a record's matrix, and its uniform scale; ``path`` is that of the stage.

    Raises:
        InputError: If the matrix mirrors, shears or scales non-uniformly.
    """
    try:
        rotation, scale, translation = split_similarity(record["matrix"])
    except ValueError as error:
        raise InputError(f"{path}: {record['path']}: {error}") from None
    return homogeneous_matrix(rotation, translation), scale


def merge_fields(path: Path, fields: Sequence[Record], frame: Float64Array) -> tuple[Splats, list[str]]:
    """Return the splats of particle fields in a frame of this pose (4, 4), and notes on changed values."""
    notes: list[str] = []
    frame_from_world = np.linalg.inv(frame)
    parts = []
    for field in fields:
        try:
            parts.append(_splats(field, notes).transformed(frame_from_world @ field["matrix"]))
        except ValueError as error:
            raise InputError(f"{path}: {field['path']}: {error}") from None
    if len(parts) == 1:
        return parts[0], notes
    if any(part.materials is not None for part in parts):
        notes.append("not imported: materials of splats, because they come from several particle fields")
    return Splats.concatenate(parts), notes


def _splats(field: Record, notes: list[str]) -> Splats:
    """Return the splats of a particle field in its own coordinates."""
    scales: Float32Array = field["scales"]
    flat = (scales == 0) & (scales.max(axis=1, keepdims=True) > 0)
    if flat.any():
        notes.append(
            f"not imported: the thickness 0 of {int(flat.any(axis=1).sum())} Gaussians of {field['path']}; they got one"
        )
        thinnest = np.where(scales > 0, scales, np.inf).min(axis=1, keepdims=True)
        scales = np.where(flat, _FLAT * thinnest, scales)
    space, sh = field["colour_space"], field["sh"]
    if space in _LINEAR:
        sh = encode_sh(sh)
        if sh.shape[1] > 1:
            notes.append(f"not imported: colours beyond first order: the linear ones of {field['path']} were encoded")
    elif space not in _ENCODED:
        notes.append(f"not imported: the colour space {space} of {field['path']}, which is read as sRGB")
    materials = None
    if "metallic" in field:
        materials = SplatMaterials(field["metallic"], field["roughness"], field["specular"], field.get("normals"))
    return Splats(
        field["means"], field["quats"], scales, field["opacities"], sh, materials, field["metadata"].get("kernel")
    )


def make_stage_asset(path: Path, records: Record, body: str | None, splats: Splats, notes: list[str]) -> Asset | None:
    """Return the asset of a rigid body, or of everything that belongs to none; None if it has no geometry.

    Args:
        path: The stage, for messages.
        records: Records of the stage.
        body: Path of the body, or None.
        splats: Splats in the frame of the body.
        notes: List to which notes are appended.
    """
    frames = body_frames(path, records["bodies"])
    frame_from_world = np.asarray(np.linalg.inv(frames.get(body, np.eye(4))), dtype=np.float64)
    colliders = [one for one in records["colliders"] if one["body"] == body]
    proxies = [one for one in records["meshes"] if one["body"] == body and not one["visible"]]
    if not colliders and not proxies:
        return None
    pieces = tuple(piece for one in colliders for piece in _pieces(path, one, frame_from_world))
    if proxies:
        mesh = trimesh.util.concatenate([placed_mesh(one, frame_from_world) for one in proxies])
    else:
        mesh = trimesh.boolean.union(list(pieces), engine="manifold") if len(pieces) > 1 else pieces[0]
    values: JsonObject = next((one["metadata"] for one in records["fields"] if one["body"] == body), {})
    contact: JsonObject = {}
    for name, default in (("friction", _DEFAULT_FRICTION), ("restitution", 0.0)):
        stated = sorted({round(one[name], 6) for one in colliders if one[name] is not None})
        if len(stated) > 1:
            notes.append(
                f"not imported: values of {name} except the first of {', '.join(f'{value:g}' for value in stated)}"
            )
        contact[name] = stated[0] if stated else values.get(name, default)
    label = next((one["label"] for one in records["fields"] if one["body"] == body and one["label"]), None)
    name = values.get("name") or (body or records["default"] or path.stem).rpartition("/")[2]
    dynamics: Record = next((one for one in records["bodies"] if one["path"] == body), {})
    kind = values.get("kind", "object" if body or colliders else "environment")
    if kind == "object" and body is None:
        notes.append(
            "not imported: the mass, because the colliders belong to no rigid body; the density is 1000 kg/m^3"
        )
    asset = _checked(
        path,
        Asset(
            name=name,
            class_name=label or name,
            splats=splats,
            mesh=mesh,
            pieces=pieces,
            kind=kind,
            mass=dynamics.get("mass"),
            density=dynamics.get("density") or 1000.0,
            capture_light=values.get("capture_light", "uniform" if kind == "object" else "scene"),
            keypoints={key: tuple(place) for key, place in values.get("keypoints", {}).items()},
            **contact,
            **{key: values[key] for key in _STATED if key in values},
        ),
    )
    if kind == "object" and dynamics.get("inertia") is not None:
        notes.extend(_inertia_notes(path, asset, dynamics))
    return asset


def _checked(path: Path, asset: Asset) -> Asset:
    """Check the values of an asset by the rules of its file."""
    names = (*COMMON_KEYS, "class_name", "density", "keypoints")
    values = {name: getattr(asset, name) for name in names} | {"splats": "-", "mesh": "-"}
    if asset.mass is not None:
        del values["density"]
    try:
        AssetSpec(**values)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']} (got {first['input']!r})"
        ) from None
    return asset


def _inertia_notes(path: Path, asset: Asset, body: Record) -> list[str]:
    """Return a note if the inertia or centre of mass of a stage differs from that of a uniform density."""
    if asset.mesh is None:
        return []
    mass = mass_properties(prepare_mesh(asset.mesh, asset.name), asset.pieces, density=asset.density, mass=asset.mass)
    moments, stated = np.linalg.eigvalsh(mass.inertia), np.sort(body["inertia"])
    _, scale = rigid_frame(path, body)
    centre = mass.centre if body["centre"] is None else scale * np.array(body["centre"])
    size = float(asset.mesh.extents.max())
    if (
        np.abs(moments - stated).max() <= _INERTIA_TOLERANCE * moments.max()
        and np.abs(centre - mass.centre).max() <= _INERTIA_TOLERANCE * size
    ):
        return []
    return ["not imported: the inertia and centre of mass, because an asset has those of a uniform density"]


def placed_mesh(record: Record, frame_from_world: Float64Array) -> trimesh.Trimesh:
    """Return the mesh of a record in a frame [m], which ``frame_from_world`` (4, 4) defines."""
    mesh = trimesh.Trimesh(record["points"], record["faces"], process=False)
    mesh.apply_transform(frame_from_world @ record["matrix"])
    return mesh


def _pieces(path: Path, record: Record, frame_from_world: Float64Array) -> Sequence[trimesh.Trimesh]:
    """Return the convex pieces of a collider in a frame [m]."""
    mesh = placed_mesh(record, frame_from_world)
    if record["approximation"] not in ("convexHull", "boundingCube", "boundingSphere"):
        return convex_pieces(prepare_mesh(mesh, f"{path}: {record['path']}"))
    try:
        return [mesh.convex_hull]
    except (QhullError, ValueError):
        raise InputError(f"{path}: {record['path']}: a convex collider must span a volume") from None


def with_values(
    asset: Asset,
    name: str | None,
    class_name: str | None,
    *,
    mass: float | None,
    density: float | None,
    friction: float | None,
    light: Literal["uniform", "scene"] | None,
) -> Asset:
    """Return an asset with the values that the user gives in place of those of the stage."""
    if mass is not None and density is not None:
        raise InputError("density and mass must not both be given")
    if density is not None:
        asset = replace(asset, mass=None, density=density)
    return _checked(
        Path(name or asset.name),
        replace(
            asset,
            name=name or asset.name,
            class_name=class_name or name or asset.class_name,
            mass=mass or asset.mass,
            friction=asset.friction if friction is None else friction,
            capture_light=light or asset.capture_light,
        ),
    )
