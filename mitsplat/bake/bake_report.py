"""HTML page of a baked asset: the mesh beside its splats, figures and warnings."""

from __future__ import annotations

import html
from pathlib import Path

import numpy as np

from mitsplat.bake.bake import BakeResult
from mitsplat.bake.size_checks import describe_size
from mitsplat.bake.verification import BakedView
from mitsplat.geometry.decomposition import max_gap
from mitsplat.geometry.mesh import mass_properties
from mitsplat.geometry.mesh_distance import DistanceSurface, standoff
from mitsplat.geometry.solids import is_closed
from mitsplat.pages.html import figure_of, make_figure, make_section, rgb_image, verdict_of, write_report_page

_VIEW = 420
_WHITE_DIFFERENCE = 0.3
"""Error of a display-encoded channel that is shown as white."""


def write_bake_report(folder: Path, result: BakeResult) -> Path:
    """Write ``report.html`` into an asset's folder.

    Raises:
        OSError: If the page cannot be written.
    """
    return write_report_page(folder, result.asset.name, "bake", [_figures(result), _views(result)])


def _figures(result: BakeResult) -> str:
    asset, warnings = result.asset, list(result.warnings)
    rows: dict[str, str | None] = {
        "Gaussians": f"{len(asset.splats)}",
        "Units": result.units or None,
        "PSNR on unseen views": figure_of(_finite_or_none(result.psnr), "{:.2f} dB"),
        "PSNR of the mesh's pixels": figure_of(_finite_or_none(result.psnr_object), "{:.2f} dB"),
        "Brightness relative to the file's textures": figure_of(result.brightness, "{:.2f}"),
    }
    if asset.mesh is not None:
        rows["Size"] = describe_size(asset.mesh)
        rows["Mesh"] = f"{len(asset.mesh.faces)} faces, {'closed' if is_closed(asset.mesh) else 'open'}"
        if asset.pieces:
            mass = mass_properties(asset.mesh, asset.pieces, density=asset.density, mass=asset.mass)
            rows["Mass"] = f"{mass.mass:.4g} kg at {asset.density:.4g} kg/m^3"
            truth = asset.mesh if result.surface is None else result.surface
            gap, bearable = standoff(DistanceSurface(truth), asset.pieces), max_gap(float(asset.mesh.extents.max()))
            rows["Convex pieces"] = f"{len(asset.pieces)}, at most {1e3 * gap:.2f} mm outside of the mesh"
            if gap > bearable:
                warnings.append(
                    f"convex pieces fill cavities of the mesh by up to {1e3 * gap:.1f} mm, more than the "
                    f"{1e3 * bearable:.1f} mm that layouts allow: layouts with an object resting there are drawn again"
                )
    return make_section("figures", "Figures", verdict_of(warnings, "Nothing to note.", rows))


def _views(result: BakeResult) -> str:
    note = (
        "Views that were not used for the fit: the mesh and its splats, in base colours if they have materials. "
        f"White in the difference is an error of {_WHITE_DIFFERENCE:g} of the range."
    )
    figures = "".join(_view(number + 1, view) for number, view in enumerate(result.views))
    return make_section("views", "Views", f"<p>{note}</p>{figures or '<p>none</p>'}")


def _view(number: int, view: BakedView) -> str:
    pictures = {
        "mesh": view.mesh,
        f"splats, {view.psnr:.1f} dB": view.splats,
        "difference": np.abs(view.splats - view.mesh) / _WHITE_DIFFERENCE,
    }
    images = "".join(
        make_figure(f"view {number}, {html.escape(kind, quote=True)}", kind, rgb_image(picture, _VIEW))
        for kind, picture in pictures.items()
    )
    return f'<div class="row">{images}</div>'


def _finite_or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
