"""Options that several commands share, and their checks."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, TypeVar, get_args, get_type_hints

import typer

from mitsplat.arguments import list_in_words, number_from
from mitsplat.errors import InputError
from mitsplat.quality import PresetName

_Number = TypeVar("_Number", int, float)
SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (.yaml).")]
DatasetFolder = Annotated[Path, typer.Argument(metavar="DATASET", help="Dataset folder.")]
FrameIndex = Annotated[int, typer.Option("--frame", help="Frame index, from 0.")]
FrameSize = Annotated[str | None, typer.Option(metavar="WxH", help="Image size [px], such as 1280x720.")]
SceneSeed = Annotated[int | None, typer.Option(help="Seed of all random numbers; replaces the seed of the scene.")]
AllowOutside = Annotated[
    bool, typer.Option("--allow-outside", help="Allow SCENE to reference files outside its folder.")
]
OverwriteDataset = Annotated[
    bool,
    typer.Option(
        "--overwrite/--resume", help="Replace the dataset in the folder, or continue it and keep its finished images."
    ),
]
Preset = Annotated[PresetName | None, typer.Option(help="Rendering preset; replaces the preset of the scene.")]
DeviceName = Annotated[
    str,
    typer.Option(
        "--device", metavar="NAME", help="Device that renders: cpu, cuda, cuda:1, or auto (a GPU if there is one)."
    ),
]

Name = Annotated[str | None, typer.Option(help="Name of the asset; the folder name by default.")]
ClassName = Annotated[str | None, typer.Option("--class", help="Class label in datasets; the asset name by default.")]
Kind = Annotated[
    Literal["object", "environment"],
    typer.Option(help="object: rigid body that physics moves; environment: static surroundings."),
]
AssetFolder = Annotated[Path, typer.Option("--out", "-o", help="Asset folder to write.")]
ShDegree = Annotated[int, typer.Option(help="Degree of the spherical harmonics, 0 to 3.")]
Metallic = Annotated[
    float | None,
    typer.Option(help="Metalness of the whole object, 0 to 1 (metal); the captured colours become base colours."),
]
Roughness = Annotated[
    float | None,
    typer.Option(help="Roughness of the whole object, 0 (mirror) to 1; the captured colours become base colours."),
]
Faces = Annotated[int, typer.Option(help="Maximum number of mesh faces.")]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.")]
JsonLog = Annotated[
    bool,
    typer.Option("--json", help="Write the progress to stderr as one JSON object per line, instead of a progress bar."),
]


def parse_strictly(command: Callable[..., None]) -> None:
    """Let the number options of a command be parsed by :func:`parse_whole_number` and :func:`parse_number`.

    Typer parses them with pydantic otherwise, which reads 0-31 as -31.
    """
    command.__annotations__ = get_type_hints(command, include_extras=True)
    for hint in command.__annotations__.values():
        for option in getattr(hint, "__metadata__", ()):
            kinds = _scalar_types(get_args(hint)[0]) - {type(None)}
            if kinds == {int}:
                option.parser = parse_whole_number
            elif kinds == {float}:
                option.parser = parse_number


def _scalar_types(hint: object) -> set[object]:
    """Return the types in an annotation of an optional value, a list or a tuple."""
    members = get_args(hint)
    return {kind for member in members for kind in _scalar_types(member)} if members else {hint}


def parse_whole_number(text: str | int) -> int:
    """Return the whole number that a text, or the default of an option, states; raise BadParameter if there is none."""
    is_range = re.fullmatch(r"\d+(-|:|,|\.\.)\d*", str(text))
    return _parse_as(int, str(text), f"a whole number, such as 32{', not a range' if is_range else ''}")


def parse_number(text: str | float) -> float:
    """Return the number that a text, or the default of an option, states; raise BadParameter if there is none."""
    return _parse_as(float, str(text), "a number, such as 0.5")


def _parse_as(kind: type[_Number], text: str, rule: str) -> _Number:
    """Return the number that a text states; raise BadParameter with ``rule`` if there is none."""
    try:
        return number_from(text, kind)
    except ValueError:
        raise typer.BadParameter(f"must be {rule} (got {text})") from None


def parse_pair(text: str) -> tuple[int, int] | None:
    """Return the two numbers of a text such as 1280x720, or None for other text."""
    found = re.fullmatch("([0-9]{1,9})x([0-9]{1,9})", text.lower())
    return None if found is None else (int(found[1]), int(found[2]))


def given_options(context: typer.Context) -> set[str]:
    """Return the long names of the options of a command whose values differ from their defaults."""
    options = (one for one in context.command.params if one.param_type_name == "option")
    return {max(one.opts, key=len) for one in options if context.params.get(one.name or "") != one.default}


def refuse_options(options: set[str], source: str) -> None:
    """Raise InputError if there is an option, because it does not apply to the source."""
    if options:
        raise InputError(f"{min(options)} does not apply to {source}")


def check_ending(out: Path | None, *endings: str) -> None:
    """Raise InputError if the output file has none of the given endings."""
    if out is not None and out.suffix.lower() not in endings:
        raise InputError(f"--out must end in {list_in_words(endings, 'or')} (got {out})")


def check_output_file(out: Path, *endings: str) -> None:
    """Raise InputError if the output file has none of the given endings or its folder does not exist."""
    check_ending(out, *endings)
    if not out.parent.is_dir():
        raise InputError(f"--out must be in an existing folder (got {out})")


def check_new(out: Path, *endings: str, overwrite: bool) -> None:
    """Raise InputError if the output file has none of the given endings, or exists and must not be replaced."""
    check_ending(out, *endings)
    if out.exists() and not (overwrite and out.is_file()):
        raise InputError(f"--out must be a new file (got {out}); --overwrite replaces an existing one")


def uniform_material(metallic: float | None, roughness: float | None) -> dict[str, float] | None:
    """Return the given parameters of a material, or None if there are none.

    Raises:
        InputError: If a value is outside of [0, 1].
    """
    given = {name: value for name, value in (("metallic", metallic), ("roughness", roughness)) if value is not None}
    for name, value in given.items():
        if not 0 <= value <= 1:
            raise InputError(f"--{name} must be from 0 to 1 (got {value:g})")
    return given or None


def scene_overrides(
    *, size: str | None = None, seed: int | None = None, quality: str | None = None, formats: str | None = None
) -> dict[str, object]:
    """Return the given options as a mapping from scene file keys to values."""
    from mitsplat.scene.spec.scene_spec import FORMATS  # most commands do not need it

    if seed is not None and seed < 0:
        raise InputError(f"--seed must be >= 0 (got {seed})")
    overrides: dict[str, object] = {"seed": seed, "quality": quality}
    if size is not None:
        pair = parse_pair(size)
        if pair is None or 0 in pair:
            raise InputError(f"--size must be WIDTHxHEIGHT in pixels, such as 1280x720 (got {size})")
        overrides |= {"output.width": pair[0], "output.height": pair[1]}
    if formats is not None:
        names = [name.strip() for name in formats.split(",")]
        if unknown := [name for name in names if name not in FORMATS]:
            close = difflib.get_close_matches(unknown[0].lower(), FORMATS, n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise InputError(f"--format must be one or more of {', '.join(FORMATS)} (got {unknown[0]}{hint})")
        overrides["output.formats"] = names
    return {key: value for key, value in overrides.items() if value is not None}
