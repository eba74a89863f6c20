"""HTML report of an asset made of photographs: verdict, held-out views, cameras, photos and masks."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import ByteImage, Float32Array, Float64Array
from mitsplat.capture.capture import Capture, Photo
from mitsplat.pages.html import (
    colour_bytes,
    figure_of,
    make_charts,
    make_figure,
    make_section,
    shrunk_image,
    verdict_of,
    write_report_page,
)
from mitsplat.reconstruct.asset_evaluation import HeldOutView, take_evenly
from mitsplat.reconstruct.causes import elevations, views_from
from mitsplat.reconstruct.reconstruct import Reconstruction

PHOTOS = 24
"""Largest number of registered photos in the report, taken at equal intervals."""
HELD_OUT = 8
"""Largest number of held-out views in the report, taken at equal intervals."""

_THUMBNAIL, _VIEW = 240, 420
_POINTS = 1500
_MAX_DIFFERENCE = 0.3
"""Error of a display-encoded channel that is drawn white."""
_PLOT_WIDTH, _PLOT_HEIGHT = 460, 340


def write_asset_report(folder: Path, capture: Capture, result: Reconstruction) -> Path:
    """Write ``report.html`` into an asset's folder.

    Raises:
        InputError: If a photo cannot be read.
        OSError: If the page cannot be written.
    """
    sections = (_verdict(result), *result.sections, _held_out(result.held_out), _cameras(capture), _photos(capture))
    return write_report_page(folder, result.asset.name, "asset", sections)


def _verdict(result: Reconstruction) -> str:
    found = result.verdict
    misses = found.misses()
    unit = "m" if result.asset.units == "metre" else "in unknown units"
    extents = "none" if result.asset.mesh is None else " x ".join(f"{e:.4g}" for e in result.asset.mesh.extents)
    rows: dict[str, str | None] = {
        "Photos with a camera": f"{found.photos} of {found.photos + found.rejected}",
        "Held-out PSNR": figure_of(found.psnr, "{:.2f} dB"),
        "Held-out PSNR of the object": figure_of(found.psnr_object, "{:.2f} dB"),
        "IoU of the splats with held-out masks": figure_of(found.splat_iou, "{:.4f}"),
        "IoU of the mesh with held-out masks": figure_of(found.mesh_iou, "{:.4f}"),
        "Shift between mesh and splats": figure_of(found.offset, "{:.3%} of the diagonal"),
        "Median distance between mesh and splats": figure_of(found.spread, "{:.3%} of the diagonal"),
        "Lost by isolation": figure_of(found.lost, "{:.2%} of the object"),
        "Error of the scale": figure_of(found.scale_error, "{:.2%}"),
        "Extents": f"{extents} {unit}",
        "Gaussians": f"{found.gaussians}",
        "Mesh": f"{found.faces} faces, {'watertight' if found.watertight else 'open'}, "
        f"convex pieces: {len(result.asset.pieces)}",
        "Surface": found.surface,
    }
    if result.isolation is not None:
        removed = result.isolation
        rows["Removed Gaussians"] = (
            f"{removed.outside} outside the masks, {removed.unseen} unseen, {removed.needles} needles, "
            f"{removed.floaters} floaters"
        )
    rows |= found.rows
    return make_section("verdict", "Verdict", verdict_of(misses, "All thresholds are met.", rows))


def _held_out(views: Sequence[HeldOutView]) -> str:
    figures = []
    for view in take_evenly(views, HELD_OUT):
        mask = np.ones(view.alpha.shape, dtype=np.float32) if view.mask is None else view.mask
        difference = np.abs(view.render - view.photo * mask[..., None]) / _MAX_DIFFERENCE
        pictures = {
            "photo": _outlined(colour_bytes(view.photo), view.mask),
            "render": colour_bytes(view.picture),
            "difference": colour_bytes(difference),
            "mesh over photo": colour_bytes(view.shaded(view.photo, 0.85)),
        }
        images = "".join(
            make_figure(f"{kind} {html.escape(view.name, quote=True)}", kind, shrunk_image(picture, _VIEW))
            for kind, picture in pictures.items()
        )
        figures.append(f'<h3>{html.escape(view.name)}</h3><div class="row">{images}</div>')
    note = (
        f"Photos that were not fitted, and the asset from their cameras. Yellow lines outline the masks; "
        f"in difference images, white is an error of {_MAX_DIFFERENCE:g} of the range."
    )
    return make_section("held-out", "Held-out views", f"<p>{note}</p>{''.join(figures) or '<p>none</p>'}")


def _cameras(capture: Capture) -> str:
    """Return drawings of cameras and points from the side and from above."""
    centres = np.array([photo.camera.centre for photo in capture.photos]).reshape(-1, 3)
    if not len(centres):
        return ""
    rng = np.random.default_rng(0)
    subset = rng.choice(len(capture.points), min(_POINTS, len(capture.points)), replace=False)
    points, colours = capture.points[subset], capture.colours[subset]
    middle = np.median(centres, axis=0)
    span = 1.3 * float(np.abs(centres - middle).max()) or 1.0
    near = (np.abs(points - middle) < span).all(axis=1)
    scale = min(_PLOT_WIDTH, _PLOT_HEIGHT) / (2 * span)
    views = {
        "from the side": np.array([[1.0, 0, 0], [0, 0.26, -0.97]]),
        "from above": np.array([[1.0, 0, 0], [0, -1.0, 0]]),
    }
    figures = []
    for caption, axes in views.items():

        def at(positions: Float64Array, axes: Float64Array = axes) -> Float64Array:
            return np.asarray((positions - middle) @ axes.T * scale + (_PLOT_WIDTH / 2, _PLOT_HEIGHT / 2))

        dots = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.2" fill="rgb({r},{g},{b})"/>'
            for (x, y), (r, g, b) in zip(at(points[near]), colours[near], strict=True)
        )
        frusta = "".join(_frustum(photo, at, 0.08 * span) for photo in capture.photos)
        figures.append(
            f'<figure><svg role="img" aria-label="cameras {caption}" viewBox="0 0 {_PLOT_WIDTH} {_PLOT_HEIGHT}">'
            f"{dots}{frusta}</svg><figcaption>{caption}</figcaption></figure>"
        )
    if capture.up == "z":
        figures.append(_directions(capture))
    counts = f"<p>{len(capture.photos)} cameras, {len(capture.points)} points.</p>"
    return make_section("cameras", "Cameras", counts + make_charts(figures))


def _directions(capture: Capture) -> str:
    """Return a polar drawing of the view directions: the zenith in the middle, the horizon as a circle around it."""
    offsets = views_from([photo.camera for photo in capture.photos])
    heights = elevations(offsets)
    middle, reach = (_PLOT_WIDTH / 2, _PLOT_HEIGHT / 2), _PLOT_HEIGHT / 2 - 30
    rings = "".join(
        f'<circle cx="{middle[0]}" cy="{middle[1]}" r="{radius:.1f}" fill="none" stroke="#999"/>'
        f'<text x="{middle[0] + 3}" y="{middle[1] - radius - 2:.1f}" font-size="11">{height}°</text>'
        for height in (0, 20, 45)
        for radius in (reach * (90 - height) / 90,)
    )
    flat = offsets[:, :2] / np.maximum(np.linalg.norm(offsets[:, :2], axis=1, keepdims=True), 1e-12)
    beyond = reach * (90 - np.maximum(heights, -15)) / 90  # the drawing ends 15 degrees below the horizon
    places = np.array(middle) + beyond[:, None] * flat * (1, -1)
    dots = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5"><title>{html.escape(photo.name)}</title></circle>'
        for (x, y), photo in zip(places.tolist(), capture.photos, strict=True)
    )
    return (
        f'<figure><svg role="img" aria-label="directions of the photos" viewBox="0 0 {_PLOT_WIDTH} {_PLOT_HEIGHT}">'
        f'<g fill="currentColor">{rings}{dots}</g></svg>'
        "<figcaption>directions, by height above the object</figcaption></figure>"
    )


def _frustum(photo: Photo, at: Callable[[Float64Array], Float64Array], depth: float) -> str:
    camera = photo.camera
    corners = np.array([(0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height)], dtype=float)
    eye, *base = at(np.concatenate([[camera.centre], camera.unproject(corners, np.full(4, depth))])).tolist()
    rays = "".join(f"M{eye[0]:.1f} {eye[1]:.1f}L{x:.1f} {y:.1f}" for x, y in base)
    ring = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in base) + "Z"
    return f'<path class="camera" d="{rays}{ring}"><title>{html.escape(photo.name)}</title></path>'


def _photos(capture: Capture) -> str:
    shown = take_evenly(capture.photos, PHOTOS)
    figures = []
    for photo in shown:
        _, rgb, mask, _ = photo.fitted(_THUMBNAIL)
        note = "" if photo.mask is not None else ", no mask"
        picture = shrunk_image(_outlined(colour_bytes(rgb), mask), _THUMBNAIL)
        figures.append(make_figure(html.escape(photo.name, quote=True), f"{html.escape(photo.name)}{note}", picture))
    rejected = "".join(
        f"<li><b>{html.escape(name)}</b>: {html.escape(reason)}</li>"
        for name, reason in sorted(capture.rejected.items())
    )
    return make_section(
        "photos",
        "Photos",
        f"<p>{len(shown)} of {len(capture.photos)} registered photos, with the outlines of their masks.</p>"
        f'<div class="thumbnails">{"".join(figures)}</div>'
        f"<h3>Rejected</h3>{f'<ul>{rejected}</ul>' if rejected else '<p>none</p>'}",
    )


def _outlined(picture: ByteImage, mask: Float32Array | None) -> ByteImage:
    if mask is None:
        return picture
    rings, _ = cv2.findContours((mask >= 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(picture.copy(), rings, -1, (255, 220, 0), max(1, round(picture.shape[1] / 400))))
