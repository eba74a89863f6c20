"""Tile lists: their Gaussians and order."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsplat.geometry.camera import Camera
from mitsplat.quality import PRESETS, PresetName
from mitsplat.renderer.layers import Layers, make_sensor, render_splats
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_render import make_splats

CAMERA = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=75, height=50, fov_x=50)


FISHEYE = {"distortion": (0.02, -0.01, 0.004, -0.001), "lens": "fisheye"}


@pytest.mark.parametrize("lens", [{}, {"distortion": (-0.25, 0.08, 0.002, -0.001, -0.01)}, FISHEYE])
def test_the_box_of_a_tile_holds_the_rays_of_its_pixels(lens: dict[str, Any]) -> None:
    """Without distortion, the box ends at the outermost rays, otherwise at most a pixel beyond them."""
    ensure_variant()
    from mitsplat.renderer.rays.camera_rays import TILE_HEIGHT, TILE_WIDTH
    from mitsplat.renderer.rays.sensors import view_of

    view = view_of(make_sensor(replace(CAMERA, width=80, height=52, **lens)))
    y, x = np.mgrid[:52, :80]
    slopes = [np.array(v).reshape(52, 80) for v in view.slopes(mi.Float(x.ravel() + 0.5), mi.Float(y.ravel() + 0.5))]
    across = 80 // TILE_WIDTH
    box = [np.array(v).reshape(-1, across) for v in view.tile_slopes(dr.arange(mi.UInt32, view.tiles_x * view.tiles_y))]
    reach = 1.5 / CAMERA.fx if lens else 0.0
    for values, low, high in ((slopes[0], *box[:2]), (slopes[1], *box[2:])):
        tiles = values.reshape(-1, TILE_HEIGHT, across, TILE_WIDTH)
        for bound, outermost, sign in ((low, tiles.min(axis=(1, 3)), 1), (high, tiles.max(axis=(1, 3)), -1)):
            beyond = sign * (outermost - bound)
            assert beyond.min() > -1e-6 and beyond.max() <= reach + 1e-6


@pytest.mark.parametrize("lens", [{}, {"distortion": (-0.25, 0.08, 0.002, -0.001, -0.01)}])
def test_entries_ascend_by_depth_and_number_and_have_a_place_by_record(lens: dict[str, tuple[float, ...]]) -> None:
    ensure_variant()
    from mitsplat.renderer.projection.clouds import Placement, merge_clouds, upload_cloud
    from mitsplat.renderer.rays.sensors import view_of
    from mitsplat.renderer.splatting.tiles import bin_gaussians

    splats = make_splats(400, 3)
    cloud = upload_cloud(splats.means, splats.quats, splats.scales, splats.opacities, splats.sh)
    scene = merge_clouds([cloud]), [Placement(0, np.eye(4), 1)]
    view = view_of(make_sensor(replace(CAMERA, **lens)))
    seen, known = (bin_gaussians(*scene, view, PRESETS["fast"], for_gradients=wanted) for wanted in (False, True))
    entries, levels, start, stop = (np.array(values) for values in (seen.entries, seen.levels, seen.start, seen.stop))
    assert seen.slots is None and len(entries) == seen.pairs == (stop - start).sum()
    for first, last in zip(start, stop, strict=True):
        both = levels[first:last].astype(np.int64) << 32 | entries[first:last]
        assert (np.diff(both) > 0).all()
    np.testing.assert_array_equal(np.array(known.entries), entries)
    slots, begins = np.array(known.slots), np.array(known.first)
    np.testing.assert_array_equal(np.sort(slots), np.arange(seen.pairs))
    assert ((begins[entries] <= slots) & (slots < begins[entries + 1])).all()
    assert dr.width(known.first) == seen.visible + 1


def test_sorts_agree_with_numpy() -> None:
    """Several threads agree with one; the stable radix sort of 64-bit keys is the GPU's sort."""
    ensure_variant()
    from mitsplat.renderer.splatting.sorting import sort_in_threads, stable_order

    keys = np.random.default_rng(2).integers(0, 1 << 31, 150_000).astype(np.uint64) // 1000
    for threads in (1, 3, 8):
        found = keys.copy()
        sort_in_threads(found, threads)
        np.testing.assert_array_equal(found, np.sort(keys))
    order = np.array(stable_order(mi.UInt64(keys), 31))
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))


@pytest.mark.parametrize(
    ("processor", "slow"),
    [
        ("vendor_id\t: AuthenticAMD\ncpu family\t: 25\nflags\t: sse avx2 avx512f avx512dq\n", True),
        ("vendor_id\t: AuthenticAMD\ncpu family\t: 25\nflags\t: sse avx2 sha_ni\n", False),  # Zen 3
        ("vendor_id\t: AuthenticAMD\ncpu family\t: 26\nflags\t: sse avx2 avx512f avx512dq\n", False),  # Zen 5
        ("vendor_id\t: GenuineIntel\ncpu family\t: 6\nflags\t: sse avx2 avx512f avx512dq\n", False),
        (None, False),  # not Linux
    ],
)
def test_processors_on_which_numpy_sorts_slowly_are_known(
    processor: str | None, slow: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mitsplat.renderer.splatting import sorting

    if processor is not None:
        (tmp_path / "cpuinfo").write_text(f"processor\t: 0\n{processor}\nprocessor\t: 1\n{processor}")
    monkeypatch.setattr(sorting, "CPUINFO", tmp_path / "cpuinfo")
    assert sorting.numpy_sorts_slowly.__wrapped__() is slow


def test_both_sorts_give_the_same_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    from mitsplat.renderer.splatting import tiles

    splats, found = make_splats(3000, 5), []
    for slow in (False, True):
        monkeypatch.setattr(tiles, "numpy_sorts_slowly", lambda slow=slow: slow)
        found.append(render_splats(splats, CAMERA.resized(64, 48), quality=PRESETS["fast"]))
    for name in ("rgb", "alpha", "depth", "instance"):
        np.testing.assert_array_equal(getattr(found[0], name), getattr(found[1], name))


@pytest.mark.parametrize("preset", ["fast", "balanced", "exact"])
@pytest.mark.parametrize("lens", [{}, {"distortion": (-0.25, 0.08, 0.002, -0.001, -0.01)}])
def test_projection_and_walk_of_both_devices_give_the_same_images(
    preset: PresetName, lens: dict[str, tuple[float, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compares all Gaussians with one ray per lane, as on a GPU, to visible ones with four.

    Includes a camera among the Gaussians, with some near its plane.
    """
    from mitsplat.renderer.splatting import march, tiles
    from mitsplat.renderer.splatting.lanes import rows_together

    quality = replace(PRESETS[preset], kernel="mip")
    cameras = [replace(Camera.look_at((0, 0, z), (0, 0, z + 1), up=(0, -1, 0), width=75, height=50, fov_x=50), **lens)
               for z in (-2, 0, 9)]  # before the splats, among them, and with all of them behind it  # fmt: skip
    found: list[list[Layers]] = []
    for at_once, rows in ((False, 4), (True, 1)):
        monkeypatch.setattr(tiles, "_skips_culling", lambda _, at_once=at_once: at_once)
        monkeypatch.setattr(march, "rows_together", lambda order, rows=rows: rows if order == "tile" else 1)
        found.append([render_splats(make_splats(700, 8), camera, quality=quality) for camera in cameras])
    rounding = 5e-6 if mi.variant() == "cuda_ad_rgb" else 0.0  # a GPU branch rounds by its number of rays
    for seen, again in zip(*found, strict=True):
        for name in ("rgb", "alpha", "depth", "instance"):
            np.testing.assert_allclose(getattr(seen, name), getattr(again, name), rtol=rounding, atol=0, err_msg=name)
    assert [bool(layers.alpha.any()) for layers in found[0]] == [True, True, False]
    assert rows_together("ray") == rows_together("window") == 1
