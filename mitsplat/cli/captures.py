"""Commands that find cameras, scale and masks of photographs, and that print the board for the scale.

Each command imports its dependencies inside its function, so that all other commands start fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mitsplat.cli.console import stage_bar
from mitsplat.cli.options import check_new, given_options, parse_number, parse_pair, refuse_options
from mitsplat.errors import InputError, PartialResultError

if TYPE_CHECKING:
    from mitsplat.capture.boards.targets import Board

Photos = Annotated[
    Path, typer.Argument(metavar="PHOTOS", help="Folder of photographs of one object or place, or a video file.")
]
Frames = Annotated[int, typer.Option(help="Maximum number of frames to take from a video.")]
Poses = Annotated[
    Path | None,
    typer.Option(help="Camera poses from another tool: folder of a COLMAP model, or a NeRF transforms.json."),
]
Masks = Annotated[Path | None, typer.Option(help="Folder of masks, named PHOTO.png; white marks the object.")]
MaskModel = Annotated[
    Path | None, typer.Option(help="Segmentation network (.onnx) that computes the masks through rembg.")
]
ScaleFrom = Annotated[
    tuple[str, str, str] | None,  # parse_distance reads the number: a parser of Typer reads all members of a tuple
    typer.Option(
        "--scale-from",
        metavar="A B METRES",
        help="Known distance between two points. Each of A and B is PHOTO (the centre of its camera) or PHOTO:X,Y (the "
        "surface at this pixel).",
    ),
]
Picks = Annotated[
    list[str] | None,
    typer.Option("--pick", metavar="PHOTO:X,Y", help="Pixel on the object, in CAPTURE/images; repeatable."),
]
PicksNot = Annotated[
    list[str] | None,
    typer.Option(
        "--pick-not", metavar="PHOTO:X,Y", help="Pixel on something that does not belong to the object; repeatable."
    ),
]
Box = Annotated[
    tuple[float, float, float, float, float, float] | None,
    typer.Option(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Box that contains the object, in the frame of the capture."),
]


def capture(
    context: typer.Context,
    photos: Photos,
    out: Annotated[Path, typer.Option("--out", "-o", help="Capture folder to write.")],
    kind: Annotated[
        Literal["object", "environment"],
        typer.Option(help="object: the subject is segmented by masks; environment: whole photos are used."),
    ] = "object",
    frames: Frames = 150,
    max_size: Annotated[int, typer.Option(help="Longest edge of the photos [px]; larger photos are reduced.")] = 1600,
    squares: Annotated[
        str, typer.Option(metavar="CxR", help="Number of squares of the ChArUco board, columns x rows.")
    ] = "7x5",
    square: Annotated[float, typer.Option(help="Edge length of a board square, measured on the print [m].")] = 0.035,
    tag: Annotated[
        float | None, typer.Option(help="Edge length of the black border of printed AprilTags (36h11) [m].")
    ] = None,
    scale_from: ScaleFrom = None,
    poses: Poses = None,
    metric: Annotated[bool, typer.Option("--metric", help="The poses of --poses are in metres with z up.")] = False,
    masks: Masks = None,
    mask_model: MaskModel = None,
    pick: Picks = None,
    pick_not: PicksNot = None,
    box: Box = None,
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Resample the photos to pinhole cameras without lens distortion.")
    ] = False,
) -> None:
    """Find camera poses, scale, gravity and masks of PHOTOS.

    An interrupted run continues when the command runs again. The exit status is 4 if too many photos are unusable.
    """
    from mitsplat.capture.pipeline.capture_pipeline import capture_photos
    from mitsplat.capture.pipeline.capture_settings import CaptureSettings

    refuse_frames(context, photos)
    settings = CaptureSettings(
        kind=kind,
        frames=frames,
        max_size=max_size,
        board=_parse_board(squares, square),
        tag=tag,
        scale_from=parse_distance(scale_from),
        poses=poses,
        metric=metric,
        masks=masks,
        mask_model=mask_model,
        picks=tuple(pick or ()),
        picks_not=tuple(pick_not or ()),
        box=box,
        undistorted=undistort,
    )
    with stage_bar("steps/s") as progress:
        result = capture_photos(photos, out, settings, progress=progress)
    found, video = result.capture, result.video
    if video is not None:
        typer.echo(f"video: {len(video.names)} of {video.read} frames ({video.seconds:.1f} s) in {video.folder}")
    for name, reason in sorted(found.rejected.items()):
        typer.echo(f"rejected: {name}: {reason}")
    for warning in result.warnings:
        typer.echo(f"warning: {warning}")
    points = f"{len(found.points)} points" + (f", {result.reprojection_error:.2f} px" if len(found.points) else "")
    typer.echo(f"capture: {out} ({len(found.photos)} of {result.given} photos, {points})")
    scale = "in metres" if found.units == "metre" else "in unknown units"
    error = "" if found.scale_error is None else f" ± {found.scale_error:.2%}"
    typer.echo(f"frame: {scale}{error}, {'z up' if found.up == 'z' else 'up unknown'}, by {result.source}")
    if result.lenses is not None:
        typer.echo(f"focal lengths: {result.lenses}")
    if result.exposure is not None:
        typer.echo(f"exposure: {result.exposure}")
    typer.echo(f"picture: {out / 'capture.png'}")
    if result.shortcoming is not None:
        raise PartialResultError(f"{out}: {result.shortcoming}")


def refuse_frames(context: typer.Context, photos: Path) -> None:
    """Raise InputError if the option ``--frames`` is given for a folder of photographs."""
    if photos.is_dir():
        refuse_options({"--frames"} & given_options(context), f"photographs ({photos}), which are all used")


def parse_distance(scale_from: tuple[str, str, str] | None) -> tuple[str, str, float] | None:
    """Return the value of ``--scale-from`` with its number.

    Raises:
        BadParameter: If METRES is no number.
    """
    if scale_from is None:
        return None
    try:
        return (scale_from[0], scale_from[1], parse_number(scale_from[2]))
    except typer.BadParameter as error:
        raise typer.BadParameter(f"METRES {error.message}", param_hint="'--scale-from'") from None


def board(
    out: Annotated[Path, typer.Option("--out", "-o", help="PDF file to write (.pdf).")] = Path("board.pdf"),
    paper: Annotated[Literal["a4", "letter", "a3"], typer.Option(help="Paper size, in landscape.")] = "a4",
    squares: Annotated[str, typer.Option(metavar="CxR", help="Number of squares, columns x rows.")] = "7x5",
    square: Annotated[float, typer.Option(help="Edge length of a square [m].")] = 0.035,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Write a printable ChArUco board (PDF).

    Place the object on the board or beside it. `mitsplat capture` then finds the scale in metres and the vertical.
    """
    check_new(out, ".pdf", overwrite=overwrite)
    _parse_board(squares, square).write_pdf(out, paper)
    typer.echo(f"board: {out} (print at 100 %, then measure a square and give it to `mitsplat capture --square`)")


def _parse_board(squares: str, square: float) -> Board:
    from mitsplat.capture.boards.targets import Board

    if (counts := parse_pair(squares)) is None:
        raise InputError(f"--squares must be COLUMNSxROWS, such as 7x5 (got {squares})")
    return Board(*counts, square)
