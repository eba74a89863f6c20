"""Removal of Gaussians that the photographs do not support: haze, specks in free space, and unseen Gaussians.

A fit can explain differences between photos by haze, or by specks close to a camera. Haze consists of Gaussians large
enough to extend through much of the scene. The fit has no gradient from photos whose camera plane such a Gaussian
reaches (``mitsplat/renderer/differentiation/backward.py``). Specks lie in free space: other photos show surfaces behind
them (space carving, Kutulakos and Seitz 2000). No removal may lower the quality of the photos.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsplat.arrays import BoolArray, Int64Array
from mitsplat.capture.capture import Photo, SizedPhoto
from mitsplat.fit.image_metrics import psnr
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.reconstruct.asset_evaluation import show_asset, take_evenly
from mitsplat.surroundings.depth_views import DepthView, depth_views

_HAZE_LIMITS = (2.0, 1.0, 0.6, 0.4, 0.3)
"""Candidate limits of the standard deviation above which Gaussians are haze, as shares of the typical depth."""
_MAX_PSNR_LOSS = 0.05
"""Largest loss of PSNR by the removal of specks [dB]."""
_TEST_PHOTOS = 8
"""Number of training photos that test removals; ``_SIZE`` is their longest edge [px]."""
_SIZE = 240
_DEPTH_TOLERANCE = 0.03
"""Largest depth of a Gaussian in front of its surface, as a share of the depth."""
_RADIUS_SIGMAS = 2.0
"""Radius of a Gaussian in standard deviations."""
_MIN_PHOTOS = 3
"""Least number of photos that must see through a speck, or that must confirm a surface close to a camera."""
_CLOSE_DEPTH = 0.3
"""Depth below which a surface is close to a camera, as a share of the typical depth."""
_MAX_CONFIRMED = 0.1
"""Largest share of confirming photos, relative to those that see through, for a speck."""


def remove_floaters(splats: Splats, photos: Sequence[Photo], scale: float) -> tuple[Splats, dict[str, int]]:
    """Return the splats without unsupported Gaussians, and the number of removed Gaussians by reason.

    Args:
        splats: Splats of the whole scene.
        photos: Photos of the fit.
        scale: Typical depth of the photos.
    """
    test_photos = [photo.fitted(_SIZE) for photo in take_evenly(photos, _TEST_PHOTOS)]
    best, kept = _psnr(splats, test_photos), splats
    for limit in _HAZE_LIMITS:
        tried = splats.select(splats.scales.max(axis=1) <= limit * scale)
        if len(tried) and (found := _psnr(tried, test_photos)) > best:
            best, kept = found, tried
    removed = {"haze": len(splats) - len(kept)}
    specks, unseen = find_unsupported(kept, depth_views(kept, [p.camera for p in photos]), _CLOSE_DEPTH * scale)
    removed |= {"specks": 0, "in no photo": int(unseen.sum())}
    tried = kept.select(~(specks | unseen))
    if len(tried) and _psnr(tried, test_photos) >= best - _MAX_PSNR_LOSS:
        removed["specks"] = int((specks & ~unseen).sum())
        return tried, removed
    return kept.select(~unseen), removed


def _psnr(splats: Splats, photos: Sequence[SizedPhoto]) -> float:
    """Return the mean PSNR of the splats in photos [dB]."""
    views = show_asset(splats, None, [photo.camera for photo in photos])
    return float(np.mean([psnr(view.render, photo.rgb) for view, photo in zip(views, photos, strict=True)]))


def find_unsupported(splats: Splats, views: Sequence[DepthView], near: float) -> tuple[BoolArray, BoolArray]:
    """Return True for Gaussians in free space, and True for Gaussians that are in no photo, (N,) each.

    Args:
        splats: Splats of the whole scene.
        views: Depths of the same splats from the cameras of the photos.
        near: Depth below which a surface needs three photos.
    """
    seen_through: Int64Array = np.zeros(len(splats), dtype=np.int64)
    confirmed, shown, close = seen_through.copy(), seen_through.copy(), np.zeros(len(splats), dtype=bool)
    means, reach = splats.means.astype(np.float64), _RADIUS_SIGMAS * splats.scales.max(axis=1).astype(np.float64)
    for view in views:
        depth, surface = view.depths_at(means)
        shown += np.isfinite(depth)
        room = reach + _DEPTH_TOLERANCE * np.where(np.isfinite(surface), surface, depth)
        seen_through += depth < surface - room
        confirmed += np.abs(depth - surface) <= room
        close |= depth < near
    in_free_space = (seen_through >= _MIN_PHOTOS) & (confirmed <= _MAX_CONFIRMED * seen_through)
    unconfirmed = close & (confirmed < _MIN_PHOTOS)
    return in_free_space | unconfirmed, shown == 0
