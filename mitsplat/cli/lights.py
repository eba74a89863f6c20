"""The command that makes lights of a scene of what was captured.

Commands import what they need inside of their functions, so that the start of every other one stays short.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mitsplat.cli.options import check_ending
from mitsplat.errors import InputError

if TYPE_CHECKING:
    from mitsplat.capture.lighting import LightEstimate

_MIRROR = (1.0, 1.0, 1.0)
_WHITE = math.pi
"""Irradiance under which white paper has a radiance of 1, which is display white [W/m^2]."""


def lights(
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGES", help="An HDR panorama; or, with --camera, photographs of a mirror ball."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Lines of a scene file to write (.yaml).")],
    camera: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="AZIMUTH ELEVATION",
            help="Where the camera was, seen from the ball, as camera keys of scene files count [degrees].",
        ),
    ] = None,
    ball: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y RADIUS", help="Ball in the photograph [px], which is looked for otherwise."),
    ] = None,
    fov_x: Annotated[
        float | None, typer.Option(help="Horizontal field of view of the photographs [degrees]; else by EXIF.")
    ] = None,
    exposures: Annotated[
        str | None, typer.Option(metavar="T,T,...", help="Exposure times, such as 1/60,1/8,1 [s]; else by EXIF.")
    ] = None,
    reflectivity: Annotated[
        tuple[float, float, float], typer.Option(metavar="R G B", help="Of the ball, above 0 to 1.")
    ] = _MIRROR,
    rotate_z: Annotated[float, typer.Option(help="Turn of the panorama about the vertical [degrees].")] = 0.0,
    around: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="X Y Z", help="Place in the scene where light was captured, which lamps face [m]."),
    ] = (0.0, 0.0, 0.0),
    distance: Annotated[float, typer.Option(help="From there to the lamps, whose sizes grow with it [m].")] = 1.5,
    lamps: Annotated[int, typer.Option(help="Most lamps; 0 leaves all light in the image.")] = 6,
    rest: Annotated[
        Literal["image", "constant"], typer.Option(help="What is no lamp, as an image or as one colour all around.")
    ] = "image",
    irradiance: Annotated[
        float | None,
        typer.Option(
            help="Irradiance of a level table that light is scaled to [W/m^2]; by default that under which white is "
            "white for photographs, which say nothing of it, and as it is for HDR."
        ),
    ] = None,
) -> None:
    """Turn captured light into lights of a scene file.

    Lamps are cut out as area lights, which layouts may vary; what is left is an environment light. A level table gets
    the same light from both together as from the panorama. A picture beside the lines shows what was taken for a lamp.
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
    photograph = None
    if camera is None:
        if len(images) > 1 or images[0].suffix.lower() not in HDR_SUFFIXES:
            raise InputError(
                f"{images[-1]}: without --camera there must be one HDR panorama, {', '.join(HDR_SUFFIXES)}; give "
                "--camera AZIMUTH ELEVATION for photographs of a mirror ball"
            )
        if ball is not None or fov_x is not None or exposures is not None or reflectivity != _MIRROR:
            raise InputError(
                "--ball, --fov-x, --exposures and --reflectivity are of photographs of a mirror ball: give --camera"
            )
    elif rotate_z:
        raise InputError(f"--rotate-z is of panoramas: the ball's is turned by --camera (got {rotate_z:g})")
    elif irradiance is None and images[0].suffix.lower() not in HDR_SUFFIXES:
        irradiance = _WHITE
    settings = LightSettings(around, distance, lamps, rest, rotate_z, irradiance)
    if camera is None:
        panorama = read_panorama(images[0])
    else:
        times = None if exposures is None else _times(exposures)
        view = BallView(*camera, ball=ball, fov_x=fov_x, exposures=times, reflectivity=reflectivity)
        found = read_ball(images, view)
        panorama, photograph = found.panorama.radiance, found.picture
        x, y, radius = found.ball
        typer.echo(
            f"ball: {x:.0f} {y:.0f} {radius:.0f} px; {found.panorama.blind:.0f} degrees around what is behind it "
            "are not seen and have the mean of their surroundings"
        )
        for warning in found.warnings:
            typer.echo(f"warning: {warning}")
    estimate = estimate_light(panorama, settings)
    files = write_light(estimate, out, photograph)
    _tell(estimate)
    typer.echo(f"lights: {', '.join(str(file) for file in files)}")


def _tell(estimate: LightEstimate) -> None:
    """A table of the lamps."""
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


def _times(text: str) -> tuple[float, ...]:
    """Exposure times such as 1/60,0.5,2."""
    times = []
    for part in text.split(","):
        numerator, slash, denominator = part.partition("/")
        try:
            times.append(float(numerator) / (float(denominator) if slash else 1.0))
        except (ValueError, ZeroDivisionError):
            raise InputError(f"--exposures must be times such as 1/60,1/8,1 (got {text})") from None
    return tuple(times)
