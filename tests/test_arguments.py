"""Arguments of the wrong type: public methods of public classes answer with one sentence, without a foreign error."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, get_type_hints

import numpy as np
import pytest

import mitsplat as ms
from mitsplat.arguments import checks_arguments
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.labels.labels import Labels
from mitsplat.scene.layout import Layout

CAMERA = Camera.look_at((0, -1, 1), (0, 0, 0), width=64, height=48, fov_x=40)
IMAGE = np.zeros((48, 64, 3), np.uint8)
SPLATS = Splats(
    means=np.zeros((5, 3)),
    quats=np.tile([0.0, 0, 0, 1], (5, 1)),
    scales=np.full((5, 3), 0.1),
    opacities=np.full(5, 0.5),
    sh=np.zeros((5, 1, 3)),
)
STORED = CAMERA.to_json()


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (
            lambda: Camera.from_json({}),
            r"Camera\.from_json needs the values of to_json: the key 'intrinsics' is missing",
        ),
        (lambda: Camera.from_json("camera.json"), r"stored must be a dict \(got str 'camera\.json'\)"),
        (lambda: Camera.from_json(None), r"stored must be a dict \(got NoneType None\)"),
        (lambda: Camera.from_json({**STORED, "intrinsics": None}), r"intrinsics must have shape \(3, 3\)"),
        (lambda: Camera.from_json({**STORED, "intrinsics": [[1, 0], [0, 1]]}), r"intrinsics must have shape \(3, 3\)"),
        (
            lambda: Camera.from_json({**STORED, "intrinsics": [[90, 0, 32], [0, 90]]}),
            r"intrinsics must have shape \(3, 3\)",
        ),
        (lambda: Camera.from_json({**STORED, "intrinsics": [[90, 2, 32], [0, 90, 24], [0, 0, 1]]}), "with a skew"),
        (lambda: Camera.from_json({**STORED, "intrinsics": [[90, 0, 0], [0, 90, 0], [32, 24, 1]]}), "have the form"),
        (lambda: Camera.from_json({**STORED, "distortion": None}), "needs the values of to_json"),
        (lambda: Layout.from_json({}), r"Layout\.from_json .* the key 'index' is missing"),
        (lambda: Layout.from_json([]), r"stored must be a dict \(got list \[\]\)"),
        (lambda: Labels.from_json({}), r"Labels\.from_json .* the key 'size' is missing"),
        (lambda: CAMERA.resized("a", 5), r"width must be a whole number \(got str 'a'\)"),
        (lambda: CAMERA.resized(32, 24.5), r"height must be a whole number \(got float 24\.5\)"),
        (lambda: CAMERA.fitted(None), r"size must be a number \(got NoneType None\)"),
        (lambda: CAMERA.fitted(-5), r"size must be > 0 \(got -5\)"),
        (lambda: CAMERA.fitted(float("nan")), r"size must be > 0 \(got nan\)"),
        (lambda: CAMERA.cropped(0.5, 0, 8, 8), r"left must be a whole number \(got float 0\.5\)"),
        (lambda: CAMERA.transformed("x"), r"matrix must be an array of numbers \(got str 'x'\)"),
        (lambda: CAMERA.transformed(np.diag([-1, 1, 1, 1])), "must neither mirror nor flatten"),
        (lambda: CAMERA.transformed(np.diag([0, 0, 0, 1])), "must neither mirror nor flatten"),
        (lambda: CAMERA.project({}), "points must be an array of numbers"),
        (lambda: CAMERA.project([[0, 0], [1]]), "points must be an array of numbers"),
        (lambda: CAMERA.ray_slopes(np.zeros((2, 3))), r"pixels must have shape \(N, 2\) \(got \(2, 3\)\)"),
        (lambda: CAMERA.rays([[1, 2, 3]]), r"pixels must have shape \(N, 2\) \(got \(1, 3\)\)"),
        (lambda: CAMERA.unproject([(1, 2)], "x"), r"depth must be an array of numbers \(got str 'x'\)"),
        (lambda: CAMERA.unproject([(1, 2)], [1, 2]), r"one value for each pixel \(got 2 for 1 pixels\)"),
        (lambda: CAMERA.undistorted("x"), r"image must be an array \(got str 'x'\)"),
        (lambda: CAMERA.undistorted(None), r"image must be an array \(got NoneType None\)"),
        (lambda: CAMERA.undistorted(IMAGE[:4]), r"the size of the camera, 64x48 px \(got 64x4\)"),
        (lambda: CAMERA.undistorted(IMAGE.astype(float)), r"image must have 8 bits .* \(got float64"),
        (lambda: CAMERA.sample(IMAGE[:, :4, 0], np.zeros((1, 3)), 0.0), r"64x48 px \(got 4x48\)"),
        (lambda: SPLATS.select("a"), r"index must be a mask, whole numbers or a slice \(got str 'a'\)"),
        (lambda: SPLATS.select([0.5]), "index must be a mask, whole numbers or a slice"),
        (lambda: SPLATS.select([5]), r"index must be in 0 to 4 \(got 5 to 5\)"),
        (lambda: SPLATS.select(np.ones(4, bool)), r"a mask must have shape \(5,\) \(got \(4,\)\)"),
        (lambda: SPLATS.transformed(None), "matrix must be an array of numbers"),
        (lambda: Splats.concatenate("x"), r"parts must be a list \(got str 'x'\)"),
        (lambda: Splats.concatenate([SPLATS, None]), r"parts\[1\] must be a Splats \(got NoneType None\)"),
        (lambda: ms.Capture.load(None), r"folder must be a path \(got NoneType None\)"),
    ],
)
def test_wrong_arguments_of_methods_are_refused_in_one_sentence(call: Callable[[], Any], sentence: str) -> None:
    """`Camera.undistorted(None)` ended the process before, and other sizes of images gave empty pictures."""
    with pytest.raises(InputError, match=sentence):
        call()


def test_right_arguments_pass_the_check() -> None:
    assert CAMERA.resized(np.int64(32), 24).width == 32 and CAMERA.fitted(np.float32(32)).width == 32
    assert Camera.from_json(STORED).to_json() == STORED
    assert len(SPLATS.select([])) == 0 and len(SPLATS.select([-1, 0])) == 2 and len(SPLATS.select(slice(1, 3))) == 2
    assert len(Splats.concatenate((SPLATS, SPLATS))) == 10
    assert CAMERA.undistorted(IMAGE[..., 0])[0].shape == (48, 64)
    assert CAMERA.ray_slopes((32, 24)).shape == (1, 2)


@pytest.mark.parametrize("name", ["Asset", "Camera", "Capture", "Labels", "Layout", "Scene", "Splats"])
def test_annotations_of_checked_methods_can_be_read(name: str) -> None:
    kind = getattr(ms, name)
    methods = [one for key, one in inspect.getmembers(kind, callable) if not key.startswith("_")]
    checked = [one for one in methods if hasattr(one, "__wrapped__")]
    assert checked and all(get_type_hints(inspect.unwrap(one)) for one in checked)


def test_python_names_arguments_that_are_missing() -> None:
    @checks_arguments
    class Part:
        def turned(self, angle: float, *, axis: str = "z") -> float:
            return angle

        def from_json(self) -> None:
            raise ValueError("own sentence")

    with pytest.raises(TypeError, match="missing 1 required positional argument: 'angle'"):
        Part().turned()  # type: ignore[call-arg]
    with pytest.raises(InputError, match=r"axis must be text \(got int 5\)"):
        Part().turned(1, axis=5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="own sentence"):
        Part().from_json()


def test_annotations_of_all_forms_are_checked_by_their_meaning() -> None:
    @checks_arguments
    class Part:
        def named(self, name: Any, side: Literal["left", "right"] = "left") -> object:
            return name

        def moved(self, steps: Sequence[float], limit: int | None = None) -> int:
            return len(steps)

    part = Part()
    assert part.named(5) == 5 and part.moved([1, np.float32(2)]) == 2 and part.moved((), 3) == 0
    with pytest.raises(InputError, match=r"steps\[1\] must be a number \(got str 'a'\)"):
        part.moved([1, "a"])  # type: ignore[list-item]
    with pytest.raises(InputError, match=r"limit must be a whole number or None \(got float 1\.5\)"):
        part.moved([], 1.5)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="side must be left or right"):
        part.named(5, np.zeros(2))  # type: ignore[arg-type]


MASKED = np.ma.masked_array(np.eye(4), mask=np.eye(4) > 0)
"""Matrix with masked values, which NumPy replaces by those below the mask."""


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: replace(CAMERA, world_from_camera=MASKED), r"must be a finite 4x4 matrix .*\(got masked_array"),
        (lambda: replace(CAMERA, world_from_camera=np.eye(4) + 0j), r"must be a finite 4x4 matrix"),
        (lambda: replace(CAMERA, distortion=np.ma.masked_array([0.1, 0, 0, 0], mask=[1, 0, 0, 0])), "no masked coeff"),
        (lambda: replace(CAMERA, fx=True), r"fx must be a number \(got bool True\)"),
        (lambda: CAMERA.project(MASKED[:, :3]), "points must be an array of numbers"),
        (lambda: SPLATS.transformed(MASKED), "must be an array of numbers"),
        (lambda: SPLATS.select(np.ma.masked_array(np.ones(5, bool), mask=np.arange(5) > 2)), "no masked values"),
        (
            lambda: replace(SPLATS, means=np.ma.masked_array(np.zeros((5, 3)), mask=True)),
            "means must be an array of num",
        ),
        (lambda: replace(SPLATS, means=np.zeros((5, 3), complex)), "means must be an array of numbers"),
        (lambda: replace(SPLATS, means=np.zeros((5, 3), "datetime64[s]")), "means must be an array of numbers"),
    ],
)
def test_masked_and_complex_arrays_are_refused(call: Callable[[], Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        call()


def test_numbers_of_few_bits_do_not_overflow_in_a_camera() -> None:
    """Twice the width of 200 px was 144 px, and products of both sides were wrong."""
    small = Camera(np.uint8(200), np.uint8(150), np.float16(90), np.float32(90), np.int8(100), 75, np.eye(4))
    assert (small.width * small.height, type(small.width), type(small.fx)) == (30000, int, float)
    assert Camera.from_json(small.to_json()).to_json() == small.to_json()
    masked = np.ma.masked_array(np.eye(4))  # without masked values
    assert replace(small, world_from_camera=masked).to_json() == small.to_json()
