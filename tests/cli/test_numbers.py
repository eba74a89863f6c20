"""Numbers among the options of all commands."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
import typer.main

from mitsplat.cli import app
from tests.cli.typed import run

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]  # of a group


def _options(kind: type) -> list[tuple[str, str, int]]:
    """Return command, name and number of values of the options whose values all have a type."""
    return [
        (command, max(param.opts, key=len), param.nargs)
        for command, found in COMMANDS.items()
        for param in found.params
        if param.param_type_name == "option"
        and {kind} == set(get_args(hint := param.type_descriptor.annotation) or (hint,))
    ]


def test_options_of_both_kinds_are_found() -> None:
    assert {("render", "--frames", 1), ("preview", "--frame", 1)} <= set(_options(int))
    assert {("import", "--mass", 1), ("chart", "--order-tolerance", 1), ("lights", "--reflectivity", 3)} <= set(
        _options(float)
    )


@pytest.mark.parametrize(
    ("command", "option", "count", "text", "rule"),
    [(*one, "0-31", "a whole number, such as 32, not a range") for one in _options(int)]
    + [(*one, "1_000", "a number, such as 0.5") for one in _options(float)],
)
def test_every_number_is_read_as_it_is_written(
    command: str, option: str, count: int, text: str, rule: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pydantic, with which Typer parses options, reads 0-31 as -31."""
    assert run(command, option, *[text] * count) == 2
    assert f"': must be {rule} (got {text})" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["00-5", "0_-5", "1_000", "5.0", "٣", "1e2", "0x10", ""])
def test_a_whole_number_consists_of_ascii_digits(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("preview", "--frame", text, "scene.yaml") == 2
    assert f"': must be a whole number, such as 32{', not a range' * (text == '00-5')} (got {text})" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize("text", ["0:31", "0..31", "2-", "0-3", "0,3"])
def test_a_whole_number_is_no_range(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("render", "--frames", text, "scene.yaml") == 2
    assert f"': must be a whole number, such as 32, not a range (got {text})" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["1,5", "٣.5", "0x10", "0-3", "", "half"])
def test_a_number_has_a_decimal_point(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("chart", "--tolerance", text, "scene.yaml") == 2
    assert f"': must be a number, such as 0.5 (got {text})" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["١x٢", "0x10", "1_0x10", "x", "9" * 5000 + "x1"])
def test_a_size_consists_of_ascii_digits(
    text: str, scene_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("preview", scene_path, "-o", tmp_path / "a.png", "--size", text) == 2
    assert "--size must be WIDTHxHEIGHT in pixels, such as 1280x720 (got " in capsys.readouterr().err


@pytest.mark.parametrize("command", ["capture", "asset"])
@pytest.mark.parametrize("text", ["1_000", "٣.5", "0-3", "0x10", "half", ""])
def test_a_known_distance_is_read_as_it_is_written(
    command: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The number is the last member of a tuple with text."""
    assert run(command, tmp_path, "-o", tmp_path / "out", "--scale-from", "a.jpg", "b.jpg:3,4", text) == 2
    assert f"'--scale-from': METRES must be a number, such as 0.5 (got {text})" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("a.stl", "--up", "x"), "invalid value for '--up': 'x' is not one of 'y', 'z'; see `mitsplat bake --help`"),
        ((), "missing argument 'MESH'; see `mitsplat bake --help`"),
    ],
)
def test_invalid_values_are_refused_in_one_line(
    arguments: tuple[str, ...], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("bake", "-o", "out", *arguments) == 2
    line = capsys.readouterr().err
    assert line.startswith("mitsplat: ") and line.count("\n") == 1
    assert sentence.split("; see")[0] in line and "bake --help" in line
