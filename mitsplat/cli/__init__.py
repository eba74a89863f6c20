"""The command ``mitsplat``: arguments to calls, and errors in one sentence, never a traceback.

Exit status: 0 done, 1 the doctor or an audit found something wrong, 2 bad input, 3 something is missing on the machine,
4 a result was written that is not whole or misses a threshold, 70 a fault of mitsplat, 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from mitsplat.cli import assets, datasets, detectors, fault, lights, photographs
from mitsplat.errors import InputError, LateDeviceError, exit_status, sentence_of
from mitsplat.runtime.child_process import leave_current_folder, python_command, python_environment
from mitsplat.version import __version__

app = typer.Typer(
    help="Labelled training images of settled objects, from Gaussian splats, physics and traced light.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

for _command in (
    datasets.render,
    datasets.merge,
    datasets.split,
    datasets.chart,
    datasets.audit,
    datasets.report,
    datasets.preview,
    datasets.view,
    datasets.settle,
    datasets.export,
    detectors.train,
    detectors.evaluate,
    detectors.compare,
    assets.bake,
    photographs.fit,
    photographs.capture,
    photographs.board,
    photographs.mesh,
    photographs.asset,
    lights.lights,
    assets.import_,
    datasets.schema,
    datasets.check,
    datasets.doctor,
):
    app.command(_command.__name__.rstrip("_"))(_command)


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line and exit.

    A GPU that another one hides from Dr.Jit is taken by beginning again, with only that one visible.

    Args:
        args: Arguments; those of the process if None.
    """
    if args is None:
        leave_current_folder()
    try:
        _check_text([*(sys.argv[1:] if args is None else args), os.fspath(Path.cwd())])
        app(args)
    except Exception as error:  # noqa: BLE001 - the last one who can tell the user
        if args is None and isinstance(error, LateDeviceError):
            command = python_command(*sys.orig_argv[1:])
            os.execve(command[0], command, python_environment(error.environment))
        status = exit_status(error)
        typer.echo(f"mitsplat: {fault.tell_fault(error) if status is None else sentence_of(error)}", err=True)
        sys.exit(fault.STATUS if status is None else status)


def _check_text(texts: Sequence[str]) -> None:
    """Refuse names that are not UTF-8, which native libraries do not take or end this process by."""
    for text in texts:
        try:
            text.encode()
        except UnicodeEncodeError:
            raise InputError(f"names of files and folders must be UTF-8 (got {os.fsencode(text)!r})") from None


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mitsplat {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass
