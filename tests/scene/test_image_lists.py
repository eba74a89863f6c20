"""File patterns: matches equal those of the standard library, in bounded time."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from mitsplat.errors import InputError
from mitsplat.scene.loading import image_lists
from mitsplat.scene.loading.image_lists import glob_below, image_names

PATTERNS = [
    *("*", "a/*", "**", "**/*", "*/b", "a/**", "a/**/*.png", "**/b/*", "**/**/c.png", "?/[bc]*", "./a/*", "a//b/*"),
    *("**/a/**/b/**", "../*/a", "a/b/c.png", "no", "*/", "**/link/*", "a/*/c.png", ".*", "[", "*.[!j]*", "**/../*"),
]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Create nested folders with links to parents and a broken link."""
    for folder in ("a/b/a/b", "b/c", ".hidden/a"):
        (tmp_path / "in" / folder).mkdir(parents=True)
        (tmp_path / "in" / folder / "c.png").write_text("")
    (tmp_path / "in/a/link").symlink_to("../b")
    (tmp_path / "in/a/up").symlink_to("..")
    (tmp_path / "in/broken").symlink_to("nowhere")
    (tmp_path / "in/[").write_text("")
    return tmp_path / "in"


@pytest.mark.parametrize("pattern", PATTERNS)
def test_matches_equal_those_of_pathlib_in_order(tree: Path, pattern: str) -> None:
    assert glob_below(tree, pattern) == sorted(tree.glob(pattern))
    assert glob_below(Path(), f"{tree}/{pattern}") == sorted(Path("/").glob(f"{tree}/{pattern}"[1:]))


@pytest.mark.parametrize("pattern", ["**/" * 9 + "no", "**/*/" * 9 + "no", "*a" * 20 + "*b"])
def test_repeated_wildcards_take_linear_time(tmp_path: Path, pattern: str) -> None:
    """The time of pathlib is exponential in the depth."""
    (tmp_path / "/".join("a" * 30)).mkdir(parents=True)
    for number in range(300):
        (tmp_path / f"{number}{'a' * 200}").write_text("")
    begun = time.process_time()
    assert glob_below(tmp_path, pattern) == []
    assert time.process_time() - begun < 2


@pytest.mark.parametrize("images", [".", "*", "*.png"])
def test_an_image_whose_name_is_not_utf_8_is_refused(tmp_path: Path, images: str) -> None:
    (tmp_path / "a.png").write_text("")
    assert image_names(tmp_path, images) == ("a.png",)
    (tmp_path / os.fsdecode(b"caf\xe9.png")).write_text("")
    with pytest.raises(InputError, match=r"must be UTF-8 \(got b'.*caf\\xe9\.png'\)$"):
        image_names(tmp_path, images)


def test_links_that_multiply_paths_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image_lists, "MAX_ENTRIES", 5000)
    for number in range(3):
        (tmp_path / str(number)).symlink_to(".")
    with pytest.raises(InputError, match=r"must visit at most 5000 files and folders \(got '\*/\*"):
        glob_below(tmp_path, "/".join("*" * 30))


@pytest.mark.parametrize("pattern", ["", "a**", "a/**b/c", "/".join("*" * 65), "a\0b"])
def test_invalid_patterns_are_refused(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(InputError, match="must be a pattern of files or folders"):
        glob_below(tmp_path, pattern)


@pytest.mark.parametrize("pattern", ["[" * 100_000, "*/" * 1_000_000, "*a" * 5_000])
def test_a_long_pattern_is_refused_at_once(tmp_path: Path, pattern: str) -> None:
    begun = time.process_time()
    with pytest.raises(InputError, match=rf"of at most 4096 characters \(got {len(pattern)}\)$"):
        glob_below(tmp_path, pattern)
    assert time.process_time() - begun < 1
