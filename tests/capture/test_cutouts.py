"""Photographs without background: transparency, plain backgrounds of renderings, and data sets of NeRF."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageFilter

from mitsplat.capture import known_poses as poses
from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.photo_masks import add_masks, check_borders, cutout_masks, given_masks
from mitsplat.capture.photos import Prepared, plain_background, prepare_photos
from mitsplat.capture.pipeline.capture_pipeline import capture_photos
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.capture.structure_from_motion import SparseModel
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera

SIZE = (120, 90)


def mask_of(number: int) -> np.ndarray:
    """Return the pixels of a small object, which is at another place in each photo."""
    mask = np.zeros(SIZE[::-1], bool)
    mask[30:54, 40 + 4 * number : 72 + 4 * number] = True
    return mask


def cutout(number: int) -> Image.Image:
    """Return a textured object, 7 % of the picture, on transparent black pixels."""
    mask = mask_of(number)
    pixels = np.random.default_rng(0).integers(0, 256, (*mask.shape, 4), dtype=np.uint8)
    pixels[..., 3] = 255
    pixels[~mask] = 0
    return Image.fromarray(pixels, "RGBA")


def on_colour(colour: str) -> Callable[[int], Image.Image]:
    def make(number: int) -> Image.Image:
        picture = Image.new("RGBA", SIZE, colour)
        picture.alpha_composite(cutout(number))
        return picture.convert("RGB")

    return make


def write_photos(folder: Path, make: Callable[[int], Image.Image], suffix: str = ".png") -> Path:
    folder.mkdir(parents=True)
    for number in range(4):
        make(number).save(folder / f"r_{number}{suffix}", **({"quality": 92} if suffix == ".jpg" else {}))
    return folder


def write_masks(folder: Path) -> Path:
    folder.mkdir()
    for number in range(4):
        Image.fromarray(mask_of(number)).convert("L").save(folder / f"r_{number}.png")
    return folder


def prepare(folder: Path, **options: object) -> tuple[dict[str, Prepared], dict[str, str]]:
    good, bad = prepare_photos(folder, folder.parent / "copies", max_size=1000, **options)  # type: ignore[arg-type]
    return {photo.name: photo for photo in good}, bad


@pytest.mark.parametrize("mode", ["RGBA", "P", "LA"])
@pytest.mark.parametrize("upright", [True, False])
def test_transparent_pixels_do_not_count_as_dark(tmp_path: Path, mode: str, upright: bool) -> None:
    def make(number: int) -> Image.Image:
        if mode != "P":
            return cutout(number).convert(mode)
        shown = cutout(number).convert("RGB").quantize(200)
        shown.info["transparency"] = shown.getpixel((0, 0))
        return shown

    good, bad = prepare(write_photos(tmp_path / "photos", make), upright=upright)
    assert len(good) == 4, bad
    for number, photo in enumerate(good.values()):
        assert photo.opaque == pytest.approx(mask_of(number).mean(), abs=0.02)


def test_a_small_object_is_not_blurred_and_a_blurred_one_is(tmp_path: Path) -> None:
    """Sharpness is that of the object without its outline, so neither its size nor its mask counts."""

    def make(size: int, blur: float = 0.0) -> Image.Image:
        texture = np.random.default_rng(0).integers(0, 256, (200, 200), dtype=np.uint8)
        pixels = np.zeros((200, 200, 4), np.uint8)
        pixels[..., :3] = np.asarray(Image.fromarray(texture).filter(ImageFilter.GaussianBlur(blur)))[..., None]
        pixels[..., 3] = 255
        mask = np.zeros((200, 200), bool)
        mask[20 : 20 + size, 20 : 20 + size] = True
        pixels[~mask] = 0
        return Image.fromarray(pixels, "RGBA")

    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        make(150).save(folder / f"{number}.png")
    make(20).save(folder / "far.png")
    make(150, 3.0).save(folder / "shaken.png")
    good, bad = prepare(folder)
    assert set(good) == {"0.png", "1.png", "2.png", "far.png"}
    assert bad["shaken.png"].startswith("it is blurred")


def test_dark_and_transparent_photos_stay_rejected(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "photos", cutout)
    dark = np.zeros((*SIZE[::-1], 4), np.uint8)
    Image.fromarray(dark, "RGBA").save(folder / "nothing.png")
    dark[..., 3] = 255 * mask_of(0)
    Image.fromarray(dark, "RGBA").save(folder / "black_object.png")
    Image.new("RGB", SIZE, "black").save(folder / "black.png")
    _, bad = prepare(folder, upright=False)
    assert bad == {
        "nothing.png": "it is transparent",
        "black_object.png": "it is too dark (100% of it is black)",
        "black.png": "it is too dark (100% of it is black)",
    }


@pytest.mark.parametrize("colour", ["black", "white"])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_plain_backgrounds_count_only_without_masks_and_poses(tmp_path: Path, colour: str, suffix: str) -> None:
    folder = write_photos(tmp_path / "photos", on_colour(colour), suffix)
    word = {"black": "dark", "white": "bright"}[colour]
    assert all(f"it is too {word}" in reason for reason in prepare(folder)[1].values())
    assert len(prepare(folder)[1]) == 4
    assert not prepare(folder, upright=False)[1]
    assert not prepare(folder, masks=write_masks(tmp_path / "masks"))[1]


def test_a_plain_background_is_connected_to_the_border() -> None:
    picture = np.full((40, 50, 3), 255, np.uint8)
    picture[10:30, 10:30] = 90
    picture[15:20, 15:20] = 255  # belongs to the object
    background = plain_background(picture)
    assert background is not None
    assert not background[10:30, 10:30].any() and background.sum() == 40 * 50 - 400
    noisy = np.clip(picture + np.random.default_rng(0).normal(0, 3, picture.shape), 0, 255).astype(np.uint8)
    assert plain_background(noisy) is not None and plain_background(noisy, without_noise=True) is None
    assert plain_background(np.full((40, 50, 3), 128, np.uint8)) is None
    assert plain_background(np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)) is None


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_masks_are_taken_from_the_transparency(tmp_path: Path, orientation: int) -> None:
    """They have the orientation and the size of the copies, and follow the removal of distortion."""
    folder = write_photos(tmp_path / "photos", cutout)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    cutout(0).save(folder / "r_0.png", exif=exif)
    good, _ = prepare(folder)
    width, height = good["r_0.png"].size
    lens = Camera(width, height, 100.0, 100.0, width / 2, height / 2, np.eye(4), distortion=(-0.1, 0.0, 0.0, 0.0))
    make = cutout_masks(folder, good, dict.fromkeys(good, lens))
    assert make is not None
    photo = Photo("r_0.png", good["r_0.png"].file, lens)
    with Image.open(photo.file) as copy:
        object_pixels = np.asarray(copy).any(axis=2)
    assert (make(photo) != object_pixels).mean() < 1e-3
    pixels, pinhole = lens.undistorted(np.uint8(255) * object_pixels.astype(np.uint8)[..., None])
    straight = make(replace(photo, camera=pinhole))
    np.testing.assert_array_equal(straight, pixels.reshape(straight.shape) >= 128)


def test_photos_without_transparent_pixels_have_no_such_masks(tmp_path: Path) -> None:
    opaque = write_photos(tmp_path / "opaque/photos", lambda number: on_colour("red")(number).convert("RGBA"))
    mixed = write_photos(tmp_path / "mixed/photos", lambda number: cutout(number) if number else on_colour("red")(0))
    for folder in (opaque, mixed):
        good, _ = prepare(folder)
        assert len(good) == 4
        assert cutout_masks(folder, good, dict.fromkeys(good)) is None  # type: ignore


def test_masks_of_the_user_follow_the_removal_of_distortion(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "photos", cutout)
    good, _ = prepare(folder)
    lens = Camera(*SIZE, 100.0, 100.0, 60.0, 45.0, np.eye(4), distortion=(-0.1, 0.0, 0.0, 0.0))
    _, pinhole = lens.undistorted(np.zeros((90, 120, 1), np.uint8))
    photo = Photo("r_0.png", good["r_0.png"].file, pinhole)
    mask = given_masks(write_masks(tmp_path / "masks"), good, {"r_0.png": lens})(photo)
    expected, _ = lens.undistorted(np.uint8(255) * mask_of(0).astype(np.uint8)[..., None])
    np.testing.assert_array_equal(mask, expected.reshape(mask.shape) >= 128)


@pytest.mark.parametrize("background", ["transparent", "black", "white"])
def test_a_data_set_of_nerf_becomes_a_capture_with_masks(
    tmp_path: Path, background: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its transforms.json has a field of view, and names without suffix; a test replaces the triangulation."""
    make = cutout if background == "transparent" else on_colour(background)
    folder = write_photos(tmp_path / "train", make)
    cameras = [
        Camera.look_at((np.cos(a), np.sin(a), 0.5), (0, 0, 0), width=SIZE[0], height=SIZE[1], fov_x=50)
        for a in (0.0, 0.5, 1.0, 1.5)
    ]
    frames = [
        {"file_path": f"./train/r_{n}", "transform_matrix": (c.world_from_camera * (1, -1, -1, 1)).tolist()}
        for n, c in enumerate(cameras)
    ]
    content = {"camera_angle_x": float(np.radians(50)), "frames": frames}
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))

    def triangulated(_photos: object, known: dict[str, Camera], *_: object) -> SparseModel:
        points = np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
        seen = dict.fromkeys(known, np.arange(40, dtype=np.int32))
        return SparseModel(known, points, np.full((40, 3), 99, np.uint8), seen)

    monkeypatch.setattr(poses, "find_points", triangulated)
    settings = CaptureSettings(poses=tmp_path / "transforms_train.json", metric=True)
    capture = capture_photos(folder, tmp_path / "out", settings).capture
    assert not capture.rejected
    for number, photo in enumerate(capture.photos):
        np.testing.assert_allclose(photo.camera.world_from_camera, cameras[number].world_from_camera, atol=1e-12)
        mask, _ = photo.read_mask()
        assert mask is not None
        found, wanted = mask >= 0.5, mask_of(number)
        assert (found & wanted).sum() / (found | wanted).sum() > 0.95


def test_masks_of_labels_and_of_the_background_are_refused(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "photos", cutout)
    good, _ = prepare(folder)
    masks = write_masks(tmp_path / "masks")
    for path in masks.iterdir():
        with Image.open(path) as image:
            Image.fromarray(np.asarray(image.convert("L")) // 255).save(path)
    lens = Camera(*SIZE, 100.0, 100.0, 60.0, 45.0, np.eye(4))
    photos = tuple(Photo(name, photo.file, lens) for name, photo in good.items())
    with pytest.raises(InputError, match=r"white, 255, must mark the object \(got at most 1\)"):
        given_masks(masks, good, dict.fromkeys(good, lens))(photos[0])

    capture = Capture(photos, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    objects = {photo.name: mask_of(number) for number, photo in enumerate(photos)}
    check_borders(add_masks(capture, lambda photo: objects[photo.name], tmp_path / "objects"), masks)
    inverted = add_masks(capture, lambda photo: ~objects[photo.name], tmp_path / "inverted")
    with pytest.raises(InputError, match=r"masks must be white, .* \(got 4 of 4 .*\): invert them"):
        check_borders(inverted, masks)
