"""HTML report of an imported splat file, and a first scene for it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsplat.errors import InputError
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.mesh import mass_properties
from mitsplat.importing.import_result import Imported
from mitsplat.pages.html import figure_of, make_figure, make_section, rgb_image, verdict_of, write_report_page
from mitsplat.reconstruct.asset_evaluation import show_asset
from mitsplat.storage.files import is_inside, write_text, yaml_scalar

_VIEW = 420
_REMOVED_VIEWS = 4
"""Number of views that show the removed Gaussians."""


def write_import_report(folder: Path, imported: Imported) -> Path:
    """Write ``report.html`` into an asset's folder.

    Raises:
        OSError: If the page cannot be written.
    """
    return write_report_page(
        folder, imported.asset.name, "import", [_verdict(imported), _views(imported), _removed(imported)]
    )


def _verdict(imported: Imported) -> str:
    asset = imported.asset
    unit = "m" if asset.units == "metre" else "in the file's units"
    rows: dict[str, str | None] = {
        "Up": imported.upright.reason,
        "Gaussians": imported.removed_of_all,
        "Trained": imported.training,
        "IoU of mesh and splats": figure_of(imported.mesh_iou, "{:.3f}"),
        "Shift between mesh and splats": figure_of(imported.offset, "{:.3%} of the diagonal"),
        "Captured light": asset.capture_light,
    }
    if asset.mesh is not None:
        rows["Extents"] = " x ".join(f"{extent:.4g}" for extent in asset.mesh.extents) + f" {unit}"
        rows["Mesh"] = f"{len(asset.mesh.faces)} faces, {'watertight' if imported.watertight else 'open'}"
        if asset.pieces and asset.units == "metre":
            mass = mass_properties(asset.mesh, asset.pieces, density=asset.density, mass=asset.mass)
            rows["Mass"] = f"{mass.mass:.4g} kg in {len(asset.pieces)} convex pieces"
    if imported.support is not None:
        width, depth = imported.support.size
        rows["Surface to drop on"] = (
            f"{width:.3g} x {depth:.3g} {unit}, {imported.support.share:.0%} of the visible area"
        )
    return make_section("verdict", "Verdict", verdict_of(imported.misses, "Nothing to note.", rows))


def _views(imported: Imported) -> str:
    rows = []
    for number, view in enumerate(imported.views, 1):
        pictures = {
            "splats": view.picture,
            "mesh": view.shaded(0.5),
            "mesh over splats": view.shaded(view.picture, 0.5),
        }
        images = "".join(
            make_figure(f"view {number}, {kind}", kind, rgb_image(shown, _VIEW)) for kind, shown in pictures.items()
        )
        rows.append(f'<div class="row">{images}</div>')
    note = "<p>The pictures have the up direction of scenes. The mesh was reconstructed from other views.</p>"
    return make_section("views", "Views", note + ("".join(rows) or "<p>none</p>"))


def _removed(imported: Imported) -> str:
    """Show the removed Gaussians in red beside the remaining ones."""
    removed_splats = imported.removed_splats
    if not len(removed_splats) or not imported.views:
        return ""
    red = np.tile(rgb_to_sh(np.array([0.9, 0.1, 0.1])).astype(np.float32), (len(removed_splats), 1, 1))
    everything = Splats.concatenate([imported.asset.splats, replace(removed_splats, sh=red)])
    cameras = [view.camera for view in imported.views[:_REMOVED_VIEWS]]
    images = "".join(
        make_figure(f"view {number}, removed in red", f"view {number}", rgb_image(view.picture, _VIEW))
        for number, view in enumerate(show_asset(everything, None, cameras), 1)
    )
    return make_section("removed", "Removed", f'<p>Removed Gaussians are red.</p><div class="row">{images}</div>')


def check_scene_path(path: Path, asset_folder: Path, *, known: bool) -> None:
    """Refuse a scene file that could not be written for an asset, before the asset is created.

    Args:
        path: Scene file.
        asset_folder: Folder of the asset.
        known: True if the size of the asset is known.

    Raises:
        InputError: If the file exists, the asset is not below its folder, or the size of the asset is unknown.
    """
    if path.exists():
        raise InputError(f"{path}: must not exist yet: name another scene, or remove the file")
    if not known:
        raise InputError(f"{path}: a scene is in metres: give --size or --units as well")
    if not is_inside(path.parent, os.path.relpath(asset_folder, path.parent)):
        raise InputError(f"{path}: a scene reads only files below its own folder (got the asset {asset_folder})")


def write_scene(path: Path, asset_folder: Path, imported: Imported) -> None:
    """Write a first scene file: the object on a table, or solids dropped on a flat part of the environment.

    Raises:
        InputError: As :func:`check_scene_path`, or if the environment has no horizontal surface.
    """
    asset = imported.asset
    check_scene_path(path, asset_folder, known=asset.units == "metre")
    name = os.path.relpath(asset_folder, path.parent)
    if asset.kind == "object":
        size = (
            float(np.ptp(asset.splats.bounds, axis=0).max()) if asset.mesh is None else float(asset.mesh.extents.max())
        )
        text = _OBJECT_SCENE.format(
            title=asset.name, name=yaml_scalar(asset.name), asset=yaml_scalar(name),
            reach=_metres(1.1 * size), low=_metres(0.1 * size), top=_metres(2.5 * size),
            table=_metres(max(1.2, 8 * size)), target=_metres(0.35 * size), near=_metres(2.8 * size),
            far=_metres(4.2 * size), room=_metres(max(4.0, 16 * size)), walls=_metres(max(7.0, 28 * size)),
            floor=_metres(-max(0.75, 4 * size)),
        )  # fmt: skip
    else:
        if imported.support is None:
            raise InputError(f"{path}: no horizontal surface was found for dropping objects: write the scene by hand")
        width, depth = imported.support.size
        reach = [min(0.35 * edge, 0.3) for edge in (width, depth)]
        text = _ENVIRONMENT_SCENE.format(
            title=asset.name, name=yaml_scalar(asset.name), asset=yaml_scalar(name),
            width=_metres(width), depth=_metres(depth), x=_metres(reach[0]),
            y=_metres(reach[1]), near=_metres(1.8 * max(reach)), far=_metres(2.8 * max(reach)),
            proxy=", proxy: true" if asset.mesh is None else "",
        )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, text)


def _metres(length: float) -> str:
    return f"{length:.3g}"


_OBJECT_SCENE = """\
# {title} on a table, under the light of a room. `mitsplat render` makes images of it.
name: {name}

shapes:
  - name: table
    box: {{size: [{table}, {table}, 0.05], position: [0, 0, -0.025]}}
    visible: true
    materials: [{{kind: wood}}, {{kind: noise, saturation: [0, 0.3]}}]
backdrop: {{size: [{walls}, {walls}, {walls}], position: [0, 0, {floor}]}}

objects:
  - {{asset: {asset}, count: [1, 2]}}
region: {{min: [-{reach}, -{reach}, {low}], max: [{reach}, {reach}, {top}]}}
enclosure: {{}}
settle: {{arrangement: upright}}  # as it stands; `drop` lets it tumble

camera:
  kind: hemisphere
  target: [0, 0, {target}]
  radius: [{near}, {far}]
  elevation: [18, 60]
  intrinsics: {{fov_x: 50}}
lights:
  - {{kind: room, size: {room}}}
composite: {{white_balance: auto}}
randomise: {{exposure: [-0.3, 0.3], iso: [100, 400]}}
output: {{width: 960, height: 540, layouts: 4, views: 3, image: jpg}}
"""

_ENVIRONMENT_SCENE = """\
# Solids of random materials dropped on {title}. Put assets of your own in their place.
name: {name}
environment: {asset}

shapes:
  # The horizontal surface that was found in it; the splats show it, and this carries what falls there.
  - {{name: table, box: {{size: [{width}, {depth}, 0.05], position: [0, 0, -0.025]}}{proxy}}}

objects:
  - {{pool: primitives, count: [2, 5]}}
region: {{min: [-{x}, -{y}, 0.04], max: [{x}, {y}, 0.25]}}
enclosure: {{}}

camera:
  kind: hemisphere
  target: [0, 0, 0.02]
  radius: [{near}, {far}]
  elevation: [30, 60]
  intrinsics: {{fov_x: 50}}
lights:
  - {{kind: area, position: [0.5, -0.4, 1.6], target: [0, 0, 0], size: [0.6, 0.6], radiance: 10}}
  - {{kind: environment, radiance: 0.4}}
composite: {{exposure: fixed}}  # that of the splats
output: {{width: 960, height: 540, layouts: 4, views: 3, image: jpg}}
"""
