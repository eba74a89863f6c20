"""Help texts of every command and option."""

from __future__ import annotations

import pytest
import typer
import typer.core
import typer.main

from mitsplat.cli import COMMAND_GROUPS, app
from tests.cli.typed import run


def test_every_command_and_option_has_a_help_text() -> None:
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    for name, command in group.commands.items():
        assert command.get_short_help_str(80).endswith("."), name
        unexplained = [param.name for param in command.params if not getattr(param, "help", None)]
        assert unexplained == [], name


def test_version_prints_the_version_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    from importlib.metadata import version

    assert run("--version") == 0
    assert capsys.readouterr().out == f"mitsplat {version('mitsplat')}\n"


def test_help_lists_every_command_once_under_a_heading(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    sections = capsys.readouterr().out.split("\n\n")[3:]
    assert [section.splitlines()[0].rstrip(":") for section in sections] == list(COMMAND_GROUPS)
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    rows = [row for section in sections for row in section.splitlines()[1:]]
    listed = [row.split()[0] for row in rows if row.startswith("  ") and not row.startswith("   ")]
    assert sorted(listed) == sorted(group.commands)
