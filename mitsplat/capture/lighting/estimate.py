"""Output of captured light: lines of a scene file, a panorama without the lamps, and a picture for inspection."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from PIL import Image

from mitsplat.arrays import ByteImage, Float32Array, Float64Array
from mitsplat.capture.lighting.brackets import CLIPPED, exposures_of, merge_exposures, read_photograph
from mitsplat.capture.lighting.lamps import Lamp, take_lamps
from mitsplat.capture.lighting.mirror_ball import BallPanorama, Circle, find_ball, unwrap_ball
from mitsplat.capture.lighting.panorama import HDR_SUFFIXES, level_irradiance, read_radiance, resized, write_radiance
from mitsplat.errors import InputError
from mitsplat.images.colour import LUMINANCE, encode_srgb
from mitsplat.storage.files import write_file, write_text

_MAX_WIDTH = 4096
"""Maximum width of written panoramas [px]."""
_MEAN_LEVEL = 110.0
"""Mean level that the displayed photograph of the ball should have."""
_MIN_RADIUS = 20.0
"""Minimum radius of a ball in its photograph [px]; at this radius, 45 degrees around its rear are not visible."""
_OUTLINE = (230, 40, 40)
_TITLE = "# Captured light: "
"""First characters of a file of lights."""


@dataclass(frozen=True)
class BallView:
    """Geometry and exposure of photographs of a mirror ball.

    Attributes:
        azimuth, elevation: Direction from the ball to the camera [degrees].
        ball: Centre and radius of the ball in the image [px]; detected if None.
        fov_x: Horizontal field of view [degrees]; None uses EXIF, and parallel rays if EXIF has none.
        exposures: Exposure time of each photograph [s]; None uses EXIF.
        reflectivity: Reflectance of the ball, linear RGB.
    """

    azimuth: float
    elevation: float
    ball: tuple[float, float, float] | None = None
    fov_x: float | None = None
    exposures: tuple[float, ...] | None = None
    reflectivity: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.azimuth) and -90 < self.elevation < 90):
            raise InputError(
                f"--camera must be an azimuth and an elevation between -90 and 90 "
                f"(got {self.azimuth:g} {self.elevation:g})"
            )
        if self.fov_x is not None and not 0 < self.fov_x < 180:
            raise InputError(f"--fov-x must be between 0 and 180 degrees (got {self.fov_x:g})")
        if not all(0 < channel <= 1 for channel in self.reflectivity):
            raise InputError(f"--reflectivity must be above 0 and at most 1 (got {self.reflectivity})")
        if self.ball is not None and not (np.isfinite(self.ball).all() and self.ball[2] > 0):
            raise InputError(f"--ball must have a radius > 0 (got {self.ball})")


_LARGEST = 1e6
"""Largest distance [m] and irradiance [W/m^2], so that radiance does not exceed the numbers of an image file."""


@dataclass(frozen=True)
class LightSettings:
    """Settings of the conversion of light to lines of a scene file.

    Attributes:
        around: Point in the scene where the light was captured [m]; the lamps face it.
        distance: Distance from that point to the lamps [m]; lamp sizes scale with it.
        lamps: Maximum number of lamps; other bright regions stay in the image.
        rest: Form of the remaining light: an image, or a constant of the same irradiance.
        rotate_z: Rotation of the panorama about the vertical [degrees].
        irradiance: Horizontal irradiance to which all light is scaled [W/m^2]; None keeps the scale.
    """

    around: tuple[float, float, float] = (0.0, 0.0, 0.0)
    distance: float = 1.5
    lamps: int = 6
    rest: Literal["image", "constant"] = "image"
    rotate_z: float = 0.0
    irradiance: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("distance", self.distance), ("irradiance", self.irradiance)):
            if value is not None and not 0 < value <= _LARGEST:
                raise InputError(f"--{name} must be > 0 and at most {_LARGEST:g} (got {value:g})")
        if self.lamps < 0:
            raise InputError(f"--lamps must be >= 0 (got {self.lamps})")
        if not np.isfinite([*self.around, self.rotate_z]).all():
            raise InputError(f"--around and --rotate-z must be finite (got {self.around}, {self.rotate_z:g})")


@dataclass(frozen=True, eq=False)
class LightEstimate:
    """Captured light, divided into lamps and the rest.

    Attributes:
        lamps: Lamps by decreasing irradiance.
        rest: Radiance without the lamps, equirectangular, (H, W, 3).
        panorama: Radiance of all light, (H, W, 3).
        settings: Settings of the estimate.
    """

    lamps: Sequence[Lamp]
    rest: Float32Array
    panorama: Float32Array
    settings: LightSettings

    @property
    def irradiance(self) -> Float64Array:
        """Irradiance of a horizontal plane by all light, linear RGB [W/m^2], shape (3,)."""
        return level_irradiance(self.panorama)

    @property
    def ambient(self) -> Float64Array:
        """Irradiance of a horizontal plane by the light without the lamps, linear RGB [W/m^2], shape (3,)."""
        return level_irradiance(self.rest)

    def share(self, irradiance: Float64Array) -> float:
        """Return the luminance of an irradiance (3,) as a fraction of that of all light."""
        return float(irradiance @ LUMINANCE / (self.irradiance @ LUMINANCE))


def estimate_light(panorama: Float32Array, settings: LightSettings) -> LightEstimate:
    """Divide a panorama of radiance, (H, W, 3), into lamps and the rest; it must have light above the horizon."""
    if panorama.shape[1] > _MAX_WIDTH:
        panorama = resized(panorama, _MAX_WIDTH // 2, _MAX_WIDTH)
    if settings.irradiance is not None:
        panorama = panorama * np.float32(settings.irradiance / (level_irradiance(panorama) @ LUMINANCE))
    lamps, rest = take_lamps(panorama, rotate_z=settings.rotate_z, most=settings.lamps)
    return LightEstimate(lamps, rest, panorama, settings)


@dataclass(frozen=True, eq=False)
class BallReading:
    """Result of the evaluation of a mirror ball.

    Attributes:
        panorama: Panorama that the ball reflects.
        ball: Centre and radius in the photograph [px].
        picture: Photograph with the outline of the ball, (H, W, 3).
        warnings: Reasons why the panorama may be inaccurate, one sentence each.
    """

    panorama: BallPanorama
    ball: Circle
    picture: ByteImage
    warnings: Sequence[str]


def read_ball(paths: Sequence[Path], view: BallView) -> BallReading:
    """Compute the panorama that a mirror ball reflects.

    Args:
        paths: One HDR photograph, or one or more 8-bit photographs that differ only in their exposure.
        view: Geometry and exposure of the photographs.

    Raises:
        InputError: If the photographs cannot be read or merged, or the ball is not found or not completely visible.
    """
    warnings = list[str]()
    hdr = paths[0].suffix.lower() in HDR_SUFFIXES
    if hdr and len(paths) > 1:
        raise InputError(f"{paths[1]}: an HDR photograph must be the only input (got {len(paths)})")
    if hdr and view.exposures is not None:
        raise InputError(f"{paths[0]}: --exposures applies to 8-bit photographs, not to an HDR photograph")
    if hdr:
        image = read_radiance(paths[0])
        pixels, focal = [_tone_mapped(image)], None
    else:
        photographs = [read_photograph(path) for path in paths]
        exposures = exposures_of(photographs, view.exposures)
        pixels, focal = [photograph.pixels for photograph in photographs], photographs[0].focal
    picture = min(pixels, key=lambda levels: abs(float(levels.mean()) - _MEAN_LEVEL))
    height, width = picture.shape[:2]
    ball = _checked_ball(paths[0], find_ball(*pixels) if view.ball is None else view.ball, width, height)
    clipped = np.zeros((height, width), bool)
    if not hdr:
        x, y, radius = ball
        part = tuple(slice(max(0, int(middle - radius) - 1), int(middle + radius) + 2) for middle in (y, x))
        image = np.zeros((height, width, 3), np.float32)
        image[part], clipped[part] = merge_exposures([levels[part] for levels in pixels], exposures)
        if len(paths) < 3:
            warnings.append(
                f"{len(paths)} exposure{'s' * (len(paths) > 1)}: the response of sRGB is assumed; with three "
                "or more, the response of the camera is estimated"
            )
    if view.fov_x is not None:
        focal = 0.5 * width / float(np.tan(np.radians(view.fov_x) / 2))
    if focal is None:
        warnings.append("no focal length in EXIF: parallel camera rays are assumed; give --fov-x")
    image /= np.array(view.reflectivity, dtype=np.float32)
    found = unwrap_ball(image, ball, focal, view.azimuth, view.elevation, clipped)
    if not level_irradiance(found.radiance).any():
        raise InputError(f"{paths[0]}: the ball must reflect light from above the horizon (got none)")
    if found.clipped > 0:
        warnings.append(
            f"{found.clipped:.2%} of the ball is white (from {CLIPPED} of 255) in the shortest exposure: the light of "
            "lamps there is a lower bound"
        )
    return BallReading(found, ball, _draw_circle(picture, ball), warnings)


def _checked_ball(path: Path, ball: Circle | None, width: int, height: int) -> Circle:
    """Return the ball if it is large enough and completely visible in a photograph of ``width`` x ``height`` px."""
    if ball is None:
        raise InputError(f"{path}: no ball was detected: give --ball X Y RADIUS")
    x, y, radius = ball
    if min(x, y, width - x, height - y) < radius:
        raise InputError(
            f"{path}: the ball must be completely visible in the photograph, {width} x {height} px (got radius "
            f"{radius:.0f} around {x:.0f}, {y:.0f})"
        )
    if radius < _MIN_RADIUS:
        raise InputError(f"{path}: the ball's radius must be {_MIN_RADIUS:g} px or more (got {radius:.0f})")
    return ball


def write_light(estimate: LightEstimate, out: Path, photograph: ByteImage | None = None) -> list[Path]:
    """Write the lines of a scene file, the images that they reference, and a picture for inspection.

    Args:
        estimate: Light to write.
        out: Path NAME.yaml. The other files are NAME_panorama.exr with all light, NAME_rest.exr with the light without
            the lamps (if the lines reference it), and NAME.png.
        photograph: Photograph (H, W, 3) to show in the picture beside the panorama.

    Returns:
        The written files.
    """
    picture_file, panorama, rest = _output_files(out)
    files = [out, picture_file, panorama]
    write_radiance(panorama, estimate.panorama)
    if estimate.lamps and estimate.settings.rest == "image":
        files.append(rest)
        write_radiance(rest, estimate.rest)
    shown = _draw_lamps(estimate)
    if photograph is not None:
        width = photograph.shape[1] * len(shown) // len(photograph)
        beside = cv2.resize(photograph, (width, len(shown)), interpolation=cv2.INTER_AREA)
        shown = np.hstack([np.asarray(beside), shown])
    picture = Image.fromarray(shown)
    write_file(picture_file, lambda part: picture.save(part, "PNG"))
    write_text(out, light_lines(estimate, files[-1].name))
    return files


def _output_files(out: Path) -> tuple[Path, Path, Path]:
    """Return the paths of the picture, of the panorama and of the panorama without the lamps."""
    panorama, rest = (out.with_name(f"{out.stem}_{part}.exr") for part in ("panorama", "rest"))
    return out.with_suffix(".png"), panorama, rest


def refuse_to_replace(out: Path, images: Sequence[Path]) -> None:
    """Raise InputError if :func:`write_light` would replace an input or a file that it has not written.

    Raises:
        InputError: With the name of the file.
    """
    written, given = (out, *_output_files(out)), {image.resolve() for image in images}
    if lost := [file for file in written if file.resolve() in given]:
        raise InputError(f"{lost[0]} is an input and would be replaced: give another --out (got {out})")
    there = [file for file in written if file.exists()]
    if there and not (out.is_file() and out.read_bytes().startswith(_TITLE.encode())):
        raise InputError(
            f"{there[0]}: already exists and was not written by `mitsplat lights`: give another --out (got {out})"
        )


def light_lines(estimate: LightEstimate, image: str) -> str:
    """Return the key ``lights`` of a scene file; ``image`` is the file with the light without the lamps."""
    settings = estimate.settings
    lines = [
        f"{_TITLE}{estimate.irradiance @ LUMINANCE:.4g} W/m^2 on a horizontal plane, "
        f"{estimate.share(estimate.ambient):.1%} of it ambient.",
        "lights:",
    ]
    for lamp in estimate.lamps:
        position = np.array(settings.around) + settings.distance * lamp.direction
        width, height = settings.distance * np.array(lamp.extents)
        lines.append(area_line(position, settings.around, (width, height), lamp.radiance))
    if settings.rest == "constant":
        if estimate.ambient.any():
            lines.append(f"  - {{kind: environment, {radiance_keys(estimate.ambient / np.pi)}}}")
    else:
        turn = f", rotate_z: {settings.rotate_z:g}" if settings.rotate_z else ""
        lines.append(f"  - {{kind: environment, image: {json.dumps(image, ensure_ascii=False)}{turn}}}")
    return "\n".join(lines) + "\n"


def area_line(
    position: Float64Array, target: Sequence[float] | Float64Array, size: tuple[float, float], radiance: Float64Array
) -> str:
    """Return the entry of an area light in ``lights``: centre and target [m], width and height [m], and linear RGB."""
    return (
        f"  - {{kind: area, position: {list_of(position)}, target: {list_of(target)}, "
        f"size: {list_of(size)}, {radiance_keys(radiance)}}}"
    )


def radiance_keys(rgb: Float64Array) -> str:
    """Return the keys of a radiance (3,): its luminance, and its colour of luminance 1."""
    luminance = float(rgb @ LUMINANCE)
    return f"radiance: {luminance:.5g}, colour: {list_of(rgb / luminance)}"


def list_of(values: Sequence[float] | Float64Array) -> str:
    """Format numbers as a list of a scene file."""
    return f"[{', '.join(f'{value:.5g}' for value in values)}]"


def _tone_mapped(radiance: Float32Array) -> ByteImage:
    """Convert radiance to a picture whose median luminance is mid-grey."""
    middle = float(np.median(radiance @ LUMINANCE)) or float(radiance.mean())
    return np.asarray(np.rint(255 * np.minimum(encode_srgb(radiance * (0.18 / middle)), 1.0)), dtype=np.uint8)


def _draw_circle(photograph: ByteImage, circle: Circle) -> ByteImage:
    """Return the photograph with a circle drawn on it."""
    x, y, radius = (round(16 * value) for value in circle)
    thick = max(1, photograph.shape[0] // 250)
    return np.asarray(cv2.circle(photograph.copy(), (x - 8, y - 8), radius, _OUTLINE, thick, cv2.LINE_AA, shift=4))


def _draw_lamps(estimate: LightEstimate) -> ByteImage:
    """Return the panorama with outlined and numbered lamps."""
    width = 1024
    shown = np.ascontiguousarray(_tone_mapped(resized(estimate.panorama, width // 2, width)))
    for number, lamp in enumerate(estimate.lamps, start=1):
        mask = cv2.resize(lamp.pixels.astype(np.uint8), (width, width // 2), interpolation=cv2.INTER_NEAREST)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(shown, contours, -1, _OUTLINE, 2)
        x, y, across, _ = cv2.boundingRect(max(contours, key=cv2.contourArea))
        place = (min(x + across + 4, width - 20), max(y + 14, 20))
        cv2.putText(shown, str(number), place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, _OUTLINE, 2, cv2.LINE_AA)
    return shown
