"""Records of a written dataset, read and changed without the code of mitsplat."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from mitsplat.storage.files import Record


def records_of(root: Path) -> list[Record]:
    """Return the lines of ``manifest.jsonl``."""
    return [json.loads(line) for line in (root / "manifest.jsonl").read_bytes().splitlines()]


def store(root: Path, records: list[Record]) -> None:
    """Write the manifest with the current hashes of the files and valid line checksums."""
    for record in records:
        for file in record["files"]:
            record["files"][file] = hashlib.sha256((root / file).read_bytes()).hexdigest()
    store_lines(root, records)


def store_lines(root: Path, records: list[Record]) -> None:
    """Write the manifest with valid line checksums."""
    lines = []
    for record in records:
        text = json.dumps({key: value for key, value in record.items() if key != "check"}, separators=(",", ":"))
        lines.append(f'{text[:-1]},"check":"{hashlib.sha256(text.encode()).hexdigest()[:16]}"}}\n')
    (root / "manifest.jsonl").write_text("".join(lines))
