"""Device data of the shapes of a scene, reused from view to view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mitsuba as mi

from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_training import trained_kernel
from mitsplat.quality import KernelName
from mitsplat.renderer.composition.material_borders import MixedObjects
from mitsplat.renderer.composition.shading_normals import NormalMappedShapes
from mitsplat.renderer.composition.shape_state import ShapeState
from mitsplat.renderer.light.light_traits import Traits
from mitsplat.renderer.materials.radiance_grid import RadianceGrid
from mitsplat.renderer.meshes.mirrored_splats import SplatMirror
from mitsplat.renderer.meshes.visible_meshes import VisibleMeshes, is_null, is_transmissive
from mitsplat.renderer.occluders.proxies import Occluder, Proxies
from mitsplat.renderer.occluders.splat_occlusion import Caster
from mitsplat.renderer.projection.clouds import Cloud, CloudSet, Placement, merge_clouds, upload_cloud

_REMEDIES = {
    "Instance": "'instance' are not supported: add the shape at each place",
    "Ellipsoids": "'ellipsoids' are not supported: load the file with a shape of type 'splats'",
    "EllipsoidsMesh": "'ellipsoidsmesh' are not supported: load the file with a shape of type 'splats'",
}
"""Unsupported types of shapes by class name, with what to do instead."""


@dataclass(frozen=True, eq=False)
class SceneContents:
    """Device data of all shapes of a scene that emit no light; reused while these shapes stay the same.

    Attributes:
        state: The shapes with their parameters.
        clouds: Gaussians of the shapes ``splats``; None if there are none.
        placements: Poses and instances of these clouds.
        proxies: Proxy meshes and visible meshes, as surfaces that rays hit.
        meshes: Visible meshes; None if there are none.
        mirror: Splats as path-traced meshes reflect them; None if no mesh is path traced.
        traits: Parameters of the light on each shape.
        grid: Captured colours of the surroundings, for light that they reflect; None without surroundings.
        mixed: Objects with metal and plastic, whose borders are blended; None if there are none.
        normal_mapped: Shapes with normals finer than their proxy meshes; None if there are none.
        kernel: Kernel that the splat files state, see :func:`mitsplat.gaussians.splat_training.trained_kernel`.
    """

    state: ShapeState
    clouds: CloudSet | None
    placements: tuple[Placement, ...]
    proxies: Proxies
    meshes: VisibleMeshes | None
    mirror: SplatMirror | None
    traits: Traits
    grid: RadianceGrid | None
    mixed: MixedObjects | None
    normal_mapped: NormalMappedShapes | None
    kernel: KernelName


class ContentsReader:
    """Upload of the shapes of scenes; uploads of the last scene are reused."""

    def __init__(self) -> None:
        self._contents: SceneContents | None = None
        self._uploaded: list[tuple[Splats, Cloud]] = []
        self._grid: tuple[ShapeState, RadianceGrid | None] | None = None
        self._mirror: tuple[ShapeState, SplatMirror | None] | None = None

    def read(self, scene: mi.Scene, splat_shadows: bool) -> SceneContents:
        """Upload the data of the shapes unless they are those of the last call.

        With ``splat_shadows``, the splats of dynamic objects cast shadows instead of their proxies.
        """
        # Emitter shapes change from frame to frame; as contents they are neither visible nor occluders.
        shapes = tuple(s for s in scene.shapes() if not s.is_emitter())
        known = self._contents
        if known is not None and known.state.holds_for(shapes):
            return known
        carriers = [s for s in shapes if hasattr(s, "world_from_splats")]
        visible = [s for s in shapes if not hasattr(s, "world_from_splats") and not is_null(s.bsdf())]
        for shape in shapes:
            _refuse_unsupported(shape)
        distinct = list({id(c.splats): c.splats for c in carriers}.values())
        number = {id(splats): i for i, splats in enumerate(distinct)}
        placements = tuple(
            Placement(number[id(c.splats)], c.world_from_splats, c.instance, c.appearance) for c in carriers
        )
        occluders = [_occluder(c) for c in carriers if c.proxy is not None]
        casters = None
        if splat_shadows:
            casters = [Caster(c.splats, c.instance, c.world_from_splats) for c in carriers if c.dynamic]
        clouds, meshes = self._upload(distinct), VisibleMeshes.build(visible)
        if meshes is None or meshes.diffuse is None:
            self._mirror = None
        else:
            self._mirror = self._mirrored(carriers, clouds, placements, distinct)
        self._contents = SceneContents(
            state=ShapeState.of(shapes),
            clouds=clouds,
            placements=placements,
            proxies=Proxies(occluders, [s for s in visible if not is_transmissive(s.bsdf())], casters),
            meshes=meshes,
            mirror=None if self._mirror is None else self._mirror[1],
            traits=Traits.of(carriers, placements),
            grid=self._surroundings(carriers),
            mixed=MixedObjects.of(carriers, placements),
            normal_mapped=NormalMappedShapes.of(carriers, placements),
            kernel=trained_kernel(splats.kernel for splats in distinct),
        )
        return self._contents

    def _surroundings(self, carriers: list[mi.Shape]) -> RadianceGrid | None:
        """Return the radiance grid of the largest splats that were captured under the scene's light."""
        static = [c for c in carriers if not (c.dynamic or c.relit) and len(c.splats)]
        if not static:
            return None
        largest = max(static, key=lambda c: len(c.splats))
        if self._grid is None or not self._grid[0].holds_for([largest]):
            grid = RadianceGrid.build(largest.splats, largest.world_from_splats, largest.appearance)
            self._grid = ShapeState.of([largest]), grid
        return self._grid[1]

    def _mirrored(
        self,
        carriers: list[mi.Shape],
        clouds: CloudSet | None,
        placements: Sequence[Placement],
        distinct: Sequence[Splats],
    ) -> tuple[ShapeState, SplatMirror | None]:
        """Return the splats that meshes reflect, which take seconds to build; those of the last call if none moved."""
        if self._mirror is None or not self._mirror[0].holds_for(carriers):
            built = SplatMirror.build(clouds, placements, distinct, [c.relit for c in carriers])
            return ShapeState.of(carriers), built
        state, mirror = self._mirror
        return state, None if mirror is None or clouds is None else replace(mirror, clouds=clouds)

    def _upload(self, distinct: list[Splats]) -> CloudSet | None:
        """Upload splats; copies of the last call are reused, because layouts of a scene share their assets."""
        kept = {id(splats): (splats, cloud) for splats, cloud in self._uploaded}
        self._uploaded = [
            kept.get(id(s)) or (s, upload_cloud(s.means, s.quats, s.scales, s.opacities, s.sh)) for s in distinct
        ]
        clouds = [cloud for _, cloud in self._uploaded]
        return merge_clouds(clouds) if sum(c.count for c in clouds) else None


def _refuse_unsupported(shape: mi.Shape) -> None:
    """Raise an error for shapes that would be rendered wrongly.

    Raises:
        InputError: If the shape is an instance, Mitsuba's own splats, or the border of a medium.
    """
    remedy = _REMEDIES.get(shape.class_name())
    if remedy is not None:
        raise InputError(f"integrator 'splat_proxy': shapes of type {remedy}")
    if shape.is_medium_transition():
        raise InputError(
            f"integrator 'splat_proxy': participating media are not supported: remove 'interior' and 'exterior' of the "
            f"shape {shape.id()!r}"
        )


def _occluder(shape: mi.Shape) -> Occluder:
    """Return the proxy of a ``splats`` shape; captured surroundings take no material, see :class:`RadianceGrid`."""
    splats = shape.splats if shape.dynamic or shape.relit else None
    return Occluder(
        shape.proxy, shape.instance, shape.dynamic, shape.world_from_splats, splats, shape.appearance, shape.gloss
    )
