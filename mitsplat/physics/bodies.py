"""Rigid bodies of assets and static colliders of shapes, with their convex pieces, mass and contact material."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import newton
import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.geometry.decomposition import MAX_PIECES, convex_pieces, max_gap
from mitsplat.geometry.hull_facets import contact_pieces
from mitsplat.geometry.mesh import MassProperties, mass_properties, prepare_mesh
from mitsplat.geometry.mesh_distance import DistanceSurface, standoff
from mitsplat.geometry.solids import join_meshes
from mitsplat.physics.contacts import newton_hull
from mitsplat.physics.friction import ContactMaterial
from mitsplat.progress import Note
from mitsplat.scene.spec.shape_spec import Shape
from mitsplat.scene.walls import bin_walls, pose_matrix

_CONCAVITIES = (0.02, 0.01, 0.005)  # concavity of convex pieces, from coarse to fine


@dataclass(frozen=True, eq=False)
class Body:
    """Dynamic rigid body. Bodies of one asset share it."""

    pieces: tuple[trimesh.Trimesh, ...]
    mass: MassProperties
    material: ContactMaterial

    @cached_property
    def outline(self) -> Float64Array:
        """Vertices of the convex hull [m], shape (N, 3). The largest displacement of the body occurs at one of them."""
        return np.asarray(join_meshes(self.pieces).convex_hull.vertices, dtype=np.float64)

    @cached_property
    def size(self) -> float:
        """Longest extent [m]."""
        return float(np.ptp(self.outline, axis=0).max())

    @cached_property
    def hulls(self) -> list[newton.Mesh]:
        """The pieces as Newton meshes."""
        return [newton_hull(piece) for piece in self.pieces]


@dataclass(frozen=True, eq=False)
class Collider:
    """Static collider: convex pieces in world space, or a box by its full ``size`` [m] and pose (4, 4)."""

    material: ContactMaterial
    pieces: tuple[trimesh.Trimesh, ...] = ()
    box: tuple[tuple[float, float, float], Float64Array] | None = None

    def moved(self, motion: Float64Array) -> Collider:
        """Return the collider after a rigid transform (4, 4)."""
        pieces = tuple(piece.copy().apply_transform(motion) for piece in self.pieces)
        return replace(self, pieces=pieces, box=None if self.box is None else (self.box[0], motion @ self.box[1]))


def all_pieces(bodies: Iterable[Body], colliders: Iterable[Collider]) -> Iterator[trimesh.Trimesh]:
    """Yield the convex pieces of all bodies and colliders."""
    for body in bodies:
        yield from body.pieces
    for collider in colliders:
        yield from collider.pieces


class _ContactShape(NamedTuple):
    pieces: Sequence[trimesh.Trimesh]
    hulls: tuple[trimesh.Trimesh, ...]  # the pieces for contacts, and their standoff [m]
    standoff: float


@dataclass(frozen=True, eq=False)
class Part:
    """Physics data of an asset. What takes long is computed at its first use: a layout has few assets of a large pool.

    Attributes:
        asset: The asset.
        mesh: Its mesh for physics [m].
        progress: Callback for slow operations.
    """

    asset: Asset
    mesh: trimesh.Trimesh
    progress: Note

    @cached_property
    def surface(self) -> DistanceSurface:
        """The surface, for distances."""
        return DistanceSurface(self.mesh)

    @cached_property
    def body(self) -> Body:
        """The rigid body."""
        mass = mass_properties(self.mesh, self._shape.pieces, density=self.asset.density, mass=self.asset.mass)
        return Body(self._shape.hulls, mass, _material(self.asset))

    @property
    def standoff(self) -> float:
        """Standoff of the body's pieces, see :func:`mitsplat.geometry.mesh_distance.standoff` [m]."""
        return self._shape.standoff

    @cached_property
    def _shape(self) -> _ContactShape:
        """The given pieces, or the coarsest convex pieces within the limit, else the finest."""
        mesh, asset, limit = self.mesh, self.asset, max_gap(float(self.mesh.extents.max()))
        finer = (_pieces(mesh, asset.name, self.progress, threshold=threshold) for threshold in _CONCAVITIES)
        for pieces in [asset.pieces] if asset.pieces else finer:
            hulls = contact_pieces(pieces)
            shape = _ContactShape(pieces, hulls, standoff(self.surface, hulls))
            if shape.standoff <= limit:
                break
        return shape


def make_body(asset: Asset, progress: Note) -> Body:
    """Return the rigid body of an asset: its convex pieces, computed if it has none, its mass and its material."""
    return make_part(asset, progress).body


def make_collider(surface: Asset | Shape, mesh: trimesh.Trimesh, progress: Note) -> Collider:
    """Return the static collider of a shape, or of an environment.

    Args:
        surface: The shape or environment.
        mesh: Its mesh in world space [m], prepared by :func:`mitsplat.geometry.mesh.prepare_mesh`.
        progress: Callback for slow operations.
    """
    if isinstance(surface, Asset):
        pieces = surface.pieces or _pieces(mesh, surface.name, progress)
        return Collider(_material(surface), pieces=contact_pieces(pieces))
    if surface.bin is not None:
        return Collider(_material(surface), pieces=bin_walls(surface.bin))
    if surface.box is None:
        return Collider(_material(surface), pieces=contact_pieces(_pieces(mesh, surface.name, progress)))
    return Collider(_material(surface), box=(surface.box.size, pose_matrix(surface.box)))


def make_part(asset: Asset, progress: Note) -> Part:
    """Return the physics data of an asset, whose mesh is checked at once.

    Raises:
        InputError: If the asset has no mesh, or its mesh has no volume.
    """
    if asset.mesh is None:
        raise InputError(f"asset {asset.name!r} must have a mesh for physics (got none)")
    return Part(asset, prepare_mesh(asset.mesh, f"asset {asset.name!r}"), progress)


def _material(surface: Asset | Shape) -> ContactMaterial:
    return ContactMaterial(surface.friction, surface.restitution, surface.rolling_friction, surface.torsional_friction)


def _pieces(
    mesh: trimesh.Trimesh, name: str, progress: Note, *, threshold: float = _CONCAVITIES[0]
) -> tuple[trimesh.Trimesh, ...]:
    progress(f"computing convex pieces of {name}")
    return convex_pieces(mesh, threshold=threshold, max_pieces=round(MAX_PIECES * _CONCAVITIES[0] / threshold))
