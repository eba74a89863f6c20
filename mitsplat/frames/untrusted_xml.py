"""What a Mitsuba scene file may say before Mitsuba sees it: no entities, and no file outside of its folder."""

from __future__ import annotations

import re
from pathlib import Path
from xml.parsers import expat

from mitsplat.asset import ASSET_FILE
from mitsplat.errors import InputError
from mitsplat.files import is_inside

MAX_BYTES = 64 << 20
MAX_DEPTH = 64
MAX_INCLUDES = 100

_TEXTS = ("string", "default", "spectrum", "alias")
_PARAMETER = re.compile(r"\$\w+")


def check_xml(path: Path, *, allow_outside: bool = False) -> None:
    """Refuse a scene that would make Mitsuba read beyond its folder, or that is built to exhaust a parser.

    Document types are refused, and with them all entities, which no scene needs. Every text of the file is looked at,
    not only those that Mitsuba's own plugins take for a file name.

    Args:
        path: The ``.xml`` file; what it includes is checked too.
        allow_outside: Whether files anywhere may be named.

    Raises:
        InputError: With file, line, rule and value.
    """
    folder = None if allow_outside else path.parent
    waiting, seen = [path], set[Path]()
    while waiting:
        file = waiting.pop()
        if file.resolve() in seen:
            continue
        seen.add(file.resolve())
        if len(seen) > MAX_INCLUDES:
            raise InputError(f"{path}: must not include more than {MAX_INCLUDES} files")
        waiting += _check_file(file, path.parent, folder)


def _check_file(path: Path, base: Path, folder: Path | None) -> list[Path]:
    """Check one file against ``folder``, None for no bounds; the files it includes."""
    try:
        if path.stat().st_size > MAX_BYTES or not path.is_file():
            raise InputError(
                f"{path}: must be a file of at most {MAX_BYTES >> 20} MiB (got {path.stat().st_size} bytes)"
            )
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    parser = expat.ParserCreate()
    depth, included = 0, list[Path]()

    def refuse(rule: str) -> InputError:
        return InputError(f"{path}:{parser.CurrentLineNumber}: {rule}")

    def doctype(name: str, *_: object) -> None:
        raise refuse(f"must not have a document type (got {name})")

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise refuse(f"must not nest deeper than {MAX_DEPTH} elements")
        if name == "include" and "$" not in attributes.get("filename", ""):
            included.append(base / attributes.get("filename", ""))
        if folder is not None:
            for key, value in attributes.items():
                if rule := _offence(folder, name, key, value):
                    raise refuse(f"{rule} (got {value}); --allow-outside lifts this")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    parser.StartDoctypeDeclHandler, parser.StartElementHandler, parser.EndElementHandler = doctype, start, end
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise InputError(f"{path}:{error.lineno}: not XML ({expat.errors.messages[error.code]})") from error
    return included


def _offence(folder: Path, element: str, key: str, value: str) -> str:
    """The rule that an attribute breaks, or nothing."""
    named = key == "filename" or (element == "path" and key == "value")
    if named and "$" in value:
        return f"{element} must not be a parameter"
    if element in _TEXTS and "$" in value and not _PARAMETER.fullmatch(value.strip()):
        # What a default holds is looked at where it is set, but not what becomes of several.
        return "text must not be put together from parameters"
    if named and not is_inside(folder, value):
        return f"{element} must be inside the scene's folder"
    return "must not name a file outside of the scene's folder" if _names_outside(folder, value) else ""


def _names_outside(folder: Path, text: str) -> bool:
    """Whether a text names a file or an asset, seen from the scene or from here, that is not in the folder."""
    if not text or "\0" in text or len(text) > 4096:
        return False
    try:
        return any(
            ((base / text).is_file() or (base / text / ASSET_FILE).is_file())
            and not is_inside(folder, str(base / text))
            for base in (folder, Path.cwd())
        )
    except OSError:
        return False
