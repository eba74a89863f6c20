"""Parts of a dataset that are rendered separately, and their file ``shard.json``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from mitsplat.dataset.dataset_files import SHARD
from mitsplat.errors import InputError
from mitsplat.storage.files import read_json


@dataclass(frozen=True)
class Shard:
    """One of several separately rendered parts of a dataset.

    Attributes:
        number: Number of the shard, starting at 1.
        count: Number of all shards.

    Raises:
        InputError: If ``number`` is not in 1 to ``count``.
    """

    number: int
    count: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.count:
            raise InputError(f"a shard must be I/N with I from 1 to N (got {self.number}/{self.count})")

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse a shard from a text such as ``2/8``."""
        found = re.fullmatch("([0-9]{1,9})/([0-9]{1,9})", text)
        if found is None:
            raise InputError(f"a shard must be I/N, such as 2/8 (got {text})")
        return cls(int(found[1]), int(found[2]))

    def frames(self, total: int, views: int) -> range:
        """Return the contiguous range of frames of this shard.

        The range contains whole layouts of ``views`` frames if there are at least as many layouts as shards.

        Args:
            total: Number of frames of the whole dataset.
            views: Number of frames per layout.

        Raises:
            InputError: If there are fewer frames than shards.
        """
        if self.count > total:
            raise InputError(f"there must not be more shards than frames, {total} (got {self.count})")
        layouts = -(-total // views)
        unit, units = (views, layouts) if layouts >= self.count else (1, total)
        first, last = (unit * (units * part // self.count) for part in (self.number - 1, self.number))
        return range(first, min(last, total))

    def to_json(self, total: int) -> dict[str, int]:
        """Return the content of ``shard.json`` for this shard of a dataset of ``total`` frames."""
        return {"shard": self.number, "of": self.count, "frames": total}


class _StoredShard(BaseModel):
    """Content of ``shard.json``."""

    model_config = ConfigDict(strict=True)

    shard: int
    of: int
    frames: int


def read_shard(out: Path) -> dict[str, int] | None:
    """Read ``shard.json``; return None for a whole dataset.

    Raises:
        InputError: If the file is damaged.
    """
    path = out / SHARD
    try:
        stored = _StoredShard.model_validate(read_json(path))
        Shard(stored.shard, stored.of).frames(stored.frames, 1)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: must state the shard, the number of shards and the number "
            f"of frames ({' '.join(str(error).split())})"
        ) from error
    return stored.model_dump()


def describe_shard(part: dict[str, int] | None) -> str:
    """Return the content of ``shard.json`` in words."""
    return f"shard {part['shard']}/{part['of']} of {part['frames']} images" if part else "a whole dataset"
