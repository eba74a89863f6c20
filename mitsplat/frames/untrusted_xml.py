"""Sanitiser for untrusted Mitsuba scenes: a scene is rewritten so that Mitsuba itself resolves no file names.

The new texts have no document types, no parameters and no search folders. They name files by checked absolute paths.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from mitsplat.asset import ASSET_FILE
from mitsplat.errors import InputError
from mitsplat.storage.files import is_inside

MAX_BYTES = 64 << 20
"""Maximum total size of a scene's files, and of the rewritten texts."""
MAX_DEPTH = 64
MAX_INCLUDES = 100
MAX_TEXT = 1 << 20
"""Maximum characters of an attribute after parameters are substituted."""

_MAX_LEVELS = 15  # of includes: Mitsuba's own limit
_FILE_PROPERTIES = ("filename", "asset", "materials", "proxy")
"""Names of string properties in which plugins of Mitsuba and of mitsplat expect files."""
_RESOLVED = {"default": (("name", "value"), ()), "path": (("value",), ()), "include": (("filename",), ("name",))}
"""Elements that this module resolves, with their required and their optional attributes."""
_INSIDE_RULE = "must not name a file outside of the scene's folder"
_PLUGIN = re.compile(r"[\w-]*", re.ASCII)
_UNDEFINED = re.compile(r"(?<!\\)\$(\w*)", re.ASCII)


class CheckedXml(NamedTuple):
    """Rewritten Mitsuba scene.

    Attributes:
        names: Path of the scene and of every included file, one entry per inclusion.
        texts: Text of each, with elements on their original lines. They include each other as ``1.xml`` and so on.
    """

    names: tuple[Path, ...]
    texts: tuple[str, ...]

    def write(self, folder: Path) -> dict[Path, Path]:
        """Write the texts into an empty folder, the scene as ``0.xml``.

        Returns:
            Original path of each new file.
        """
        names = {folder / f"{number}.xml": name for number, name in enumerate(self.names)}
        for file, text in zip(names, self.texts, strict=True):
            file.write_text(text, encoding="utf-8")
        return names


def check_xml(path: Path, *, allow_outside: bool = False) -> CheckedXml:
    """Rewrite a scene; refuse one that names files outside of its folder or is built to exhaust a parser.

    Document types are refused, and therefore all entities; scenes do not need them. Every attribute value is checked,
    not only the values that plugins use as file names.

    Names are looked up in the folders of ``<path>`` elements (the last one first), in the scene's folder and in the
    current folder. For an included file or a spectrum, only the preceding ``<path>`` elements count; the folder of the
    including file is searched first.

    Args:
        path: The ``.xml`` file; included files are read too.
        allow_outside: Accept files outside of the scene's folder.

    Raises:
        InputError: With file, line, rule and value.
    """
    reader = _Reader(path, allow_outside=allow_outside)
    folders = [path.parent, Path()]
    reader.read(path, folders, 0)
    return CheckedXml(tuple(reader.names), tuple(reader.text(pieces, folders) for pieces in reader.pieces))


class _FileName(NamedTuple):
    """File name that is looked up after all folders of the scene are known; its place is a file and a line."""

    name: str
    place: str


class _Reader:
    """Reader of a scene with its includes in document order, because parameters take effect from their definition on.

    Args:
        scene: The ``.xml`` file.
        allow_outside: Accept files outside of the scene's folder.

    Attributes:
        parameters: Values of the parameters that are defined so far.
        names: Files whose reading has started.
        pieces: New text of each file.
    """

    def __init__(self, scene: Path, *, allow_outside: bool) -> None:
        self._scene = scene
        self._bounds = None if allow_outside else scene.parent
        self.parameters: dict[str, str] = {}
        self._read_budget = self._write_budget = MAX_BYTES
        self.names: list[Path] = []
        self.pieces: list[list[str | _FileName]] = []

    def text(self, pieces: Sequence[str | _FileName], folders: Sequence[Path]) -> str:
        """Join text pieces and resolve file names in the given folders."""
        return "".join(
            piece if isinstance(piece, str) else _quoted(str(self.find(piece.name, folders, piece.place, "string")))
            for piece in pieces
        )

    def read(self, path: Path, folders: list[Path], level: int) -> int:
        """Read a file.

        Args:
            path: The file; already checked to be inside.
            folders: Search folders; the file's ``<path>`` elements extend the list.
            level: Inclusion depth of the file, 0 for the scene.

        Returns:
            Number of the file.
        """
        data = self._read_bytes(path)
        number = len(self.names)
        self.names.append(path)
        self.pieces.append([])
        _FileReader(self, path, folders, level, self.pieces[number]).parse(data)
        return number

    def spend(self, size: int, place: str) -> None:
        """Count characters of the new text.

        Raises:
            InputError: If the scene becomes too large.
        """
        self._write_budget -= size
        if self._write_budget < 0:
            rule = f"the scene must not be larger than {MAX_BYTES >> 20} MiB with its parameters replaced"
            raise InputError(f"{place}: {rule}")

    def _read_bytes(self, path: Path) -> bytes:
        """Read a file within the budget of the scene."""
        if len(self.names) > MAX_INCLUDES:
            raise InputError(f"{self._scene}: must not include more than {MAX_INCLUDES} files")
        try:
            size = path.stat().st_size
            if size > self._read_budget or not path.is_file():
                raise InputError(
                    f"{path}: must be a file of at most {MAX_BYTES >> 20} MiB, with all that are included before "
                    f"(got {size} bytes)"
                )
            with path.open("rb") as file:
                data = file.read(size)
        except FileNotFoundError:
            raise InputError(f"{path}: no such file") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from error
        self._read_budget -= len(data)
        return data

    def substitute(self, text: str, place: str) -> str:
        """Substitute parameters, the longest name first, and unescape dollar signs."""
        if "$" not in text:
            return text
        for name in sorted(self.parameters, key=len, reverse=True):
            value = self.parameters[name]
            if len(text) + text.count(f"${name}") * len(value) > MAX_TEXT:
                raise InputError(
                    f"{place}: text must not be longer than {MAX_TEXT} characters with parameters replaced"
                )
            text = re.sub(rf"(?<!\\)\${re.escape(name)}", value.replace("\\", r"\\"), text)
        if undefined := _UNDEFINED.search(text):
            raise InputError(f"{place}: undefined parameter: ${undefined[1]}")
        return text.replace("\\$", "$")

    def value(
        self, element: str, key: str, value: str, values: Mapping[str, str], folders: Sequence[Path], place: str
    ) -> str | _FileName:
        """Return the quoted form of an attribute's value."""
        if element == "spectrum" and key == "filename":
            return _quoted(str(self.find(value, folders, place, element)))
        if element == "string" and key == "value" and value and values.get("name") in _FILE_PROPERTIES:
            return _FileName(value, place)
        if key == "type" and not _PLUGIN.fullmatch(value):
            raise InputError(f"{place}: type must be the name of a plugin (got {value})")
        if self._bounds is not None and element != "include" and _names_outside(self._bounds, value):
            raise InputError(f"{place}: {_INSIDE_RULE} (got {value}); --allow-outside lifts this")
        return _quoted(value)

    def find(self, name: str, folders: Sequence[Path], place: str, element: str) -> Path:
        """Resolve a name to an absolute path without links.

        A name that no search folder contains is resolved in the scene's folder.
        """
        found = next((path for folder in folders if _exists(path := folder / name)), self._scene.parent / name)
        if self._bounds is not None and not is_inside(self._bounds, os.path.realpath(found)):
            rule = _INSIDE_RULE if element == "string" else f"{element} must be inside the scene's folder"
            raise InputError(f"{place}: {rule} (got {name}); --allow-outside lifts this")
        path = Path(os.path.realpath(found))
        if path.suffix != found.suffix:  # readers choose a format by suffix
            path = Path(os.path.realpath(found.parent), found.name)
        if _exists(path) and not (path.is_file() or path.is_dir()):
            raise InputError(f"{place}: {element} must name a file or a folder (got {name})")
        try:
            str(path).encode()
        except UnicodeEncodeError:
            raise InputError(f"{place}: {element} must have a path in UTF-8 (got {os.fsencode(path)!r})") from None
        return path


class _FileReader:
    """Reader of one file of a scene.

    Args:
        reader: Reader of the scene.
        path: The file.
        folders: Search folders; the file's ``<path>`` elements extend the list.
        level: Inclusion depth of the file.
        pieces: New text of the file, which is extended.
    """

    def __init__(
        self, reader: _Reader, path: Path, folders: list[Path], level: int, pieces: list[str | _FileName]
    ) -> None:
        self._reader, self._path, self._folders, self._level, self._pieces = reader, path, folders, level, pieces
        self._parents: list[str] = []
        self._line = 1
        self._parser = expat.ParserCreate()
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._parser.StartElementHandler, self._parser.EndElementHandler = self._start, self._end

    def parse(self, data: bytes) -> None:
        """Rewrite the content of the file.

        Raises:
            InputError: With file, line, rule and value.
        """
        try:
            self._parser.Parse(data, True)
        except expat.ExpatError as error:
            rule = f"not XML ({expat.errors.messages[error.code]})"
            raise InputError(f"{self._path}:{error.lineno}: {rule}") from error

    @property
    def _place(self) -> str:
        return f"{self._path}:{self._parser.CurrentLineNumber}"

    def _refuse_doctype(self, name: str, *_: object) -> None:
        raise InputError(f"{self._place}: must not have a document type (got {name})")

    def _write(self, piece: str | _FileName) -> None:
        self._reader.spend(len(piece if isinstance(piece, str) else piece.name), self._place)
        self._pieces.append(piece)

    def _start(self, name: str, given: dict[str, str]) -> None:
        """Handle the start of an element."""
        place, parents = self._place, self._parents
        if len(parents) == MAX_DEPTH:
            raise InputError(f"{place}: must not nest deeper than {MAX_DEPTH} elements")
        if not parents and (name in _RESOLVED or (self._level == 0 and name != "scene")):
            raise InputError(f"{place}: must begin with <scene> (got <{name}>)")
        if parents and parents[-1] in _RESOLVED:
            raise InputError(f"{place}: <{parents[-1]}> must hold no elements (got <{name}>)")
        parents.append(name)
        values = {key: self._reader.substitute(value, place) for key, value in given.items()}
        if name in _RESOLVED:
            _check_attributes(name, values, place)
        if name == "default":
            self._reader.parameters.setdefault(values["name"], values["value"])
        elif name == "path":
            self._add_folder(values["value"])
        else:
            if name == "include":
                values["filename"] = f"{self._include(values['filename'])}.xml"
            self._write("\n" * (self._parser.CurrentLineNumber - self._line) + f"<{name}")
            self._line = self._parser.CurrentLineNumber
            for key, value in values.items():
                self._write(f" {key}=")
                self._write(self._reader.value(name, key, value, values, self._folders, place))
            self._write(">")

    def _add_folder(self, name: str) -> None:
        """Add the folder of a ``<path>`` element to the search folders."""
        if len(self._parents) != 2:
            raise InputError(f"{self._place}: path must be directly in the first element")
        found = self._reader.find(name, [self._path.parent, *self._folders], self._place, "path")
        if not found.is_dir():
            raise InputError(f"{self._place}: path: no such folder (got {name})")
        self._folders.insert(0, found)

    def _include(self, name: str) -> int:
        """Read an included file, and return its number."""
        folders = [self._path.parent, *self._folders]
        found = self._reader.find(name, folders, self._place, "include")
        if not found.is_file():
            raise InputError(f"{self._place}: include: no such file (got {name})")
        if self._level + 1 == _MAX_LEVELS:
            raise InputError(f"{self._place}: must not include files on more than {_MAX_LEVELS} levels")
        return self._reader.read(found, folders, self._level + 1)

    def _end(self, name: str) -> None:
        if self._parents.pop() not in ("default", "path"):
            self._write(f"</{name}>")


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # not a valid file name
        return False


def _quoted(value: str) -> str:
    return quoteattr(value.replace("$", "\\$"))


def _check_attributes(element: str, values: Mapping[str, str], place: str) -> None:
    """Refuse missing required and unexpected attributes, as Mitsuba does."""
    needed, possible = _RESOLVED[element]
    for key in needed:
        if not values.get(key):
            raise InputError(f'{place}: missing required attribute "{key}" in <{element}>')
    for key in values:
        if key not in (*needed, *possible):
            raise InputError(f'{place}: unexpected attribute "{key}" in element <{element}>')


def _names_outside(folder: Path, text: str) -> bool:
    """Return True if a text names an existing file or asset outside the folder.

    Relative names are tested against the folder and the current folder.
    """
    if ".." in re.split(r"[/\\]", text):
        return True
    if not text or "\0" in text or len(text) > 4096:
        return False
    try:
        return any(
            ((base / text).is_file() or (base / text / ASSET_FILE).is_file())
            and not is_inside(folder, os.path.realpath(base / text))
            for base in (folder, Path.cwd())
        )
    except OSError:
        return False
