"""Warnings of implausible intrinsics: values in another unit, of another image size, or in another order."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mitsplat.findings import Finding
from mitsplat.geometry.lens import likely_cause, undistort
from mitsplat.scene.spec.camera_spec import Intrinsics
from mitsplat.scene.spec.scene_spec import SceneSpec

MAX_ASPECT = 1.03
"""Maximum ratio of the aspect ratios of the calibration and of the images."""
CENTRE = 0.15
"""Maximum distance of the principal point from the middle of the image, in image sizes."""
MAX_OBLONG = 1.2
"""Maximum ratio of ``fx`` and ``fy``."""
FOV = (3.2, 150.0)
"""Range of horizontal fields of view of rectilinear lenses [degrees]. The lower end is more than pi."""
MAX_STRETCH = 2.0
"""Maximum ratio of the distances of a corner from the principal point with and without distortion."""
MIN_SINE = 0.97
"""Minimum ratio of the distance of a ray from the principal point and that of an orthographic fisheye lens."""
MAX_TANGENTIAL = 0.015
"""Maximum magnitude of p1 and p2."""
MAX_APERTURE, MAX_FOCUS = 0.05, 100.0
"""Maximum aperture radius and focus depth [m]."""


def lens_warnings(spec: SceneSpec) -> Iterator[Finding]:
    """Yield a finding for each implausible value of ``camera.intrinsics``, with the likely cause as the remedy."""
    lens, (width, height) = spec.camera.intrinsics, (spec.output.width, spec.output.height)
    full = lens.size or (width, height)
    for text, cause in (
        *_aspect_warnings(lens, (width, height)),
        *_principal_point_warnings(lens, full),
        *_focal_warnings(lens, full),
        *_distortion_warnings(lens, full),
        *_aperture_warnings(lens),
    ):
        yield Finding("lens", False, f"camera.intrinsics: {text}", cause)


def _aspect_warnings(lens: Intrinsics, output: tuple[int, int]) -> Iterator[tuple[str, str]]:
    """Yield a text and the likely cause if the calibrated size has another aspect ratio than the images."""
    if lens.size is None:
        return
    (full_width, full_height), (width, height) = lens.size, output
    squeeze = full_width / full_height * height / width
    if max(squeeze, 1 / squeeze) <= MAX_ASPECT:
        return
    text = f"size: {full_width}x{full_height} px has another aspect ratio than the images, {width}x{height} px, which"
    text += f" are squeezed by {max(squeeze, 1 / squeeze):.3g}"
    swapped = full_height / full_width * height / width
    if max(swapped, 1 / swapped) <= MAX_ASPECT:
        yield text, "are width and height exchanged?"
        return
    if squeeze < 1:
        rows = round(full_width * height / width)
        crop = f"size: [{full_width}, {rows}] and a cy that is smaller by {(full_height - rows) / 2:g}"
    else:
        columns = round(full_height * width / height)
        crop = f"size: [{columns}, {full_height}] and a cx that is smaller by {(full_width - columns) / 2:g}"
    yield text, f"if the camera crops its images, give {crop}; otherwise give output the aspect ratio of size"


def _principal_point_warnings(lens: Intrinsics, full: tuple[int, int]) -> Iterator[tuple[str, str]]:
    """Yield a text and the likely cause if the principal point is far from the middle of the image."""
    (width, height), (cx, cy) = full, lens.principal_point(full)
    if abs(cx / width - 0.5) <= CENTRE and abs(cy / height - 0.5) <= CENTRE:
        return
    outside = not (0 <= cx <= width and 0 <= cy <= height)
    where = "outside of" if outside else "far from the middle of"
    text = f"the principal point cx, cy = {cx:g}, {cy:g} is {where} the image of {width}x{height} px"
    guess = round(2 * cx), round(2 * cy)
    if min(cx, cy) < 0:
        cause = "are cx and cy relative to the middle of the image, or in other axes than x right and y down?"
    elif max(cx, cy) <= 1:
        cause = f"are cx and cy fractions of the image? In pixels they are {cx * width:g} and {cy * height:g}"
    elif abs(cx / height - 0.5) < CENTRE and abs(cy / width - 0.5) < CENTRE and width != height:
        cause = "are width and height, or cx and cy, exchanged?"
    elif min(guess) >= 16:
        scale = guess[0] / width
        times = f", {scale:.3g} times as large" if abs(guess[1] / height / scale - 1) < 2 * CENTRE else ""
        cause = f"are they of an image of about {guess[0]}x{guess[1]} px{times}? Then state size: {list(guess)}"
    else:
        cause = "are cx and cy in millimetres? They must be in pixels"
    yield text, cause


def _focal_warnings(lens: Intrinsics, full: tuple[int, int]) -> Iterator[tuple[str, str]]:
    """Yield a text and the likely cause for each implausible field of view or pixel shape."""
    fx, fy = lens.focal_lengths(full)
    fov = lens.fov_x or float(np.degrees(2 * np.arctan(full[0] / (2 * fx))))
    if fov < FOV[0] and lens.fov_x is not None:
        yield f"fov_x is {fov:g} degrees", f"is it in radians? Then it is {np.degrees(fov):.3g} degrees"
    elif fov < FOV[0]:
        cause = "is fx of a larger image? Then state its size; a pixel is not a micrometre"
        yield f"fx = {fx:g} px is a field of view of {fov:.3g} degrees in an image of {full[0]} px", cause
    if max(fx / fy, fy / fx) > MAX_OBLONG:
        cause = "is one of them of another image size, or is fy a value of cx or cy? Most cameras have square pixels"
        yield f"fx = {fx:g} and fy = {fy:g} differ by a factor of {max(fx / fy, fy / fx):.3g}", cause
    if lens.lens == "opencv" and fov > FOV[1]:
        yield f"the field of view is {fov:.4g} degrees", "does the camera have a fisheye lens? Then state lens: fisheye"


def _distortion_warnings(lens: Intrinsics, full: tuple[int, int]) -> Iterator[tuple[str, str]]:
    """Yield a text and the likely cause if the distortion of the corners or its tangential part is implausible."""
    if lens.is_pinhole:
        return
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * full
    corners = (corners - lens.principal_point(full)) / lens.focal_lengths(full)
    slopes = np.linalg.norm(undistort(corners, lens.distortion, lens.lens), axis=1)
    shown = np.maximum(np.linalg.norm(corners, axis=1), 1e-9)
    # A fisheye is compared with the equidistant lens.
    plain = np.arctan(slopes) if lens.lens == "fisheye" else slopes
    plain = np.maximum(plain, 1e-9)
    stretch = float(np.max(np.maximum(plain / shown, shown / plain)))
    cause = likely_cause(lens.distortion, lens.lens)
    if lens.lens == "fisheye":
        # Real lenses lie between the orthographic (sin) and the rectilinear projection (tan).
        angle = float(np.arctan(slopes.max()))
        ratio = float(shown[int(np.argmax(slopes))]) / np.sin(angle)
        if ratio < MIN_SINE:
            where = f"at {np.degrees(angle):.3g} degrees nearer to the middle, by {1 - ratio:.0%}"
            text = f"distortion places rays {where}, than an orthographic fisheye lens does"
            yield text, "are they coefficients of lens: opencv?"
            return
    if stretch > MAX_STRETCH:
        yield f"distortion moves the corners of the image by a factor of {stretch:.3g}", cause
    elif lens.lens == "opencv" and max(map(abs, lens.distortion[2:4])) > MAX_TANGENTIAL:
        yield f"distortion has large tangential coefficients, {list(lens.distortion[2:4])}", cause


def _aperture_warnings(lens: Intrinsics) -> Iterator[tuple[str, str]]:
    if lens.aperture > MAX_APERTURE:
        yield f"aperture is a radius of {lens.aperture:g} m", "is it in millimetres, or an f-number?"
    if lens.aperture > 0 and lens.focus > MAX_FOCUS:
        yield f"focus is {lens.focus:g} m", "is it in millimetres?"
