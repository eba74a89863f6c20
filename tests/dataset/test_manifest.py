"""Manifest lines with checksums: damage is reported, and an incomplete last line is repaired."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mitsplat.dataset.records.manifest import Manifest, encode_line, parse_line
from mitsplat.errors import InputError

RECORDS = [{"index": index, "files": {"images/a.png": "0" * 8}, "text": 'ä\n"check":1'} for index in range(3)]
LINES = [encode_line(record) for record in RECORDS]


def test_a_line_is_json_and_reads_back():
    for record, line in zip(RECORDS, LINES, strict=True):
        assert parse_line(line) == record
        assert {**record, "check": json.loads(line)["check"]} == json.loads(line)


@given(st.integers(0, len(LINES[0]) - 2), st.integers(1, 255))
def test_every_changed_byte_of_a_line_is_found(place, change):
    line = bytearray(LINES[0])
    line[place] ^= change
    with pytest.raises(ValueError, match=r"checksum"):
        parse_line(bytes(line))


def damaged(path, place):
    data = bytearray(b"".join(LINES))
    data[place] ^= 1
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("number", [1, 2])
def test_a_damaged_line_in_the_middle_is_named_and_kept(tmp_path, number):
    path = damaged(tmp_path / "manifest.jsonl", sum(map(len, LINES[: number - 1])) + 12)
    before = path.read_bytes()
    with pytest.raises(InputError, match=rf"manifest\.jsonl:{number}: must be the record of a frame \(its checksum"):
        Manifest(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("end", [b"\0" * 50, b"\0" * 50 + b"\n", LINES[2][:-1], LINES[2][:9], b'{"index":2}\n'])
def test_an_incomplete_last_line_is_removed(tmp_path, end):
    path = tmp_path / "manifest.jsonl"
    path.write_bytes(LINES[0] + LINES[1] + end)
    manifest = Manifest(path)
    assert list(manifest) == RECORDS[:2]
    manifest.append(RECORDS[2])
    assert path.read_bytes() == b"".join(LINES)
    assert list(Manifest(path)) == RECORDS


@pytest.mark.parametrize("change", [lambda path: path.unlink(), lambda path: path.write_bytes(LINES[0] * 2)])
def test_a_manifest_changed_by_another_process_is_not_written(tmp_path, change):
    path = tmp_path / "manifest.jsonl"
    manifest = Manifest(path)
    manifest.append(RECORDS[0])
    change(path)
    with pytest.raises(InputError, match="must not be changed or removed while it is written"):
        manifest.append(RECORDS[1])
