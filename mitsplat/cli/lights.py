"""Command that converts captured light to lights of a scene file.

The command imports its dependencies inside its function, so that all other commands start fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mitsplat.cli.options import check_ending, parse_number
from mitsplat.errors import InputError

if TYPE_CHECKING:
    from mitsplat.capture.lighting import BallReading, LightEstimate

_PERFECT_MIRROR = (1.0, 1.0, 1.0)
_WHITE_IRRADIANCE = math.pi
"""Irradiance at which white paper has the radiance 1, that is display white [W/m^2]."""


def lights(
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGES", help="One HDR panorama, or with --camera photographs of a mirror ball."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="File for the lights, in scene file syntax (.yaml).")],
    camera: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="AZIMUTH ELEVATION",
            help="Direction from the ball to the camera, as in the camera keys of scene files [degrees].",
        ),
    ] = None,
    ball: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="X Y RADIUS", help="Centre and radius of the ball in the photograph [px]; detected by default."
        ),
    ] = None,
    fov_x: Annotated[
        float | None,
        typer.Option(help="Horizontal field of view of the photographs [degrees]; read from EXIF by default."),
    ] = None,
    exposures: Annotated[
        str | None,
        typer.Option(metavar="T,T,...", help="Exposure times [s], such as 1/60,1/8,1; read from EXIF by default."),
    ] = None,
    reflectivity: Annotated[
        tuple[float, float, float], typer.Option(metavar="R G B", help="Reflectance of the ball, > 0 to 1.")
    ] = _PERFECT_MIRROR,
    rotate_z: Annotated[float, typer.Option(help="Rotation of the panorama about the vertical [degrees].")] = 0.0,
    around: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="X Y Z", help="Point in the scene where the light was captured [m]; the lamps face it."),
    ] = (0.0, 0.0, 0.0),
    distance: Annotated[
        float, typer.Option(help="Distance from that point to the lamps [m]; lamp sizes scale with it.")
    ] = 1.5,
    lamps: Annotated[
        int, typer.Option(help="Maximum number of lamps; 0 keeps all light in the environment image.")
    ] = 6,
    rest: Annotated[
        Literal["image", "constant"],
        typer.Option(help="Environment light for everything except the lamps: an image, or one constant colour."),
    ] = "image",
    irradiance: Annotated[
        float | None,
        typer.Option(
            help="Irradiance on a level table [W/m^2] to scale all light to. By default HDR light keeps "
            "its scale, and light from photographs is scaled so that white paper appears white."
        ),
    ] = None,
) -> None:
    """Convert a panorama or mirror-ball photos to scene lights.

    Bright regions become area lights, which the scene file can vary per layout. The remaining light becomes an
    environment light. Together they give a level table the same irradiance as the panorama. A picture beside the output
    file shows which regions became lamps.
    """
    from mitsplat.capture.lighting import (
        BallView,
        LightSettings,
        estimate_light,
        read_ball,
        read_panorama,
        refuse_to_replace,
        write_light,
    )
    from mitsplat.capture.lighting.panorama import HDR_SUFFIXES

    check_ending(out, ".yaml", ".yml")
    refuse_to_replace(out, images)
    is_hdr = images[0].suffix.lower() in HDR_SUFFIXES
    of_ball = ball is not None or fov_x is not None or exposures is not None or reflectivity != _PERFECT_MIRROR
    if camera is None:
        _check_panorama(images, of_ball=of_ball)
    elif rotate_z:
        raise InputError(f"--rotate-z applies to panoramas; for a mirror ball, use --camera (got {rotate_z:g})")
    if irradiance is None and not is_hdr:
        irradiance = _WHITE_IRRADIANCE
    settings = LightSettings(around, distance, lamps, rest, rotate_z, irradiance)
    if camera is None:
        panorama, photograph = read_panorama(images[0]), None
    else:
        times = None if exposures is None else _parse_times(exposures)
        found = read_ball(images, BallView(*camera, ball=ball, fov_x=fov_x, exposures=times, reflectivity=reflectivity))
        _print_ball(found)
        panorama, photograph = found.panorama.radiance, found.picture
    estimate = estimate_light(panorama, settings)
    files = write_light(estimate, out, photograph)
    _print_lamps(estimate)
    typer.echo(f"lights: {', '.join(str(file) for file in files)}")


def _check_panorama(images: Sequence[Path], *, of_ball: bool) -> None:
    """Raise InputError if images without ``--camera`` are not one HDR panorama, or if options of a ball are given."""
    from mitsplat.capture.lighting.panorama import HDR_SUFFIXES

    if len(images) > 1 or images[0].suffix.lower() not in HDR_SUFFIXES:
        raise InputError(
            f"{images[-1]}: must be the only input and an HDR panorama, {', '.join(HDR_SUFFIXES)}; for photographs "
            "of a mirror ball, add --camera AZIMUTH ELEVATION"
        )
    if of_ball:
        raise InputError(
            "--ball, --fov-x, --exposures and --reflectivity apply to photographs of a mirror ball: add --camera"
        )


def _print_ball(found: BallReading) -> None:
    """Print the outline of a mirror ball, and warnings about its photographs."""
    x, y, radius = found.ball
    typer.echo(
        f"ball: {x:.0f} {y:.0f} {radius:.0f} px; {found.panorama.blind:.0f} degrees around its rear are not "
        "visible and are filled with the mean of a ring around them"
    )
    for warning in found.warnings:
        typer.echo(f"warning: {warning}")


def _print_lamps(estimate: LightEstimate) -> None:
    """Print a table of the lamps."""
    if estimate.lamps:
        typer.echo("lamp  azimuth  elevation  size            radiance  colour            share of irradiance")
    for number, lamp in enumerate(estimate.lamps, start=1):
        azimuth, elevation = lamp.angles
        width, height = lamp.angular_size
        colour = " ".join(f"{value:.2f}" for value in lamp.colour)
        typer.echo(
            f"{number:4}  {azimuth:6.1f}°  {elevation:8.1f}°  {width:5.1f}° x {height:5.1f}°  {lamp.luminance:8.3g}  "
            f"{colour:16}  {estimate.share(lamp.irradiance):.1%}"
        )
    typer.echo(f"ambient: {estimate.share(estimate.ambient):.1%}")


def _parse_times(text: str) -> tuple[float, ...]:
    """Parse exposure times such as 1/60,0.5,2."""
    times = []
    for part in text.split(","):
        numerator, slash, denominator = part.partition("/")
        try:
            times.append(parse_number(numerator) / (parse_number(denominator) if slash else 1.0))
        except (typer.BadParameter, ZeroDivisionError):
            raise InputError(f"--exposures must be times such as 1/60,1/8,1 (got {text})") from None
    return tuple(times)
