"""Images that a scene file names as a file, a folder, a pattern or a list: which ones they are."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mitsplat.errors import InputError
from mitsplat.untrusted_images import IMAGES

WILDCARDS = frozenset("*?[")


def glob_below(folder: Path, pattern: str) -> list[Path]:
    """What a pattern matches, relative to a folder, by name.

    Raises:
        InputError: If it is no pattern.
    """
    try:
        if Path(pattern).is_absolute():
            return sorted(Path("/").glob(pattern.lstrip("/")))
        return sorted(folder.glob(pattern))
    except (ValueError, NotImplementedError) as error:
        raise InputError(f"must be a pattern of files or folders ({error}; got {pattern!r})") from error


def names_below(folder: Path, pattern: str, paths: Iterable[Path]) -> tuple[str, ...]:
    """The names of what a pattern matched, as a scene file in a folder would state them."""
    absolute = Path(pattern).is_absolute()
    return tuple(path.as_posix() if absolute else path.relative_to(folder).as_posix() for path in paths)


def image_names(folder: Path, images: str | tuple[str, ...]) -> tuple[str, ...]:
    """Names of the image files, relative to a folder, in order.

    Raises:
        InputError: If there are none, or one does not exist.
    """
    if isinstance(images, tuple):
        names = images
    elif (folder / images).is_file():
        names = (images,)
    else:
        pattern = f"{images.rstrip('/')}/*" if (folder / images).is_dir() else images
        found = glob_below(folder, pattern) if WILDCARDS & set(pattern) else []
        wanted = [path for path in found if path.suffix.lower() in IMAGES and not path.name.startswith(".")]
        names = names_below(folder, pattern, wanted)
    if not names:
        raise InputError(f"must name at least one image (got {images!r}, where there is none)")
    for name in names:
        if not (folder / name).is_file():
            raise InputError(f"{folder / name}: no such file")
    return names
