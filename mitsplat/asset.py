"""Assets on disk: one object or one environment, as splats with an aligned proxy mesh.

A folder holds ``asset.yaml`` (:class:`AssetSpec` lists its keys) and the files that it names::

    name: hammer
    class: hammer
    splats: hammer.splat    # any format of mitsplat.gaussians.splat_files
    mesh: hull              # or a mesh file in the same units and axes
    up: -y                  # axis of the files that points up
    size: 0.2               # longest extent [m]; or units: metres per file unit
    mass: 0.5
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
import trimesh
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from ruamel.yaml import YAML
from scipy.spatial import QhullError

from mitsplat.arguments import checks_arguments, path_of
from mitsplat.arrays import Float32Array, Float64Array, Int64Array
from mitsplat.errors import InputError
from mitsplat.gaussians.material_files import write_materials
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.mesh_normals import state_normals, stated_normals
from mitsplat.geometry.rigid import homogeneous_matrix, scaling, transform_points
from mitsplat.geometry.solids import is_closed
from mitsplat.mesh_files.mesh_reading import read_mesh, read_proxy
from mitsplat.storage.field_types import Name, Positive
from mitsplat.storage.file_kinds import no_folder_with
from mitsplat.storage.files import resolve_inside, storage_errors
from mitsplat.storage.format_version import FORMAT_VERSIONS
from mitsplat.storage.yaml_input import FieldError, key_place, load_yaml

Length = Annotated[float, Field(ge=1e-9, le=1e9)]
"""Positive length. The bounds keep its cube within the range of a float32."""

ASSET_FILE = "asset.yaml"
COMMON_KEYS = (
    *("name", "kind", "mass", "friction", "restitution", "rolling_friction", "torsional_friction"),
    *("roughness", "specular", "capture_light", "white"),
)
"""Keys with the same value in :class:`AssetSpec` and :class:`Asset`."""
_Z_UP_FROM = {
    "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
"""Smallest rotation that maps each axis to +z."""

_SPZ_UNITS = 1e-3
"""Metres per unit of ``.spz`` assets.

The smallest scale of the format is 4.5e-5 units. In metres this would be 45 um, which is too coarse.
"""

_OPAQUE_THRESHOLD = 0.5
_BOUNDS_TOLERANCE = 0.05
"""Tolerated difference between the bounds of splats, mesh and pieces, as a fraction of the asset's size."""


class AssetSpec(BaseModel):
    """Keys of ``asset.yaml``. All named files lie inside its folder and share units and axes."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)

    format_version: int = Field(1, ge=1, description="Version of what this file says; 1 if absent.")
    name: Name = Field(description="Name of the asset.")
    class_name: Name | None = Field(None, alias="class", description="Class to learn; else the name.")
    kind: Literal["object", "environment"] = "object"
    splats: str = Field(description="Splat file.")
    materials: str | None = Field(
        None, description="PLY file with the material of each Gaussian; the colours of the splats are base colours."
    )
    mesh: str | None = Field(None, description="Mesh file, or 'hull': the convex hull of the opaque splats.")
    pieces: str | None = Field(None, description="Mesh file whose connected parts are convex pieces of the mesh.")
    units: Length | Literal["unknown"] | None = Field(
        None, description="Metres per unit of the files, 1 if neither this nor size is given; or unknown."
    )
    size: Length | None = Field(None, description="Longest extent [m], instead of units.")
    up: Literal["x", "-x", "y", "-y", "z", "-z"] = Field("z", description="Axis of the files that points up.")
    density: Positive | None = Field(None, description="[kg/m^3]; 1000 if neither this nor mass is given.")
    mass: Positive | None = Field(None, description="[kg], instead of density.")
    friction: float = Field(0.5, ge=0, description="Coulomb friction coefficient.")
    restitution: float = Field(
        0.0, ge=0, le=1, exclude_if=lambda share: share == 0, description="Coefficient of restitution."
    )
    rolling_friction: float | None = Field(
        None, ge=0, description="Length of rolling friction [m]; 0.0005, at most 1 % of the size, if absent."
    )
    torsional_friction: float | None = Field(
        None, ge=0, description="Contact radius of spin friction [m]; 0.01, at most a fifth of the size, if absent."
    )
    roughness: float = Field(0.4, gt=0, le=1, description="GGX roughness of captured splats; not used with materials.")
    specular: float = Field(
        0.04,
        ge=0,
        le=1,
        description="Specular reflectance of captured splats at normal incidence; not used with materials.",
    )
    capture_light: Literal["uniform", "scene"] = "uniform"
    keypoints: dict[Name, tuple[float, float, float]] | None = Field(
        None, description="Named points in the units and axes of the files, for pose labels."
    )
    white: Positive | None = Field(
        None, description="Irradiance under which a white surface has the colour 1 in the splats [W/m^2]; if known."
    )

    @model_validator(mode="after")
    def _check(self) -> AssetSpec:
        if isinstance(self.units, float) and self.size is not None:
            raise FieldError("size", "must not be given together with units")
        if self.mass is not None and self.density is not None:
            raise FieldError("mass", "must not be given together with density")
        if self.kind == "object" and self.mesh is None:
            raise FieldError("mesh", "an object needs a mesh: a file, or 'hull' for the convex hull of its splats")
        return self


@checks_arguments
@dataclass(frozen=True, eq=False, repr=False)
class Asset:
    """One object or one environment in metres, z up.

    Attributes:
        name: Name of the asset. Several assets of a scene may have the same name.
        class_name: Class name in the labels.
        splats: Appearance, in the asset's frame.
        mesh: Proxy surface in the same frame, or None (optional for an environment).
        pieces: Convex pieces of the mesh for physics; empty before decomposition.
        kind: ``object`` (moved by physics) or ``environment`` (static).
        density: Mass density [kg/m^3]; ignored if ``mass`` is given.
        mass: Mass [kg] or None.
        friction: Coulomb friction coefficient.
        restitution: Coefficient of restitution in [0, 1].
        rolling_friction: Length of rolling friction [m], or None: derived from the size.
        torsional_friction: Contact radius of spin friction [m], or None: derived from the size.
        roughness: GGX roughness of captured splats in (0, 1]; not used with materials.
        specular: Specular reflectance of captured splats at normal incidence in [0, 1]; not used with materials.
        capture_light: Light under which the colours were captured. ``uniform`` (light tent, turntable in the shade):
            the scene's lights relight the asset. ``scene`` (already lit as displayed): the scene's lights only add
            shadows.
        keypoints: Named points in the asset's frame [m], for pose labels.
        white: Irradiance [W/m^2] of the scene's lights at which a white surface has the colour 1 in an environment's
            splats: pi for baked environments, None if the exposure is unknown, as in photographs.
        units: ``metre``, or ``unknown`` if the size is arbitrary; a scene must then set the size.
        folder: Folder of the asset's files, or None.
    """

    name: str
    class_name: str
    splats: Splats
    mesh: trimesh.Trimesh | None = None
    pieces: tuple[trimesh.Trimesh, ...] = ()
    kind: Literal["object", "environment"] = "object"
    density: float = 1000.0
    mass: float | None = None
    friction: float = 0.5
    restitution: float = 0.0
    rolling_friction: float | None = None
    torsional_friction: float | None = None
    roughness: float = 0.4
    specular: float = 0.04
    capture_light: Literal["uniform", "scene"] = "uniform"
    keypoints: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    white: float | None = None
    units: Literal["metre", "unknown"] = "metre"
    folder: Path | None = None

    def __repr__(self) -> str:
        faces = 0 if self.mesh is None else len(self.mesh.faces)
        return f"Asset({self.name!r}: {self.kind}, {len(self.splats)} Gaussians, {faces} faces)"

    @classmethod
    def load(cls, folder: str | PathLike[str]) -> Asset:
        """Read an asset folder and convert it to metres and z up.

        Raises:
            InputError: If ``asset.yaml`` or a file that it names is missing or breaks a rule.
        """
        folder = path_of(folder, "folder")
        spec = read_spec(folder)
        materials = None if spec.materials is None else _named_file(folder, "materials", spec.materials)
        splats = Splats.load(_named_file(folder, "splats", spec.splats), materials=materials)
        if spec.mesh is None:
            mesh = None
        elif spec.mesh == "hull":
            mesh = _hull(opaque_core(splats), key_place(folder / ASSET_FILE, ("mesh",)))
        else:
            mesh = read_proxy(_named_file(folder, "mesh", spec.mesh))
        asset = cls(
            **{key: getattr(spec, key) for key in COMMON_KEYS},
            class_name=spec.class_name or spec.name,
            splats=splats,
            mesh=mesh,
            pieces=() if spec.pieces is None else _read_pieces(_named_file(folder, "pieces", spec.pieces)),
            density=1000.0 if spec.density is None else spec.density,
            keypoints=spec.keypoints or {},
            units="unknown" if spec.units == "unknown" and spec.size is None else "metre",
            folder=folder,
        )
        metres_from_file = homogeneous_matrix(np.multiply(_Z_UP_FROM[spec.up], _metres_per_unit(spec, asset)))
        return asset if np.array_equal(metres_from_file, np.eye(4)) else asset.transformed(metres_from_file)

    def save(self, folder: str | PathLike[str], *, splats: str = "splats.ply") -> None:
        """Write the asset as a folder: ``asset.yaml``, splats, ``materials.ply``, ``mesh.ply`` and ``pieces.ply``.

        Meshes are written as shapes only, in float32, and the proxy with the normals that its source states.

        Args:
            folder: Target folder. It is created if it is missing; files of these names in it are replaced.
            splats: Name of the splat file; its suffix selects the format (``.ply``, ``.splat`` or ``.spz``).

        Raises:
            InputError: If a value breaks a rule of :class:`AssetSpec` or the folder cannot be written.
            MissingResourceError: If the disk is full.
        """
        folder = path_of(folder, "folder")
        units = _SPZ_UNITS if splats.lower().endswith(".spz") and self.units == "metre" else 1.0
        stored = self if units == 1.0 else self.transformed(scaling(1 / units))
        try:
            spec = AssetSpec(
                format_version=FORMAT_VERSIONS[ASSET_FILE],
                **{key: getattr(self, key) for key in COMMON_KEYS},
                class_name=self.class_name,
                splats=splats,
                materials=None if self.splats.materials is None else "materials.ply",
                mesh=None if self.mesh is None else "mesh.ply",
                pieces="pieces.ply" if self.pieces else None,
                units=units if self.units == "metre" else "unknown",
                density=self.density if self.mass is None else None,
                keypoints=dict(stored.keypoints) or None,
            )
        except ValidationError as error:
            first = error.errors()[0]
            rule = ": ".join([*map(str, first["loc"]), first["msg"].removeprefix("Value error, ")])
            raise InputError(f"asset {self.name!r} cannot be saved: {rule}") from error
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            # Files are written to a temporary folder first, so that an earlier asset stays complete until the new one
            # is.
            with TemporaryDirectory(prefix=".asset-", dir=folder) as apart:
                new = Path(apart)
                stored.splats.save(new / splats)
                if stored.splats.materials is not None:
                    write_materials(stored.splats.materials, new / "materials.ply")
                if stored.mesh is not None:
                    shape = _concatenated([stored.mesh])
                    if (normals := stated_normals(stored.mesh)) is not None:
                        state_normals(shape, normals)
                    shape.export(new / "mesh.ply")
                if stored.pieces:
                    _concatenated(stored.pieces).export(new / "pieces.ply")
                described = new / ASSET_FILE
                unused = set() if self.splats.materials is None else {"roughness", "specular"}
                YAML(pure=True).dump(spec.model_dump(by_alias=True, exclude_none=True, exclude=unused), described)
                (folder / ASSET_FILE).unlink(missing_ok=True)
                for file in sorted(new.iterdir(), key=lambda file: file == described):
                    file.replace(folder / file.name)

    def transformed(self, matrix: npt.ArrayLike) -> Asset:
        """Return the asset with splats, mesh, pieces and keypoints transformed by a similarity (4, 4).

        Mass and density do not change.

        Raises:
            ValueError: If the matrix shears, mirrors or scales unevenly.
        """
        matrix = np.asarray(matrix, dtype=np.float64)
        return replace(
            self,
            splats=self.splats.transformed(matrix),
            mesh=None if self.mesh is None else self.mesh.copy().apply_transform(matrix),
            pieces=tuple(piece.copy().apply_transform(matrix) for piece in self.pieces),
            keypoints=dict(
                zip(self.keypoints, map(tuple, transform_points(matrix, self.keypoint_array).tolist()), strict=True)
            ),
        )

    @property
    def keypoint_array(self) -> Float64Array:
        """Positions of the keypoints in their order [m], shape (K, 3)."""
        return np.array(list(self.keypoints.values()), dtype=np.float64).reshape(-1, 3)

    def scaled(self, factor: float) -> Asset:
        """Return the asset scaled about its origin at constant density; a given mass grows with the volume.

        Raises:
            ValueError: If ``factor`` is not finite and > 0.
        """
        if not 0 < factor < np.inf:
            raise ValueError(f"scale factor must be finite and > 0 (got {factor})")
        scaled = self.transformed(scaling(factor))
        return scaled if self.mass is None else replace(scaled, mass=self.mass * factor**3)

    def factor_to(self, size: float) -> float:
        """Compute the scale factor for a longest extent ``size`` [m].

        The extent is that of the mesh, or of the opaque splats if there is no mesh.

        Raises:
            InputError: If the extent is zero.
        """
        points = opaque_core(self.splats) if self.mesh is None else self.mesh.vertices
        extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
        if not extent > 0:
            raise InputError(
                f"{self.folder or self.name}: size needs a mesh, or splats with opacity > "
                f"{_OPAQUE_THRESHOLD}, of nonzero extent (got 0)"
            )
        return size / extent

    def resized(self, size: float) -> Asset:
        """Convert an asset of unknown units to metres by its longest extent [m]; a given mass does not change.

        Raises:
            InputError: If the asset is already in metres, or has no extent.
        """
        if self.units == "metre":
            raise InputError(f"asset {self.name!r} is in metres: it takes a scale, not a size")
        return replace(self.transformed(scaling(self.factor_to(size))), units="metre")

    def check(self) -> tuple[str, ...]:
        """Return warnings about the asset, one sentence each; none of them prevents its use."""
        if self.mesh is None:
            return ()
        findings = []
        if not is_closed(self.mesh):
            findings.append("the mesh is not closed: mass and inertia come from its convex pieces")
        size = float(self.mesh.extents.max())
        bounds = {"pieces": [piece.bounds for piece in self.pieces]}
        core = opaque_core(self.splats)
        bounds["splats"] = [np.stack([core.min(axis=0), core.max(axis=0)])] if len(core) else []
        for what, boxes in bounds.items():
            if boxes:
                joint = np.stack([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])
                offset = float(np.abs(joint - self.mesh.bounds).max())
                if offset > _BOUNDS_TOLERANCE * size:
                    findings.append(f"the bounds of {what} and mesh differ by {offset:.3g} m on {size:.3g} m")
        return tuple(findings)


def read_spec(folder: str | PathLike[str]) -> AssetSpec:
    """Read and validate the ``asset.yaml`` of an asset folder.

    Raises:
        InputError: If the file is missing, has a newer format version or breaks a rule.
    """
    path = Path(folder) / ASSET_FILE
    if not os.path.lexists(path):
        raise no_folder_with(Path(folder), ASSET_FILE, "an asset folder")
    return load_yaml(path, AssetSpec, newest=FORMAT_VERSIONS[ASSET_FILE])


def _named_file(folder: Path, key: str, name: str) -> Path:
    """Return the path of a file that ``asset.yaml`` names, see :func:`mitsplat.storage.files.resolve_inside`."""
    try:
        return resolve_inside(folder, name)
    except InputError as error:
        raise InputError(f"{key_place(folder / ASSET_FILE, (key,))}: {error}") from error


def _metres_per_unit(spec: AssetSpec, asset: Asset) -> float:
    """Return the scale of an asset that is still in the units of its files."""
    if spec.size is not None:
        return asset.factor_to(spec.size)
    return spec.units if isinstance(spec.units, float) else 1.0


def opaque_core(splats: Splats) -> Float32Array:
    """Return the centres (M, 3) of opaque Gaussians without floaters.

    Floaters lie more than a quarter of the range of the central 98 % outside that range along an axis.
    """
    centres = splats.means[splats.opacities > _OPAQUE_THRESHOLD]
    if not len(centres):
        return centres
    low, high = np.percentile(centres, (1, 99), axis=0)
    margin = 0.25 * (high - low)
    inside = ((centres >= low - margin) & (centres <= high + margin)).all(axis=1)
    core: Float32Array = centres[inside]
    return core


def _hull(points: npt.NDArray[np.floating], place: str) -> trimesh.Trimesh:
    """Compute the convex hull of points (N, 3). An error for points without volume begins with ``place``."""
    try:
        hull: trimesh.Trimesh = trimesh.convex.convex_hull(points)
    except (QhullError, ValueError) as error:
        raise InputError(f"{place}: a hull needs points that span a volume (got {len(points)} points)") from error
    return hull


def _read_pieces(path: Path) -> tuple[trimesh.Trimesh, ...]:
    """Read a mesh file and return the convex hulls of its parts."""
    mesh = read_mesh(path, merge=False)
    numbers = _part_numbers(mesh)
    parts = [mesh.vertices[np.unique(mesh.faces[numbers == number])] for number in dict.fromkeys(numbers.tolist())]
    return tuple(_hull(part, str(path)) for part in parts)


def _part_numbers(mesh: trimesh.Trimesh) -> Int64Array:
    """Return the number of the part of each face, shape (F,).

    Closed surfaces are parts, even if they have vertices in common. Other faces are of the part with which they have a
    vertex in common: hulls by Qhull can have faces without neighbours.
    """
    surfaces = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    edges, uses = np.unique(np.column_stack([surfaces[mesh.edges_face], mesh.edges_sorted]), axis=0, return_counts=True)
    is_open = np.zeros(surfaces.max() + 1, dtype=bool)
    is_open[edges[uses != 2, 0]] = True
    is_joint = np.zeros(len(mesh.vertices), dtype=bool)
    is_joint[mesh.faces[is_open[surfaces]]] = True
    joints = np.column_stack([np.repeat(surfaces, 3), len(is_open) + mesh.faces.ravel()])[is_joint[mesh.faces.ravel()]]
    parts = trimesh.graph.connected_component_labels(joints, node_count=len(is_open) + len(mesh.vertices))
    return np.asarray(parts[surfaces], dtype=np.int64)


def _concatenated(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Concatenate the triangles of all meshes, without colours, textures or vertex merging."""
    vertices, faces = trimesh.util.append_faces([mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes])
    return trimesh.Trimesh(vertices, faces, process=False)
