"""Choice of the proxy surface when splats or masks are wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.assets.known import chamfer
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.reconstruct.fallback_proxy import CONVEX, FINEST, HULL, find_proxy_surface
from mitsplat.reconstruct.segment_splats import MaskedView, isolate_object
from mitsplat.reconstruct.surface import SurfaceSettings
from tests.conftest import KnownObject
from tests.reconstruct.test_reconstruct import GOOD

SETTINGS = SurfaceSettings(voxels=64, faces=4000)


def views_of(known: KnownObject) -> list[MaskedView]:
    sized = [photo.fitted(160) for photo in known.capture.training]
    return [MaskedView(camera, mask) for camera, _, mask, _ in sized if mask is not None]


def test_a_surface_consistent_with_masks_is_kept_at_full_resolution(known_object: KnownObject) -> None:
    found = find_proxy_surface(known_object.splats, views_of(known_object), SETTINGS)
    assert (found.source, found.faults) == (FINEST, ())
    assert chamfer(found.mesh, known_object.mesh) < 0.004


def test_wrong_depth_falls_back_to_the_hull_of_masks(known_object: KnownObject) -> None:
    """Most Gaussians have moved towards the middle, and are visible through the others."""
    splats = known_object.splats
    inner = np.arange(len(splats)) % 3 > 0
    means = np.where(inner[:, None], 0.4 * splats.means, splats.means)
    wrong = replace(splats, means=means, opacities=np.where(inner, 0.98, 0.3).astype(np.float32))
    found = find_proxy_surface(wrong, views_of(known_object), SETTINGS)
    assert found.source == HULL
    for fault, reason in zip(found.faults, ("IoU with the masks of only", "% of the diagonal", "IoU"), strict=True):
        assert reason in fault
    assert found.mesh.is_volume
    assert chamfer(found.mesh, known_object.mesh) < 0.02


def test_inconsistent_masks_fall_back_to_the_splats(known_object: KnownObject) -> None:
    views = [
        MaskedView(view.camera, np.roll(view.mask, 70 if number % 2 else -70, axis=1))
        for number, view in enumerate(views_of(known_object))
    ]
    found = find_proxy_surface(known_object.splats, views, SETTINGS)
    assert found.source == CONVEX
    assert found.mesh.is_volume
    assert chamfer(found.mesh, known_object.mesh.convex_hull) < 0.02
    assert len(found.faults) == 3
    told = replace(GOOD, surface=found.source, surface_faults=found.faults).misses()
    assert len(told) == 1
    assert told[0].startswith("the mesh is only the convex hull of the splats, because the depth of the splats")


def test_the_hull_of_splats_ends_at_the_floor(known_object: KnownObject) -> None:
    views = [MaskedView(view.camera, np.zeros_like(view.mask)) for view in views_of(known_object)]
    found = find_proxy_surface(known_object.splats, views, SETTINGS, floor=-0.03)
    assert found.source == CONVEX
    assert found.mesh.bounds[0, 2] == pytest.approx(-0.03)


def test_masks_do_not_cut_parts_that_may_be_hidden(known_object: KnownObject) -> None:
    """A third of each image is occluded.

    As background, it would cut the object, and so would the hull of masks alone.
    """
    veil = np.zeros(views_of(known_object)[0].mask.shape, dtype=np.float32)
    veil[:, : veil.shape[1] // 2] = 1
    given = views_of(known_object)
    views = [MaskedView(v.camera, v.mask * (1 - veil), veil if k % 3 == 0 else None) for k, v in enumerate(given)]
    views = [view if view.hidden is not None else given[k] for k, view in enumerate(views)]
    found = find_proxy_surface(known_object.splats, views, SETTINGS)
    assert (found.source, found.faults) == (FINEST, ())
    assert chamfer(found.mesh, known_object.mesh) < 0.005
    kept = isolate_object(known_object.splats, views)
    assert kept.kept.mean() > 0.97 * isolate_object(known_object.splats, given).kept.mean()
    blind = [replace(view, hidden=None) for view in views]
    assert isolate_object(known_object.splats, blind).lost < 0.2
    cut = find_proxy_surface(known_object.splats, blind, SETTINGS)
    assert cut.source != FINEST or chamfer(cut.mesh, known_object.mesh) > 0.02


def test_splats_without_volume_are_refused(known_object: KnownObject) -> None:
    views = [MaskedView(view.camera, np.zeros_like(view.mask)) for view in views_of(known_object)]
    flat = known_object.splats.means * (1, 1, 0)
    splats: Splats = replace(known_object.splats, means=flat)
    with pytest.raises(InputError, match=r"must span a volume \(got 3\d+ on a point"):
        find_proxy_surface(splats, views, SETTINGS)
