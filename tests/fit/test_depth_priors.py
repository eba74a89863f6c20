"""Depth maps of photos: reading, alignment with the points of a capture, and use in a fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mitsplat.capture.capture import Photo
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.fit.depth_network import DepthNetwork, model_maps
from mitsplat.fit.depth_priors import (
    DepthKind,
    DepthMaps,
    align_map,
    align_maps,
    find_maps,
    fit_line,
    read_map,
    resize_map,
)
from mitsplat.geometry.camera import Camera

WIDTH, HEIGHT = 64, 48
CAMERA = Camera.look_at((0, -2, 1), (0, 0, 0), width=WIDTH, height=HEIGHT, fov_x=50)


def floor_depth(camera: Camera, width: int, height: int) -> np.ndarray:
    """Return the depths of the plane z = 0 at the pixel centres, (H, W)."""
    rows, columns = np.mgrid[:height, :width] + 0.5
    slopes = camera.ray_slopes(np.stack([columns * camera.width / width, rows * camera.height / height], axis=-1))
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ camera.world_from_camera[:3, :3].T
    return (-camera.centre[2] / rays[:, 2]).reshape(height, width)


def seeing(count: int = 60) -> tuple[Photo, np.ndarray]:
    """Return a photo, and 100 points of the floor of which the photo sees the first ``count``."""
    points = np.column_stack([np.random.default_rng(0).uniform(-0.4, 0.4, (100, 2)), np.zeros(100)])
    return Photo("a/floor.jpg", Path("floor.jpg"), CAMERA, seen=np.arange(count, dtype=np.int32)), points


@pytest.mark.parametrize("shift", [True, False])
def test_a_line_is_fitted_with_a_third_of_outliers(shift: bool) -> None:
    rng = np.random.default_rng(1)
    values = rng.uniform(1, 3, 90)
    wanted = 0.4 * values + 0.2 * shift + rng.normal(0, 1e-3, 90)
    wanted[:30] += rng.uniform(0.5, 5, 30)
    scale, offset = fit_line(values, wanted, shift=shift)
    assert scale == pytest.approx(0.4, abs=2e-3) and offset == pytest.approx(0.2 * shift, abs=4e-3)
    # An ordinary least-squares fit is biased by the outliers.
    assert abs(np.polyfit(values, wanted, 1)[1] - 0.2 * shift) > 0.1


def test_a_line_is_fitted_to_exact_values_and_is_flat_for_equal_ones() -> None:
    values = np.array([1.0, 2, 4, 8])
    assert fit_line(values, 3 * values - 1, shift=True) == pytest.approx((3, -1))
    assert fit_line(np.full(9, 2.0), np.arange(9.0), shift=True)[0] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("kind", ["inverse", "metric"])
@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (256, 192), (32, 24)])
def test_maps_are_aligned_with_the_depths_of_points(kind: DepthKind, size: tuple[int, int]) -> None:
    """The map may have any size and scale, and an inverse map any shift."""
    photo, points = seeing()
    truth = floor_depth(CAMERA, *size)
    values = (7 / truth - 2 if kind == "inverse" else 1000 * truth).astype(np.float32)
    if kind == "metric":
        values[0, 0] = 0
    found = align_map(photo, points, values, kind)
    assert not isinstance(found, str)
    known = np.isfinite(found)
    assert known.sum() == known.size - (kind == "metric")
    np.testing.assert_allclose(found[known], 1 / truth[known], rtol=1e-4)


def test_infinite_distance_gives_no_negative_inverse_depth() -> None:
    photo, points = seeing()
    values = (1 / floor_depth(CAMERA, WIDTH, HEIGHT)).astype(np.float32)
    values[0] = -9
    found = align_map(photo, points, values, "inverse")
    assert not isinstance(found, str) and (found[0] == 0).all() and found.min() == 0


def test_maps_without_information_are_omitted_by_name() -> None:
    truth = floor_depth(CAMERA, WIDTH, HEIGHT).astype(np.float32)
    photo, points = seeing()
    for count in (0, 9):
        few, _ = seeing(count)
        assert align_map(few, points, 1 / truth, "inverse") == "fewer than 10 of the capture's points are in them"
    for values in (truth, np.ones_like(truth)):  # depth instead of inverse depth, and a constant map
        assert align_map(photo, points, values, "inverse") == (
            "their values as inverse depths do not agree with the points in them"
        )
    noise = np.random.default_rng(0).uniform(1, 2, truth.shape).astype(np.float32)
    for values in (1 / truth, noise):  # inverse depth instead of depth
        assert align_map(photo, points, values, "metric") == (
            "their values as metric depths do not agree with the points in them"
        )


def test_all_maps_of_a_capture_are_aligned(tmp_path: Path) -> None:
    photo, points = seeing()
    (tmp_path / "a").mkdir()
    np.save(tmp_path / "a/floor.npy", 1 / floor_depth(CAMERA, WIDTH, HEIGHT))
    np.save(tmp_path / "b.npy", floor_depth(CAMERA, WIDTH, HEIGHT))
    photos = [photo, *(replace(photo, name=name) for name in ("b.jpg", "c.jpg", "d.jpg"))]
    maps = find_maps(tmp_path, photos)
    assert maps == DepthMaps({"a/floor.jpg": tmp_path / "a/floor.npy", "b.jpg": tmp_path / "b.npy"}, "inverse")
    found, warnings = align_maps(photos, points, maps, 32)
    assert list(found) == ["a/floor.jpg"] and found["a/floor.jpg"].shape == (24, 32)
    assert warnings == (
        "depth maps that are not used, because their values as inverse depths do not agree with the points in them: "
        "b.jpg",
        "photos without a depth map: c.jpg, d.jpg",
    )


def test_maps_are_found_by_the_file_names_of_the_capture(tmp_path: Path) -> None:
    photo = replace(seeing()[0], file=Path("images/a__floor.jpg"))
    (tmp_path / "a__floor.tif").touch()
    assert find_maps(tmp_path, [photo], "metric") == DepthMaps({photo.name: tmp_path / "a__floor.tif"}, "metric")


def test_maps_of_the_other_kind_are_refused(tmp_path: Path) -> None:
    photo, points = seeing()
    np.save(tmp_path / "a.npy", floor_depth(CAMERA, WIDTH, HEIGHT))
    maps = DepthMaps({photo.name: tmp_path / "a.npy"}, "inverse")
    with pytest.raises(
        InputError, match=r"no depth map can be used: .* as inverse depths do not agree .*: a/floor\.jpg"
    ):
        align_maps([photo], points, maps, 64)
    assert list(align_maps([photo], points, replace(maps, kind="metric"), 64)[0]) == [photo.name]


def test_folders_without_maps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="gone: no such folder of depth maps"):
        find_maps(tmp_path / "gone", [seeing()[0]])
    with pytest.raises(InputError, match=r"of at least one photo, such as a/floor\.png \(got none\)"):
        find_maps(tmp_path, [seeing()[0]])


def test_every_format_gives_the_same_values(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 2**16, (4, 5)).astype(np.float32)
    Image.fromarray(values.astype(np.uint16)).save(tmp_path / "a.png")
    Image.fromarray(values).save(tmp_path / "a.tiff")
    np.save(tmp_path / "a.npy", values.astype(np.float64))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, channels in (("a.exr", {"Y": values}), ("z.exr", {"R": values + 1, "Z": values})):
        with OpenEXR.File(header, channels) as file:
            file.write(str(tmp_path / name))
    for name in ("a.png", "a.tiff", "a.npy", "a.exr", "z.exr"):
        np.testing.assert_array_equal(read_map(tmp_path / name), values, err_msg=name)


def test_files_that_are_not_maps_are_refused_in_one_sentence(tmp_path: Path) -> None:
    for suffix in ("png", "npy", "exr", "tiff"):
        path = tmp_path / f"bad.{suffix}"
        path.write_bytes(b"nothing")
        with pytest.raises(InputError, match=rf"bad\.{suffix}: not a readable depth map"):
            read_map(path)
        with pytest.raises(InputError, match="no such file"):
            read_map(tmp_path / f"gone.{suffix}")
    Image.fromarray(np.zeros((4, 5, 3), np.uint8)).save(tmp_path / "rgb.png")
    with pytest.raises(InputError, match=r"rgb\.png: a depth map must have one channel.* \(got shape \(4, 5, 3\)\)"):
        read_map(tmp_path / "rgb.png")
    np.save(tmp_path / "holes.npy", np.array([[1, np.nan], [1e99, 2]]))
    with pytest.raises(InputError, match=r"holes\.npy: depths must be finite \(got 2 others\)"):
        read_map(tmp_path / "holes.npy")


@pytest.mark.parametrize(
    ("values", "kind", "text"),
    [
        (np.ones((48, 48)), "inverse", r"a\.npy: must have the shape of its photo, 64x48 px \(got 48x48\)"),
        (np.full((48, 64), -1.0), "metric", r"a\.npy: depths must be >= 0 \(got -1\)"),
    ],
)
def test_maps_that_do_not_fit_their_photo_are_refused(
    values: np.ndarray, kind: DepthKind, text: str, tmp_path: Path
) -> None:
    photo, points = seeing()
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(InputError, match=text):
        align_maps([photo], points, DepthMaps({photo.name: tmp_path / "a.npy"}, kind), 64)


def test_resized_maps_ignore_unknown_pixels() -> None:
    values = np.full((4, 6), 2, np.float32)
    values[:, 0] = values[:2, 2:4] = np.nan
    half = resize_map(values, 3, 2)
    np.testing.assert_array_equal(half, [[2, np.nan, 2], [2, 2, 2]])
    assert resize_map(values, 6, 4) is values
    assert np.nanmax(resize_map(values, 12, 8)) == 2 == np.nanmin(resize_map(values, 12, 8))


class Session:
    """Mock of an onnxruntime session with a network that returns the red channel."""

    def __init__(self, shape: list[Any], output: Any = None, kind: str = "tensor(float)") -> None:
        self.shape, self.output, self.kind = shape, output, kind
        self.given: list[np.ndarray] = []

    def get_inputs(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(name="image", shape=self.shape, type=self.kind)]

    def run(self, names: None, inputs: dict[str, np.ndarray]) -> list[Any]:
        self.given.append(inputs["image"])
        return [inputs["image"][:, 0] if self.output is None else self.output]


def ramp(height: int, width: int) -> np.ndarray:
    """Return an image whose red value grows to the right."""
    picture = np.full((height, width, 3), 0.25, np.float32)
    picture[..., 0] = (np.arange(width) + 0.5) / width
    return picture


@pytest.mark.parametrize(
    ("shape", "kind", "seen", "kept"),
    [
        ([1, 3, "height", "width"], "tensor(float)", (518, 686), (300, 400)),
        (["batch", 3, 28, 42], "tensor(float)", (28, 42), (32, 42)),
        ([1, 3, None, None], "tensor(float16)", (518, 686), (300, 400)),
    ],
)
def test_the_network_gets_a_normalised_picture_of_its_size(
    shape: list[Any], kind: str, seen: tuple[int, int], kept: tuple[int, int]
) -> None:
    """Values are normalised as in ImageNet, edges are multiples of 14, and the map has the photo's aspect ratio."""
    session = Session(shape, kind=kind)
    found = DepthNetwork(session, Path("any.onnx")).depths(ramp(300, 400))
    (given,) = session.given
    assert given.shape == (1, 3, *seen) and given.dtype == (np.float16 if "16" in kind else np.float32)
    np.testing.assert_allclose(given[0, :, seen[0] // 2, seen[1] // 2 - 1], [0.0, -0.92, -0.69], atol=0.1)
    np.testing.assert_allclose(given[0, 1], (0.25 - 0.456) / 0.224, rtol=2e-3)
    assert found.shape == kept
    expected = ((np.arange(kept[1]) + 0.5) / kept[1] - 0.485) / 0.229
    np.testing.assert_allclose(found[5, 3:-3], expected[3:-3], atol=0.01)


@pytest.mark.parametrize(
    ("shape", "output", "text"),
    [
        ([1, 1, 28, 28], None, r"any\.onnx: must take one picture of floats, .* \(got image: tensor\(float\) \[1, 1"),
        ([1, 28], None, "must take one picture of floats"),
        ([1, 3, 28, 28], np.zeros((1, 1000)), r"one finite number per pixel, .* \(got shape \(1, 1000\), 0 not"),
        ([1, 3, 28, 28], np.zeros((1, 3, 28, 28)), r"got shape \(1, 3, 28, 28\)"),
        ([1, 3, 28, 28], np.full((1, 28, 28), np.nan), "784 not finite"),
    ],
)
def test_networks_of_another_kind_are_refused(shape: list[Any], output: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        DepthNetwork(Session(shape, output), Path("any.onnx")).depths(ramp(30, 40))


@pytest.fixture
def photo(tmp_path: Path) -> Photo:
    Image.fromarray(np.rint(255 * ramp(HEIGHT, WIDTH)).astype(np.uint8)).save(tmp_path / "a.png")
    return Photo("a.png", tmp_path / "a.png", CAMERA)


def test_maps_are_reused_until_photo_or_network_change(
    photo: Photo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, session = tmp_path / "any.onnx", Session([1, 3, 28, 42])
    model.write_bytes(b"weights")
    monkeypatch.setattr("mitsplat.fit.depth_network.open_session", lambda path: session)
    steps: list[tuple[int, int, str]] = []
    first = model_maps([photo], model, tmp_path / "maps", "metric", progress=lambda *step: steps.append(step))
    assert first.kind == "metric" and read_map(first.files["a.png"]).shape == (32, 42) and steps == [(1, 1, "depths")]
    assert model_maps([photo], model, tmp_path / "maps", "metric") == first and len(session.given) == 1
    model.write_bytes(b"other weights")
    assert model_maps([photo], model, tmp_path / "maps") != first and len(session.given) == 2
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(photo.file)
    model_maps([replace(photo)], model, tmp_path / "maps")  # a new object, as in the next run, hashes the file again
    assert len(session.given) == 3


def test_a_network_file_is_run_by_onnxruntime(photo: Photo, tmp_path: Path) -> None:
    """The network is a convolution that returns the red channel."""
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    helper, floats = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "weight"], ["depth"])],
        "red",
        [helper.make_tensor_value_info("image", floats, [1, 3, "height", "width"])],
        [helper.make_tensor_value_info("depth", floats, [1, 1, "height", "width"])],
        [helper.make_tensor("weight", floats, [1, 3, 1, 1], [0.229, 0, 0])],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, tmp_path / "red.onnx")
    found = read_map(model_maps([photo], tmp_path / "red.onnx", tmp_path / "maps").files["a.png"])
    np.testing.assert_allclose(found, ramp(HEIGHT, WIDTH)[..., 0] - 0.485, atol=0.01)
    (tmp_path / "bad.onnx").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"bad\.onnx: not a network in ONNX"):
        model_maps([photo], tmp_path / "bad.onnx", tmp_path / "maps")


def test_missing_files_and_libraries_of_a_network_are_named(
    photo: Photo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=r"gone\.onnx: no such file"):
        model_maps([photo], tmp_path / "gone.onnx", tmp_path)
    (tmp_path / "any.onnx").write_bytes(b"weights")
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(MissingResourceError, match=r"need onnxruntime: pip install 'mitsplat\[depth\]'"):
        model_maps([photo], tmp_path / "any.onnx", tmp_path)
