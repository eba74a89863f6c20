"""Commands that describe this machine and the format of scene files.

Each command imports its dependencies inside its function, so that all other commands and ``--help`` start fast.
"""

from __future__ import annotations

import typer

from mitsplat.cli.console import print_findings


def doctor() -> None:
    """Check that this machine meets the requirements.

    The command checks Python, Mitsuba, processor, LLVM, GPU, Warp, memory, disk and cache, and suggests a remedy for
    each problem. The exit status is 1 if there is any problem.
    """
    from mitsplat.checks.doctor import examine

    print_findings(examine(), "FAIL")


def schema() -> None:
    """Print the JSON Schema of scene files, for editors."""
    import json

    from mitsplat.scene.loading.scene_loading import scene_json_schema

    typer.echo(json.dumps(scene_json_schema(), indent=2))
