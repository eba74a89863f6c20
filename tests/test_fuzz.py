"""Damaged files: each is read, or refused in one sentence with its name.

The tests use a few inputs per reader. ``python -m benchmarks.scale.fuzz`` tries as many as time allows, each in a
process of its own.
"""

import random

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from benchmarks.scale.fuzz import READERS, attempt, make_samples, mutate

pytestmark = pytest.mark.usefixtures("files_tried")
SETTINGS = {
    "deadline": None,
    "derandomize": True,
    "phases": (Phase.generate,),
    "suppress_health_check": list(HealthCheck),
}


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    folder = tmp_path_factory.mktemp("samples")
    make_samples(folder)
    return folder


@pytest.mark.parametrize("name", READERS)
def test_undamaged_samples_are_read(samples, name):
    assert attempt(READERS[name], samples) == "read"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused_in_one_sentence(samples, name):
    """Slow readers, which start a process, get one input; the others get 40."""
    reader = READERS[name]
    path = samples / reader.file
    sample = path.read_bytes()

    @settings(max_examples=1 if reader.slow else 40, **SETTINGS)
    @given(st.integers(0, 2**32))
    def check(seed):
        path.write_bytes(mutate(sample, random.Random(seed)))
        found = attempt(reader, samples)
        assert found in ("read", "refused"), f"mutate with seed {seed}: {found}"

    try:
        check()
    finally:
        path.write_bytes(sample)


@pytest.mark.parametrize("name", [name for name, reader in READERS.items() if not reader.slow])
@pytest.mark.parametrize("data", [b"", b"\0", b"\0" * 4096, b"ply\n", b"{" * 1200, b"[" * 1200, b"\xff\xfe" * 50])
def test_arbitrary_bytes_are_refused_in_one_sentence(samples, name, data):
    reader = READERS[name]
    path = samples / reader.file
    sample = path.read_bytes()
    try:
        path.write_bytes(data)
        assert attempt(reader, samples) in ("read", "refused")
    finally:
        path.write_bytes(sample)
