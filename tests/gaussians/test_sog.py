"""``.sog`` files, written here by the specification of version 2, and archives that contradict it."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats

WIDTH, HEIGHT, COUNT, PALETTE = 20, 15, 290, 70
Files = dict[str, bytes]
Change = Callable[[dict[str, Any], Files], None]


def image(pixels: np.ndarray, form: str = "WEBP", **options: object) -> bytes:
    """Encode pixels (N, 4) row by row; the last pixels belong to no Gaussian."""
    table = np.zeros((HEIGHT * WIDTH, 4), np.uint8)
    table[: len(pixels)] = pixels
    output = io.BytesIO()
    options = options or ({"lossless": True, "exact": True} if form == "WEBP" else {})
    Image.fromarray(table.reshape(HEIGHT, WIDTH, 4)).save(output, form, **options)
    return output.getvalue()


def coded(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Return a codebook of 256 values, and the index of the nearest one for each value."""
    codebook = np.quantile(values, np.linspace(0, 1, 256))
    return codebook.tolist(), np.abs(values[..., None] - codebook).argmin(axis=-1)


def opaque(values: np.ndarray) -> np.ndarray:
    return np.c_[values, np.full(len(values), 255)]


def sog(path: Path, bands: int = 0, change: Change = lambda meta, files: None) -> dict[str, np.ndarray]:
    """Write an archive and return the values that it holds."""
    rng = np.random.default_rng(bands)
    means, logs = rng.normal(0, 2, (COUNT, 3)), rng.normal(-4, 1, (COUNT, 3))
    colours, alpha = rng.normal(0, 0.6, (COUNT, 3)), rng.integers(1, 256, COUNT)
    quats = rng.normal(size=(COUNT, 4))  # w, x, y, z
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    stretched = np.sign(means) * np.log1p(np.abs(means))
    low, high = stretched.min(axis=0), stretched.max(axis=0)
    steps = np.rint((stretched - low) / (high - low) * 65535).astype(int)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.sign(np.take_along_axis(quats, largest[:, None], axis=1))
    smaller = np.array([np.delete(row, k) for row, k in zip(quats, largest, strict=True)])
    scale_codes, scale_index = coded(logs)
    colour_codes, colour_index = coded(colours)
    files = {
        "means_l.webp": image(opaque(steps & 255)),
        "means_u.webp": image(opaque(steps >> 8)),
        "quats.webp": image(np.c_[np.rint((smaller * np.sqrt(2) + 1) * 127.5), 252 + largest]),
        "scales.webp": image(opaque(scale_index)),
        "sh0.webp": image(np.c_[colour_index, alpha]),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "count": COUNT,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codes, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colour_codes, "files": ["sh0.webp"]},
    }
    sh = np.array(colour_codes)[colour_index][:, None]
    if bands:
        coefficients = (bands + 1) ** 2 - 1
        codes, index = coded(rng.normal(0, 0.2, (PALETTE, coefficients, 3)))
        labels = rng.integers(0, PALETTE, COUNT)
        palette = np.zeros((2, 64 * coefficients, 4), np.uint8)
        palette.reshape(-1, 4)[: PALETTE * coefficients, :3] = index.reshape(-1, 3)
        output = io.BytesIO()
        Image.fromarray(palette).save(output, "WEBP", lossless=True, exact=True)
        files["shN_centroids.webp"] = output.getvalue()
        files["shN_labels.webp"] = image(opaque(np.c_[labels & 255, labels >> 8, 0 * labels]))
        names = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": PALETTE, "bands": bands, "codebook": codes, "files": names}
        sh = np.concatenate([sh, np.array(codes)[index][labels]], axis=1)
    change(meta, files)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {"meta.json": json.dumps(meta).encode(), **files}.items():
            archive.writestr(name, content)
    scales = np.exp(np.array(scale_codes)[scale_index])
    return {"means": means, "quats": quats[:, [1, 2, 3, 0]], "scales": scales, "opacities": alpha / 255, "sh": sh}


@pytest.mark.parametrize("bands", range(4))
@pytest.mark.parametrize("form", ["WEBP", "PNG"])
def test_all_degrees_are_read_within_their_quantisation(tmp_path: Path, bands: int, form: str) -> None:
    def reencode(meta: dict[str, Any], files: Files) -> None:
        for name, content in files.items() if form == "PNG" else ():
            output = io.BytesIO()
            Image.open(io.BytesIO(content)).save(output, "PNG")
            files[name] = output.getvalue()

    expected = sog(tmp_path / "a.sog", bands, reencode)
    loaded = Splats.load(tmp_path / "a.sog")
    np.testing.assert_allclose(loaded.means, expected["means"], atol=2e-3)
    np.testing.assert_allclose(np.abs((loaded.quats * expected["quats"]).sum(axis=1)), 1, atol=1e-4)
    for name, rtol in (("scales", 1e-5), ("opacities", 1e-6), ("sh", 1e-5)):
        np.testing.assert_allclose(getattr(loaded, name), expected[name], rtol=rtol, atol=1e-6, err_msg=name)


def set_count(meta: dict[str, Any], files: Files) -> None:
    meta["count"] = HEIGHT * WIDTH + 1


def cut_image(meta: dict[str, Any], files: Files) -> None:
    output = io.BytesIO()
    Image.open(io.BytesIO(files["scales.webp"])).crop((0, 0, WIDTH, 5)).save(output, "WEBP", lossless=True)
    files["scales.webp"] = output.getvalue()


def compress_as_picture(meta: dict[str, Any], files: Files) -> None:
    files["sh0.webp"] = image(np.asarray(Image.open(io.BytesIO(files["sh0.webp"]))).reshape(-1, 4), quality=80)


def set_alpha(meta: dict[str, Any], files: Files) -> None:
    files["quats.webp"] = image(np.full((COUNT, 4), 248))


def set_label(meta: dict[str, Any], files: Files) -> None:
    files["shN_labels.webp"] = image(opaque(np.full((COUNT, 3), 1)))


def narrow_palette(meta: dict[str, Any], files: Files) -> None:
    meta["shN"]["bands"] = 2


def shorten_codebook(meta: dict[str, Any], files: Files) -> None:
    meta["scales"]["codebook"] = meta["scales"]["codebook"][:9]


def set_version(version: int) -> Change:
    return lambda meta, files: meta.update(version=version)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (set_count, r"means_l\.webp must have a pixel for each of the 301 Gaussians \(got 300\)"),
        (cut_image, r"scales\.webp must have a pixel for each of the 290 Gaussians \(got 100\)"),
        (compress_as_picture, r"sh0\.webp must be lossless"),
        (set_alpha, r"alpha of quats\.webp must be 252 to 255 \(got 248\)"),
        (set_label, r"labels of shN_labels\.webp must be below 70 \(got 257\)"),
        (narrow_palette, r"shN_centroids\.webp must be 512 px wide and hold 70 centroids \(got 192x2 px\)"),
        (shorten_codebook, r"not a valid sog file \(meta\.json\.scales\.codebook: .* 256 items"),
        (lambda meta, files: files.pop("quats.webp"), r"not a valid sog file \(quats\.webp is missing\)"),
        (lambda meta, files: files.update({"sh0.webp": b"RIFF"}), r"not a valid sog file \(sh0\.webp: "),
        (set_version(1), r"SOG files must have version 2 \(got 1\): convert it to version 2, or to \.ply"),
        (set_version(3), r"SOG files must have version 2 \(got 3\)"),
        (lambda meta, files: meta.pop("version"), r"SOG files must have version 2 \(got 1\)"),
    ],
)
def test_archives_that_contradict_themselves_are_refused(tmp_path: Path, change: Change, sentence: str) -> None:
    """Most of them gave wrong splats without a word."""
    sog(tmp_path / "a.sog", 1, change)
    with pytest.raises(InputError, match=rf"a\.sog: {sentence}"):
        Splats.load(tmp_path / "a.sog")


def test_the_archive_of_a_folder_is_refused_with_a_remedy(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("scan/meta.json", "{}")
    with pytest.raises(InputError, match=r"a\.sog: .*scan/meta\.json is in a folder: put the files at the top"):
        Splats.load(tmp_path / "a.sog")
