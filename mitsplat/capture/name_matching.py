"""Matching of the image names of a model of cameras to photographs, one to one."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from mitsplat.errors import InputError


class _Pair(NamedTuple):
    """Name and photo that may belong together; pairs with a larger score are matched first."""

    score: tuple[int, int, bool]
    name: str
    photo: str


def match_names(
    source: Path, names: Mapping[str, PurePosixPath], folder: Path, photos: Sequence[str]
) -> dict[str, str]:
    """Match the names of a model to photos one to one.

    A name and a photo must have the same file name, or the same stem. Pairs are matched in the order of their common
    folders, from the file upwards: ``left/0.jpg`` of the model is ``left/0.jpg`` of the photos, and not
    ``right/0.jpg``. The folder of the photos counts too.

    Args:
        source: Model, for messages.
        names: Path of each name of the model.
        folder: Folder of the photos.
        photos: Photos relative to the folder, unusable ones included.

    Raises:
        InputError: If several names match one photo equally well, or several photos one name.
    """
    names = {name: PurePosixPath(composed(str(path))) for name, path in names.items()}
    places = {photo: PurePosixPath(composed((folder.resolve() / photo).as_posix())) for photo in photos}
    matched: dict[str, str] = {}
    taken: set[str] = set()
    # Folders that belong together, because more than the file names of some photos agree.
    folders: dict[PurePosixPath, PurePosixPath] = {}
    pairs = list(_candidates(names, places))
    for score in sorted({pair.score for pair in pairs}, reverse=True):
        level = [pair for pair in pairs if pair.score == score and pair.name not in matched and pair.photo not in taken]
        if score[0] == 1:
            known = set(folders.values())
            level = [
                pair for pair in level if _agree(names[pair.name].parent, places[pair.photo].parent, folders, known)
            ]
        _check_ambiguity(source, level)
        for _, name, photo in level:
            matched[name] = photo
            taken.add(photo)
            if score[0] > 1:
                folders[names[name].parent] = places[photo].parent
    return matched


def composed(name: str) -> str:
    """Return a name with composed letters. macOS stores some names with separate accents."""
    return unicodedata.normalize("NFC", name)


def _candidates(names: Mapping[str, PurePosixPath], places: Mapping[str, PurePosixPath]) -> Iterable[_Pair]:
    """Yield all pairs of the same file name or stem.

    The score has the number of common last parts of the paths, the similarity of the file names, and True if the name
    is the whole path of the photo.
    """
    by_key: dict[str, list[str]] = {}
    for photo, place in places.items():
        for key in {place.name, place.stem}:
            by_key.setdefault(key, []).append(photo)
    for name, path in names.items():
        for photo in dict.fromkeys([*by_key.get(path.name, ()), *by_key.get(path.stem, ())]):
            place = places[photo]
            likeness = 2 if path.name == place.name else int(path.name == place.stem)
            common = 1
            for one, other in zip(reversed(path.parent.parts), reversed(place.parent.parts), strict=False):
                if one != other:
                    break
                common += 1
            yield _Pair((common, likeness, path in (place, PurePosixPath(composed(photo)))), name, photo)


def _agree(
    one: PurePosixPath, other: PurePosixPath, folders: Mapping[PurePosixPath, PurePosixPath], known: set[PurePosixPath]
) -> bool:
    """Return True unless a folder of the model or of the photos belongs to another one."""
    return folders[one] == other if one in folders else other not in known


def _check_ambiguity(source: Path, pairs: Sequence[_Pair]) -> None:
    """Raise InputError if a name or a photo is in several pairs."""
    remedy = "give the photos in the folders that the model names, without copies"
    for kind, other, (photos, names) in (("photo", "names", (2, 1)), ("name", "photos", (1, 2))):
        counts = Counter(pair[photos] for pair in pairs)
        if repeated := next((key for key, count in counts.items() if count > 1), None):
            matches = [str(pair[names]) for pair in pairs if pair[photos] == repeated]
            found = " and ".join(matches[:2])
            raise InputError(
                f"{source}: the {kind} {repeated} must match one of the {other} (got {found}, which match "
                f"equally well): {remedy}"
            )
