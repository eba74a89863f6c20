"""Background pictures: a rotated part of an image, resampled to the picture's size."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mitsplat.arrays import AnyArray, ByteImage, Float32Array
from mitsplat.images.colour import decode_srgb
from mitsplat.renderer.textures import read_image
from mitsplat.scene.planning.layout_surroundings import BackgroundDraw


def background_picture(background: BackgroundDraw, path: Path, width: int, height: int) -> Float32Array:
    """Return the linear background picture (H, W, 3) from an image file."""
    return background.gain * crop_background(read_image(path), background, width, height)


def crop_background(image: ByteImage, background: BackgroundDraw, width: int, height: int) -> Float32Array:
    """Cut a rotated rectangle out of an image and resample it to linear colours (H, W, 3).

    The rectangle has the picture's aspect ratio and lies entirely inside the image. If it has more pixels than the
    picture, the result averages them.
    """
    turn = np.radians(background.rotate)
    cosine, sine = np.cos(turn), np.sin(turn)
    bounds = np.abs([[cosine, sine], [sine, cosine]]) @ (width, height)  # of the rotated picture [px of the picture]
    size = np.array(image.shape[1::-1])
    step = float((size / bounds).min()) * background.crop  # pixels of the image per pixel of the picture
    reach = step * bounds / 2
    middle = reach + np.array(background.place) * (size - 2 * reach)
    low, high = np.floor(middle - reach).astype(int), np.ceil(middle + reach).astype(int)
    low, high = np.maximum(low, 0), np.minimum(high, size)
    values = decode_srgb(np.arange(256) / 255).astype(np.float32)
    part: AnyArray = values[image[low[1] : high[1], low[0] : high[0]]]
    if step > 1:
        small = np.maximum(np.rint((high - low) / step).astype(int), 1)
        part = cv2.resize(part, tuple(map(int, small)), interpolation=cv2.INTER_AREA)
    scale = np.array(part.shape[1::-1]) / (high - low)
    # The map takes pixel centres of the picture to pixel centres of the part; OpenCV counts centres as whole numbers.
    linear = scale[:, None] * step * np.array([[cosine, -sine], [sine, cosine]])
    offset = scale * (middle - low) - linear @ (np.array([width, height]) / 2 - 0.5) - 0.5
    return np.asarray(
        cv2.warpAffine(
            part,
            np.column_stack([linear, offset]),
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        dtype=np.float32,
    )
