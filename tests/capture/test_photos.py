"""Preparation of photographs: rotated, reduced, copied, and rejected with a reason."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from mitsplat.capture import structure_from_motion
from mitsplat.capture.capture import Photo
from mitsplat.capture.photos import Prepared, find_photos, prepare_photos, turn_upright, undistort
from mitsplat.capture.structure_from_motion import SparseModel, lens_groups
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera


def texture(seed: int = 0, size: tuple[int, int] = (60, 80)) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 256, (size[0] // 2, size[1] // 2, 3), dtype=np.uint8)
    return coarse.repeat(2, axis=0).repeat(2, axis=1)


def prepare(folder: Path, **options: object) -> tuple[dict[str, Prepared], dict[str, str]]:
    prepared, rejected = prepare_photos(folder, folder.parent / "copies", **{"max_size": 1000, **options})  # type: ignore[arg-type]
    return {photo.name: photo for photo in prepared}, rejected


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        Image.fromarray(texture(number)).save(folder / f"{number}.png")
    return folder


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied_to_the_pixels(folder: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.Model] = "Box"
    Image.fromarray(texture()).save(folder / "turned.png", exif=exif)
    photo = prepare(folder)[0]["turned.png"]
    # Transformation of the stored pixels by each orientation value (EXIF 2.3, 4.6.4).
    stored = texture()
    upright = [
        stored, stored[:, ::-1], stored[::-1, ::-1], stored[::-1],
        stored.swapaxes(0, 1), np.rot90(stored, -1), stored[::-1, ::-1].swapaxes(0, 1), np.rot90(stored, 1),
    ]  # fmt: skip
    with Image.open(photo.file) as copy:
        np.testing.assert_array_equal(np.asarray(copy), upright[orientation - 1])
        assert copy.getexif().get(ExifTags.Base.Orientation, 1) == 1
        assert copy.getexif()[ExifTags.Base.Model] == "Box"
    assert photo.size == upright[orientation - 1].shape[1::-1]
    assert photo.orientation == orientation
    raw = prepare_photos(folder, folder.parent / "raw", max_size=1000, upright=False)[0][-1]
    with Image.open(raw.file) as copy:
        np.testing.assert_array_equal(np.asarray(copy), stored)


def test_photos_that_need_no_change_are_copied_byte_by_byte(folder: Path) -> None:
    (folder / "below").mkdir()
    Image.fromarray(texture(9)).save(folder / "below/a.JPG", "JPEG", quality=70)
    photos, rejected = prepare(folder)
    assert rejected == {}
    assert photos["below/a.JPG"].file.name == "below__a.JPG"
    assert photos["below/a.JPG"].file.read_bytes() == (folder / "below/a.JPG").read_bytes()
    assert photos["0.png"].file.read_bytes() == (folder / "0.png").read_bytes()


def test_large_photos_are_reduced_and_sizes_may_be_mixed(folder: Path) -> None:
    Image.fromarray(texture(7, (120, 400))).save(folder / "large.png")
    photos, _ = prepare(folder, max_size=100)
    assert photos["large.png"].size == (100, 30)
    assert photos["0.png"].size == (80, 60)
    assert photos["large.png"].lens != photos["0.png"].lens == photos["1.png"].lens


def test_16_bit_grey_is_not_clipped(folder: Path) -> None:
    grey = (texture()[..., 0].astype(np.uint16) << 8) + 77
    Image.fromarray(grey).save(folder / "deep.png")
    with Image.open(prepare(folder)[0]["deep.png"].file) as copy:
        np.testing.assert_array_equal(np.asarray(copy)[..., 1], texture()[..., 0])


def test_unusable_photos_are_named_with_a_reason(folder: Path) -> None:
    Image.fromarray(texture(5)).save(folder / "whole.jpg")
    data = (folder / "whole.jpg").read_bytes()
    (folder / "torn.jpg").write_bytes(data[: len(data) // 2])
    (folder / "text.jpg").write_text("no image")
    (folder / "phone.heic").write_bytes(b"\0" * 20)
    (folder / "notes.txt").write_text("not looked at")
    Image.fromarray(cv2.GaussianBlur(texture(6), (0, 0), 4)).save(folder / "moved.png")
    Image.fromarray(texture(6) // 100).save(folder / "night.png")
    Image.fromarray(255 - texture(6) // 100).save(folder / "flash.png")
    photos, rejected = prepare(folder)
    assert set(photos) == {"0.png", "1.png", "2.png", "whole.jpg"}
    assert set(rejected) == {"torn.jpg", "text.jpg", "phone.heic", "moved.png", "night.png", "flash.png"}
    assert rejected["torn.jpg"].startswith("it cannot be read (")
    assert rejected["phone.heic"] == "HEIC files are not supported; export it as JPEG or PNG"
    assert rejected["moved.png"].startswith("it is blurred (sharpness ")
    assert rejected["night.png"] == "it is too dark (100% of it is black)"
    assert rejected["flash.png"] == "it is too bright (100% of it is white)"


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="gone: must be an existing folder of photographs, or a video"):
        prepare_photos(tmp_path / "gone", tmp_path / "out", max_size=100)


def test_a_photograph_whose_name_is_not_utf_8_is_refused(folder: Path) -> None:
    """COLMAP does not accept such a name."""
    (folder / os.fsdecode(b"caf\xe9.txt")).write_text("")
    assert len(find_photos(folder)) == 3
    (folder / os.fsdecode(b"caf\xe9.png")).write_bytes((folder / "0.png").read_bytes())
    with pytest.raises(InputError, match=r"names of files and folders must be UTF-8 \(got b'.*/caf\\xe9\.png'\)$"):
        prepare(folder)


def test_undistorted_photos_show_the_same_directions(tmp_path: Path) -> None:
    """The image encodes the direction of every pixel. After undistortion, each pixel must encode its own direction."""
    camera = Camera(160, 120, 130.0, 128.0, 82.0, 59.0, np.eye(4), distortion=(-0.2, 0.05, 0.001, -0.002))
    y, x = np.mgrid[:120, :160] + 0.5
    slopes = camera.ray_slopes(np.column_stack([x.ravel(), y.ravel()])).reshape(120, 160, 2)
    code = np.dstack([128 + 150 * slopes, np.full((120, 160), 128)])
    Image.fromarray(np.rint(code).clip(0, 255).astype(np.uint8)).save(tmp_path / "a.png")
    photo = undistort(Photo("a.png", tmp_path / "a.png", camera))
    assert photo.camera.distortion == ()
    shown = 255 * photo.read().rgb
    slopes = photo.camera.ray_slopes(np.column_stack([x.ravel(), y.ravel()])).reshape(120, 160, 2)
    assert np.abs(shown[..., :2] - (128 + 150 * slopes))[2:-2, 2:-2].max() < 1.2  # a pixel is 1.15 of the code
    assert np.abs((shown[..., :2] - (128 + 150 * slopes))[2:-2, 2:-2].mean()) < 0.05


def test_photos_are_found_through_links_and_masks_are_ignored(folder: Path) -> None:
    ring = folder.parent / "ring"
    ring.mkdir()
    Image.fromarray(texture(7)).save(ring / "7.PNG")
    (folder / "linked").symlink_to(ring)
    (folder / "around").symlink_to(folder)
    (folder / "masks").mkdir()
    Image.new("L", (80, 60)).save(folder / "masks/0.png")
    found = find_photos(folder, masks=folder / "masks")
    assert [path.relative_to(folder).as_posix() for path in found] == ["0.png", "1.png", "2.png", "linked/7.PNG"]


@pytest.mark.parametrize("names", [("a/b.png", "a__b.png"), ("c.tif", "c.tif.png"), ("c.webp", "c.webp.jpg")])
def test_photos_whose_copies_would_have_the_same_name_are_refused(folder: Path, names: tuple[str, str]) -> None:
    (folder / "a").mkdir()
    for name in names:
        Image.fromarray(texture(8)).save(folder / name)
    with pytest.raises(InputError, match=r"its copy would have the same name as that of .*: rename one of them"):
        prepare(folder)


def test_upright_copies_of_photos_that_differ_in_their_suffix_differ(tmp_path: Path) -> None:
    for number, name in enumerate(("a.png", "a.bmp")):
        Image.fromarray(texture(number)).save(tmp_path / name)
    photos = [Prepared(name, tmp_path / name, (80, 60), 1, (), pending=6) for name in ("a.png", "a.bmp")]
    pictures = [np.asarray(Image.open(turn_upright(photo).file)) for photo in photos]
    assert not np.array_equal(*pictures)


def test_a_single_photo_is_refused_as_a_folder(folder: Path) -> None:
    with pytest.raises(InputError, match=r"0\.png: must be an existing folder of photographs, or a video"):
        find_photos(folder / "0.png")


def test_exif_that_cannot_be_written_is_omitted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    exif[ExifTags.Base.ImageDescription] = "x" * 70_000
    Image.fromarray(texture(9)).save(folder / "long.webp", exif=exif)
    photo = prepare(folder)[0]["long.webp"]
    with Image.open(photo.file) as copy:
        assert copy.size == photo.size and not copy.getexif()


def test_photos_without_exif_data_share_intrinsics_only_within_their_folder(tmp_path: Path) -> None:
    """Two cameras, or two zoom settings of one, often differ by nothing but the folder of their photos."""
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Maker", "Phone"
    folders = {"wide": 3, "tele": 3, "phone": 3, "phone/ring 2": 4, "rig/1": 1, "rig/2": 2}
    for name, count in folders.items():
        (tmp_path / "photos" / name).mkdir(parents=True)
        options = {"exif": exif} if name.startswith("phone") else {}
        for number in range(count):
            Image.fromarray(texture(number)).save(tmp_path / f"photos/{name}/{number}.png", **options)
    photos, rejected = prepare(tmp_path / "photos")
    assert rejected == {}
    groups = lens_groups(list(photos.values()))
    together = sorted(sorted({Path(photo.name).parent.as_posix() for photo in group}) for group in groups)
    assert together == [["phone", "phone/ring 2"], ["rig/1", "rig/2"], ["tele"], ["wide"]]
    assert sum(map(len, groups)) == sum(folders.values())


@pytest.mark.parametrize(
    ("apart", "shared", "kept"),
    [
        ([1.0] * 5, None, 0),  # enough photos have cameras
        ([1.0] * 4, [1.0] * 5, 1),
        ([1.0] * 4, [1.0] * 4, 0),
        ([1.0] * 4, [1.0] * 3 + [0.01] * 3, 0),  # cameras that are wrong do not count
        ([1.0] * 4, [], 0),
    ],
)
def test_folders_of_one_camera_share_intrinsics_if_few_photos_have_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, apart: list[float], shared: list[float] | None, kept: int
) -> None:
    """Of 23 photos without EXIF data, 17 had cameras with intrinsics for each three, and 20 with common ones."""
    photos = [Prepared(f"{n // 3}/{n}.png", tmp_path / f"{n}.png", (8, 6), 1, ("8", "6")) for n in range(6)]
    camera = Camera(8, 6, 9, 9, 4, 3, np.eye(4))
    none = SparseModel({}, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8), {})
    models = []
    for found in (apart, shared or []):
        names = [photo.file.name for photo in photos[: len(found)]]
        agreement = dict(zip(names, found, strict=True))
        models.append(replace(none, cameras=dict.fromkeys(names, camera), agreement=agreement))
    jobs: list[list[list[str]]] = []

    def read(arrays: dict[str, object], _: object) -> SparseModel:
        jobs.append(arrays["groups"])
        if not (model := models[len(jobs) - 1]).cameras:
            raise InputError("no two photos share enough points")
        return model

    monkeypatch.setattr(structure_from_motion, "_run", lambda job, folder, progress: job)
    monkeypatch.setattr(structure_from_motion, "_read_arrays", read)
    assert structure_from_motion.find_cameras(photos, tmp_path) is models[kept]
    assert [list(map(len, groups)) for groups in jobs] == [[3, 3], [6]][: 1 if shared is None else 2]
