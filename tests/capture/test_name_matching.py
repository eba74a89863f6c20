"""Matching of image names of camera models to photographs."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import pytest

from mitsplat.capture.name_matching import match_names
from mitsplat.errors import InputError


def match(folder: str, names: list[str], photos: list[str]) -> dict[str, str]:
    """Match names to photos of a folder, and check that no photo has two names."""
    paths = {name: PurePosixPath(name) for name in names}
    found = match_names(Path("model"), paths, Path("/data") / folder, photos)
    assert len(set(found.values())) == len(found)
    return found


RIG = [f"{side}/{number}.jpg" for side in ("left", "right") for number in range(3)]
PLAIN = [f"{number}.jpg" for number in range(3)]


@pytest.mark.parametrize(
    ("folder", "names", "photos", "found"),
    [
        ("photos", PLAIN, PLAIN, {name: name for name in PLAIN}),
        ("rig", RIG, RIG, {name: name for name in RIG}),
        ("rig/left", RIG, PLAIN, {f"left/{name}": name for name in PLAIN}),
        ("copy/rig/right", RIG, PLAIN, {f"right/{name}": name for name in PLAIN}),
        ("rig", [f"images/{name}" for name in RIG], RIG, {f"images/{name}": name for name in RIG}),
        ("photos", [f"images/{name}" for name in PLAIN], PLAIN, {f"images/{name}": name for name in PLAIN}),
        ("sorted", ["a.jpg", "b.jpg"], ["one/a.jpg", "two/b.jpg"], {"a.jpg": "one/a.jpg", "b.jpg": "two/b.jpg"}),
        ("nerf", ["train/r_0", "train/r_1"], ["masks/r_0.png", "train/r_0.png", "train/r_1.png", "test/r_0.png"],
         {"train/r_0": "train/r_0.png", "train/r_1": "train/r_1.png"}),
        ("photos", ["a.png"], ["a.jpg"], {"a.png": "a.jpg"}),
        ("photos", ["\u00fc.png"], ["u\u0308.png"], {"\u00fc.png": "u\u0308.png"}),
        ("photos", ["a.png", "a.jpg"], ["a.jpg", "a.png"], {"a.png": "a.png", "a.jpg": "a.jpg"}),
        ("photos", ["frame.0001"], ["frame.0001.png", "frame.0002.png"], {"frame.0001": "frame.0001.png"}),
        ("photos", ["frame.0001"], ["frame.png", "frame.0001.png"], {"frame.0001": "frame.0001.png"}),
        ("photos", ["0.jpg"], ["0.jpg", "thumbnails/0.jpg"], {"0.jpg": "0.jpg"}),
        ("photos", ["other.jpg"], ["a.jpg"], {}),
    ],
)  # fmt: skip
def test_names_match_photos_by_their_last_folders(
    folder: str, names: list[str], photos: list[str], found: dict[str, str]
) -> None:
    assert match(folder, names, photos) == found


def test_a_photo_without_camera_does_not_get_that_of_another_folder() -> None:
    """The model lacks ``right/2.jpg``, and ``left/2.jpg`` was deleted; the other photos show which folders belong."""
    names, photos = [name for name in RIG if name != "right/2.jpg"], [name for name in RIG if name != "left/2.jpg"]
    found = match("rig", names, photos)
    assert "left/2.jpg" not in found and "right/2.jpg" not in found.values()
    assert len(found) == 4


@pytest.mark.parametrize(
    ("folder", "names", "photos", "sentence"),
    [
        ("renamed", RIG, PLAIN, "model: the photo 0.jpg must match one of the names (got left/0.jpg and right/0.jpg"),
        ("cam", [f"{side}/cam/0.jpg" for side in ("a", "b")], ["0.jpg"], "the photo 0.jpg must match one of"),
        ("rig", PLAIN, RIG, "model: the name 0.jpg must match one of the photos (got left/0.jpg and right/0.jpg"),
        ("photos", ["a.tif"], ["a.jpg", "a.png"], "the name a.tif must match one of the photos (got a.jpg and a.png"),
    ],
)
def test_ambiguous_names_are_refused_in_one_sentence(
    folder: str, names: list[str], photos: list[str], sentence: str
) -> None:
    with pytest.raises(InputError) as raised:
        match(folder, names, photos)
    assert sentence in str(raised.value)
    assert "give the photos in the folders that the model names" in str(raised.value)
    assert "\n" not in str(raised.value)
