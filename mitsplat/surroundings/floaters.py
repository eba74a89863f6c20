"""Gaussians that photographs do not bear out: haze, what hangs where they look through, and what none of them shows.

A fit may explain what differs from photo to photo by haze, or by specks close to a camera. Haze is Gaussians so large
that they reach through much of the place; a fit does not know it from those photos whose camera's plane it reaches
(``mitsplat/renderer/differentiation/backward.py``). Specks stand in free space: other photos see surfaces behind them
(space carving, Kutulakos and Seitz 2000). Nothing goes that makes the photos come out worse.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsplat.arrays import BoolArray, Int64Array
from mitsplat.capture.capture import Photo
from mitsplat.fit.image_metrics import psnr
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.reconstruct.asset_evaluation import HeldOutView, show_held_out
from mitsplat.surroundings.depth_views import DepthView, depth_views

_LARGEST = (2.0, 1.0, 0.6, 0.4, 0.3)
"""Standard deviations from which Gaussians are tried as haze, as a share of the typical depth."""
_WORSE = 0.05
"""PSNR that the removal of specks may cost [dB]."""
_JUDGES = 8
"""Training photos by which removals are judged, and their longest edge [px]."""
_SIZE = 240
_DEPTH = 0.03
"""Share of the depth by which a Gaussian may lie before a surface and belong to it."""
_REACH = 2.0
"""Standard deviations of a Gaussian that it reaches."""
_PASSED = 3
"""Least number of photos that must look through a speck, or show a surface that is close to a camera."""
_NEAR = 0.3
"""Depth that is close to a camera, as a share of the typical one."""
_BORNE = 0.1
"""Photos that show a surface where it is, as a share of those, from which it is none."""


def remove_floaters(splats: Splats, photos: Sequence[Photo], scale: float) -> tuple[Splats, dict[str, int]]:
    """The splats without what the photos do not bear out, and how many went why.

    Args:
        splats: Of the whole place.
        photos: That they were fitted to.
        scale: Typical depth of these.
    """
    judges = [photos[int(i)] for i in np.unique(np.linspace(0, len(photos) - 1, _JUDGES).round())]
    best, kept = _psnr(splats, judges), splats
    for limit in _LARGEST:
        tried = splats.select(splats.scales.max(axis=1) <= limit * scale)
        if len(tried) and (found := _psnr(tried, judges)) > best:
            best, kept = found, tried
    removed = {"haze": len(splats) - len(kept)}
    specks, unseen = find_unsupported(kept, depth_views(kept, [p.camera for p in photos]), _NEAR * scale)
    removed |= {"specks": 0, "in no photo": int(unseen.sum())}
    tried = kept.select(~(specks | unseen))
    if len(tried) and _psnr(tried, judges) >= best - _WORSE:
        removed["specks"] = int((specks & ~unseen).sum())
        return tried, removed
    return kept.select(~unseen), removed


def _psnr(splats: Splats, photos: Sequence[Photo]) -> float:
    return mean_psnr(show_held_out(splats, None, photos, _SIZE))


def mean_psnr(views: Sequence[HeldOutView]) -> float:
    """Mean PSNR of renders against their photos [dB]."""
    return float(np.mean([psnr(view.render, view.photo) for view in views]))


def find_unsupported(splats: Splats, views: Sequence[DepthView], near: float) -> tuple[BoolArray, BoolArray]:
    """Which Gaussians hang in free space, and which are in no photo, (N,) each.

    Args:
        splats: Of the whole place.
        views: Depths of the same splats from the cameras of its photos.
        near: Depth up to which what fewer than three photos show is no surface.
    """
    passed: Int64Array = np.zeros(len(splats), dtype=np.int64)
    borne, shown, close = passed.copy(), passed.copy(), np.zeros(len(splats), dtype=bool)
    means, reach = splats.means.astype(np.float64), _REACH * splats.scales.max(axis=1).astype(np.float64)
    for view in views:
        depth, surface = view.look(means)
        shown += np.isfinite(depth)
        room = reach + _DEPTH * np.where(np.isfinite(surface), surface, depth)
        passed += depth < surface - room
        borne += np.abs(depth - surface) <= room
        close |= depth < near
    return ((passed >= _PASSED) & (borne <= _BORNE * passed)) | (close & (borne < _PASSED)), shown == 0
