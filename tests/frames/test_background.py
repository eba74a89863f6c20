"""Background images: crop, rotation and pixel coverage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mitsplat as ms
from mitsplat.frames.background import crop_background
from mitsplat.images.colour import decode_srgb
from mitsplat.scene.layout import NO_PHYSICS, Layout
from mitsplat.scene.planning.layout_surroundings import BackgroundDraw, draw_surroundings
from tests.conftest import WriteScene, box_asset


def backing(**values: Any) -> BackgroundDraw:
    return BackgroundDraw(**{"image": "a", "crop": 1.0, "place": (0.5, 0.5), "rotate": 0.0, "gain": 1.0, **values})


def ramp(width: int, height: int) -> np.ndarray:
    """Return an image whose red and green encode the pixel centre's x and y as fractions of width and height."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return np.asarray(np.rint(255 * np.stack([x, y, 0 * x], axis=2)), dtype=np.uint8)


def test_an_image_of_the_same_size_is_shown_unchanged() -> None:
    image = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    np.testing.assert_allclose(crop_background(image, backing(), 40, 30), decode_srgb(image / 255), atol=1e-6)


def test_a_larger_image_is_averaged() -> None:
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    means = decode_srgb(image / 255).reshape(30, 4, 40, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(crop_background(image, backing(), 40, 30), means, atol=1e-5)


@pytest.mark.parametrize("angle", [-170.0, -40.0, 0.0, 12.0, 90.0])
@pytest.mark.parametrize("size", [(400, 300), (250, 600), (60, 50)])
@pytest.mark.parametrize(("crop", "place"), [(1.0, (0.5, 0.5)), (0.4, (0.0, 1.0)), (0.4, (0.7, 0.2))])
def test_the_shown_part_of_an_image_is_that_of_its_draw(
    angle: float, size: tuple[int, int], crop: float, place: tuple[float, float]
) -> None:
    """The crop is a rotated rectangle with the picture's aspect ratio inside the image.

    The colours of the ramp give the source position of every pixel.
    """
    width, height = 80, 60
    colours = crop_background(ramp(*size), backing(rotate=angle, crop=crop, place=place), width, height)
    from mitsplat.images.colour import encode_srgb

    shown = encode_srgb(colours)[..., :2] * size
    rounding = np.array(size) / 255 + 0.5
    assert (shown > -rounding).all() and (shown < size + rounding).all()
    turn = np.radians(angle)
    right, down = (np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))
    bounds = np.abs([right, [right[1], right[0]]]) @ (width, height)
    step = crop * (size / bounds).min()
    reach = step * bounds / 2
    middle = reach + place * (size - 2 * reach)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    expected = middle + step * (x[..., None] * right + y[..., None] * down)
    inner = (slice(3, -3), slice(3, -3))  # excludes pixels blended with the image border
    assert np.abs(shown - expected)[inner].max() < rounding.max() + 0.01 * max(size)


def test_a_background_is_seen_in_empty_pixels_and_changes_no_label(
    scene_data: dict[str, Any], write_scene: WriteScene, tmp_path: Path
) -> None:
    scene_data["shapes"][0]["box"]["size"] = [0.4, 0.4, 0.1]
    scene_data |= {"objects": [], "composite": {"exposure": "fixed"}, "lights": [{"kind": "environment"}]}
    layout = Layout(0, (), NO_PHYSICS)
    plain = ms.render_frame(ms.load_scene(write_scene(scene_data)), 0, layout=layout)
    cv2.imwrite(str(tmp_path / "red.png"), np.full((30, 40, 3), (0, 0, 200), dtype=np.uint8))
    scene_data["background"] = {"images": "red.png"}
    scene = ms.load_scene(write_scene(scene_data))
    frame = ms.render_frame(scene, 0, layout=layout)
    drawn = draw_surroundings(scene.spec, 0).background
    assert drawn is not None
    empty = frame.layers.alpha == 0
    assert 0.1 < empty.mean() < 0.9
    red = np.array([drawn.gain * decode_srgb(200 / 255), 0, 0])
    np.testing.assert_allclose(frame.rgb[empty], np.tile(red, (empty.sum(), 1)), 1e-5)
    full = frame.layers.alpha == 1
    assert 0.1 < full.mean() < 0.9
    np.testing.assert_array_equal(frame.image[full], plain.image[full])
    border = ~empty & ~full  # antialiased silhouettes: some rays of the pixel miss all surfaces
    assert 0 < border.mean() < 0.1
    through = 1 - frame.layers.alpha[border][:, None]
    np.testing.assert_allclose(frame.rgb[border], frame.layers.rgb[border] + through * red, atol=1e-6)
    for name in ("rgb", "alpha", "depth", "instance", "normal", "proxy_depth"):
        np.testing.assert_array_equal(getattr(frame.layers, name), getattr(plain.layers, name))


ORANGE = [1.0, 0.6, 0.2]
GREY = {"images": "grey.png"}


def picture_with_background(
    data: dict[str, Any], write_scene: WriteScene, radiance: float, composite: dict[str, Any]
) -> tuple[np.ndarray, ms.Frame]:
    """Render a small table before a grey photograph under an orange sky, and return the factor of the photograph."""
    data["shapes"][0]["box"]["size"] = [0.4, 0.4, 0.1]
    data["lights"] = [{"kind": "environment", "radiance": radiance, "colour": ORANGE}] if radiance else []
    data |= {"objects": [], "background": GREY, "composite": composite}
    path = write_scene(data)
    cv2.imwrite(str(path.parent / "grey.png"), np.full((48, 64, 3), 150, dtype=np.uint8))
    scene = ms.load_scene(path)
    drawn = draw_surroundings(scene.spec, 0).background
    assert drawn is not None
    frame = ms.render_frame(scene, 0, layout=Layout(0, (), NO_PHYSICS))
    empty = frame.layers.alpha == 0
    assert 0.1 < empty.mean() < 0.9
    return frame.rgb[empty] / (drawn.gain * decode_srgb(150 / 255)), frame


@pytest.mark.parametrize("radiance", [0.15, 60.0])
def test_a_background_is_lit_as_a_surface_at_the_reference_point(
    scene_data: dict[str, Any], write_scene: WriteScene, radiance: float
) -> None:
    """A white surface under a sky of radiance L has radiance L."""
    factor, _ = picture_with_background(scene_data, write_scene, radiance, {"exposure": "fixed"})
    np.testing.assert_allclose(factor, np.broadcast_to(radiance * np.array(ORANGE), factor.shape), rtol=1e-3)


def test_exposure_and_white_balance_treat_the_background_as_the_surfaces_before_it(
    scene_data: dict[str, Any], write_scene: WriteScene
) -> None:
    composite = {"white_balance": "auto"}
    images = [picture_with_background(scene_data, write_scene, value, composite)[1] for value in (0.02, 200.0)]
    assert np.abs(images[0].image.astype(int) - images[1].image).max() <= 1
    empty = images[0].image[images[0].layers.alpha == 0].astype(int)
    assert np.ptp(empty, axis=1).max() <= 1 and 90 < empty.mean() < 160


@pytest.mark.parametrize("case", ["captured surroundings", "no light", "no traced light"])
def test_a_background_keeps_its_values_where_surfaces_keep_theirs(
    scene_data: dict[str, Any], write_scene: WriteScene, case: str
) -> None:
    composite = {"exposure": "fixed", "shadow": "none" if case == "no traced light" else "traced"}
    if case == "captured surroundings":
        scene_data["environment"] = "assets/room"
        room = replace(box_asset("room", (0.1, 0.1, 0.1)), kind="environment", capture_light="scene")
        room.save(write_scene(scene_data).parent / "assets/room")
    radiance = 0.0 if case == "no light" else 8.0
    factor, _ = picture_with_background(scene_data, write_scene, radiance, composite)
    np.testing.assert_allclose(factor, 1, rtol=1e-5)


def test_background_has_the_size_of_each_camera(
    scene_data: dict[str, Any], write_scene: WriteScene, tmp_path: Path
) -> None:
    scene_data["objects"] = []
    cv2.imwrite(str(tmp_path / "ramp.png"), ramp(80, 60)[..., ::-1])
    scene_data["background"] = {"images": "ramp.png"}
    scene, layout = ms.load_scene(write_scene(scene_data)), Layout(0, (), NO_PHYSICS)
    with ms.Renderer(scene) as renderer:
        camera = renderer.render(0, layout=layout).camera.resized(40, 30)
        second = renderer.render(0, layout=layout, camera=camera)
    with ms.Renderer(scene) as renderer:
        alone = renderer.render(0, layout=layout, camera=camera)
    assert second.image.shape == (30, 40, 3)
    np.testing.assert_array_equal(second.rgb, alone.rgb)
