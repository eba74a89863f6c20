"""Command line interface ``mitsplat``: parses arguments, calls the library and reports errors in one sentence.

Exit status:
    0: done.
    1: the doctor, a check or an audit found a problem.
    2: invalid input.
    3: a library, memory or disk space is missing on the machine.
    4: a result was written but is incomplete or misses a threshold.
    70: internal error of mitsplat.
    130: interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from mitsplat.cli import assets, captures, datasets, detectors, exports, fault, inspection, lights, machine, photographs
from mitsplat.cli.interrupt import handle_interrupts
from mitsplat.cli.options import parse_strictly
from mitsplat.errors import InputError, LateDeviceError
from mitsplat.runtime.child_process import leave_current_folder, python_command, python_environment
from mitsplat.storage.file_kinds import check_path_encoding
from mitsplat.version import __version__

COMMAND_GROUPS: Mapping[str, Sequence[Callable[..., None]]] = {
    "Make assets": (
        photographs.asset,
        captures.capture,
        photographs.fit,
        photographs.mesh,
        captures.board,
        assets.bake,
        assets.import_,
        lights.lights,
    ),
    "Make datasets": (datasets.render, datasets.settle, datasets.merge, datasets.split, exports.export),
    "Inspect": (
        inspection.view,
        inspection.preview,
        inspection.check,
        inspection.audit,
        inspection.report,
        inspection.chart,
    ),
    "Train detectors": (detectors.train, detectors.evaluate, detectors.compare),
    "Machine": (machine.doctor, machine.schema),
}
"""Commands by heading of the help page, in the order of a typical workflow."""


class _CommandGroup(TyperGroup):
    """Command group whose help page lists the commands under the headings of ``COMMAND_GROUPS``.

    Typer shows headings only with rich markup, in which texts such as ``[px]`` would be read as styles.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run a command.

        Raises:
            InputError: If an argument is missing or a value is invalid, in place of the three lines of Click.
        """
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            text = error.format_message().replace("Value error, ", "").rstrip(".")
            help_page = "mitsplat --help" if error.ctx is None else f"{error.ctx.command_path} --help"
            raise InputError(f"{text[0].lower()}{text[1:]}; see `{help_page}`") from None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        width = max(len(name) for name in self.commands)
        for heading, functions in COMMAND_GROUPS.items():
            names = [_command_name(function) for function in functions]
            with formatter.section(heading):
                formatter.write_dl(
                    # The padding aligns the second column over all sections.
                    [(name.ljust(width), self.commands[name].get_short_help_str(formatter.width)) for name in names]
                )


def _command_name(function: Callable[..., None]) -> str:
    return function.__name__.rstrip("_")


app = typer.Typer(
    cls=_CommandGroup,
    help="Render labelled training images of objects at rest, from Gaussian splats, physics and ray-traced light.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

for _functions in COMMAND_GROUPS.values():
    for _function in _functions:
        parse_strictly(_function)
        app.command(_command_name(_function))(_function)


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line and exit.

    If another GPU prevents Dr.Jit from using the selected GPU, the process restarts with only that GPU visible.

    Args:
        args: Arguments; those of the process if None.
    """
    if args is None:
        handle_interrupts()
        leave_current_folder()
    try:
        for name in (*(sys.argv[1:] if args is None else args), os.fspath(Path.cwd())):
            check_path_encoding(name)
        app(args)
    except Exception as error:  # noqa: BLE001 - last handler before the traceback would be printed
        if args is None and isinstance(error, LateDeviceError):
            command = python_command(*sys.orig_argv[1:])
            os.execve(command[0], command, python_environment(error.environment))
        status, sentence = fault.outcome_of(error)
        typer.echo(f"mitsplat: {sentence}", err=True)
        sys.exit(status)


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
