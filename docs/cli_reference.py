"""Reference of the command line in Markdown: a table of the arguments and options of each command, from its help."""

from __future__ import annotations

import re
from typing import Any

import typer
from scene_reference import markdown_table

from mitsplat.cli import COMMAND_GROUPS, app


def cli_reference() -> str:
    """Return the list of commands, and a section for each group of commands with one for each command."""
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    groups = {
        heading: [function.__name__.rstrip("_") for function in functions]
        for heading, functions in COMMAND_GROUPS.items()
    }
    parts = []
    for heading, names in groups.items():
        rows = [(f"[`mitsplat {name}`](#mitsplat-{name})", commands[name].help.split("\n", 1)[0]) for name in names]
        parts.append(markdown_table((heading.lower(), ""), rows))
    for heading, names in groups.items():
        parts += [f"## {heading}", *(_command(name, commands[name]) for name in names)]
    return "\n\n".join(parts)


def _command(name: str, command: Any) -> str:
    context = typer.Context(command, info_name=f"mitsplat {name}")
    usage, rows = [f"mitsplat {name}"], []
    for param in command.params:
        names, text = param.get_help_record(context)
        text, _, note = text.partition("  [")
        names = re.sub(r"^(\S+) <(?:path|list\[Path\])>$", r"\1", names) if param.opts[0].isalpha() else names
        default = re.sub(r"^default: (.*)\]$", r"`\1`", note).replace("required]", "**required**")
        rows.append((f"`{names}`".replace("|", r"\|"), default, re.sub(r"[<|]", r"\\\g<0>", text)))
        if not param.opts[0].startswith("-"):
            usage.append(param.metavar + " ..." * (param.nargs == -1))
        elif param.required:
            usage.append(f"{min(param.opts, key=len)} {param.name.upper()}")
    if any(param.opts[0].startswith("-") and not param.required for param in command.params):
        usage.append("[OPTIONS]")
    parts = [f"### `mitsplat {name}`", command.help, f"```text\n{' '.join(usage)}\n```"]
    return "\n\n".join([*parts, markdown_table(("argument or option", "default", "meaning"), rows)] if rows else parts)
