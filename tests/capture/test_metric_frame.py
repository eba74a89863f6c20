"""Scale and vertical of a capture: drawn boards and tags, and models with known ground truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsplat.capture.alignment import target_evidence
from mitsplat.capture.alignment.metric_frame import (
    find_metric_frame,
    find_table,
    vertical_from_cameras,
)
from mitsplat.capture.alignment.target_evidence import fit_similarity
from mitsplat.capture.boards.targets import Board, find_tags
from mitsplat.capture.structure_from_motion import SparseModel
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.triangulation import nearest_point_to_lines, triangulate

BOARD = Board(6, 4, 0.03)
LOST = np.eye(4)
LOST[:3, :3] = 3.7 * Rotation.from_rotvec([0.4, -1.2, 2.0]).as_matrix()
LOST[:3, 3] = (5, -3, 8)
"""Transform from metres to the arbitrary frame of a reconstruction."""


def ring(count: int = 10, *, rolled: bool = False, width: int = 640) -> list[Camera]:
    """Place cameras around the origin, z up [m]; every third may be rolled by 90 degrees."""
    made = []
    for number, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        eye = (0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.2 + 0.1 * (number % 2))
        camera = Camera.look_at(eye, (0.01, 0, 0), width=width, height=width * 3 // 4, fov_x=45)
        if rolled and number % 3 == 0:
            pose = camera.world_from_camera.copy()
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
            camera = replace(camera, world_from_camera=pose)
        made.append(camera)
    return made


def lost(camera: Camera) -> Camera:
    """Transform a camera to the frame of the reconstruction."""
    pose = LOST @ camera.world_from_camera
    pose[:3, :3] /= 3.7
    return replace(camera, world_from_camera=pose)


def model_of(cameras: list[Camera], points: np.ndarray) -> SparseModel:
    seen = np.arange(len(points), dtype=np.int32)
    names = [f"{number:02}.png" for number in range(len(cameras))]
    return SparseModel(
        dict(zip(names, map(lost, cameras), strict=True)),
        points @ LOST[:3, :3].T + LOST[:3, 3],
        np.zeros((len(points), 3), dtype=np.uint8),
        dict.fromkeys(names, seen),
    )


def table_and_thing(seed: int = 0) -> np.ndarray:
    """Sample points on a table, on an object standing on the table, and a few outliers."""
    rng = np.random.default_rng(seed)
    table = np.column_stack([rng.uniform(-0.25, 0.25, (150, 2)), rng.normal(0, 2e-4, 150)])
    thing = rng.uniform((-0.03, -0.02, 0), (0.03, 0.02, 0.08), (900, 3))
    return np.concatenate([table, thing, rng.uniform(-0.3, 0.3, (20, 3)) * (1, 1, 0.3)])


def draw(flat: np.ndarray, per_metre: float, camera: Camera, folder: Path, name: str) -> Path:
    """Draw an image of a picture on the plane z = 0, centred on the origin, with 4x4 samples per pixel."""
    fine = camera.resized(4 * camera.width, 4 * camera.height)
    height, width = flat.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    places = np.column_stack([(corners - (width / 2, height / 2)) * (1, -1) / per_metre, np.zeros(4)])
    pixels, _ = fine.project(places)
    # Pixel centres are at +0.5 here, and at whole numbers in OpenCV.
    homography = cv2.getPerspectiveTransform(np.float32(corners - 0.5), np.float32(pixels - 0.5))
    drawn = cv2.warpPerspective(flat, homography, (fine.width, fine.height), borderValue=150)
    Image.fromarray(cv2.resize(drawn, (camera.width, camera.height), interpolation=cv2.INTER_AREA)).save(folder / name)
    return folder / name


def photos_of_the_board(cameras: list[Camera], folder: Path) -> dict[str, Path]:
    """Draw photos of the board alone, with the names of :func:`model_of`."""
    names = [f"{k:02}.png" for k in range(len(cameras))]
    flat = BOARD.draw(200)
    return {n: draw(flat, 200 / BOARD.square, c, folder, n) for n, c in zip(names, cameras, strict=True)}


def errors(matrix: np.ndarray) -> tuple[float, float, float]:
    """Compute the error of a metric frame: relative scale, tilt [degrees] and height of the table [m]."""
    whole = matrix @ LOST
    scale = float(np.cbrt(np.linalg.det(whole[:3, :3])))
    return scale - 1, float(np.degrees(np.arccos(min(1.0, whole[2, 2] / scale)))), float(whole[2, 3])


def test_a_board_determines_scale_and_vertical(tmp_path: Path) -> None:
    cameras = ring()
    images = photos_of_the_board(cameras, tmp_path)
    model = model_of(cameras, table_and_thing())
    found = find_metric_frame(model, images, board=BOARD)
    scale, tilt, height = errors(found.matrix)
    assert (found.units, found.up, found.source, found.wrong) == ("metre", "z", "a ChArUco board (15 corners)", {})
    assert abs(scale) < 5e-4
    assert tilt < 0.05
    assert abs(height) < 1e-4
    assert found.scale_error is not None
    least = target_evidence.PRINT_ERROR / BOARD.square
    assert least <= found.scale_error < 1.2 * least
    middle = find_metric_frame(model, images, board=BOARD, centred=False).matrix @ LOST
    np.testing.assert_allclose(middle[:3, 3], 0, atol=1e-4)
    np.testing.assert_allclose(middle[:3, :3], np.eye(3), atol=1e-3)  # axes of the board

    # The board detects a camera that is off by a tenth of its distance. The camera does not bias the scale.
    astray = model.cameras["03.png"]
    pose = astray.world_from_camera.copy()
    pose[:3, 3] += 3.7 * np.array([0.03, 0, 0])
    cameras_astray = {**model.cameras, "03.png": replace(astray, world_from_camera=pose)}
    spoilt = find_metric_frame(replace(model, cameras=cameras_astray), images, board=BOARD)
    assert set(spoilt.wrong) == {"03.png"}
    assert spoilt.confirmed == set(images) - {"03.png"}
    assert abs(errors(spoilt.matrix)[0]) < 1e-3


def test_the_metric_frame_knows_the_pose_of_the_board(tmp_path: Path) -> None:
    cameras = ring()
    images = photos_of_the_board(cameras, tmp_path)
    found = find_metric_frame(model_of(cameras, table_and_thing()), images, board=BOARD)
    assert found.board is not None
    truth = found.matrix @ LOST  # the board lies at the world's origin
    scale = np.cbrt(np.linalg.det(truth[:3, :3]))
    np.testing.assert_allclose(found.board[:3, :3], truth[:3, :3] / scale, atol=1e-3)
    np.testing.assert_allclose(found.board[:3, 3], truth[:3, 3], atol=1e-4)


@pytest.mark.parametrize(
    ("usual", "off", "wrong"),
    [(0.0004, 0.004, True), (0.002, 0.004, False), (0.004, 0.012, True), (0.0004, np.inf, True)],
)
def test_a_camera_is_rejected_if_its_error_stands_out(usual: float, off: float, wrong: bool) -> None:
    """Errors are fractions of the image width. The limit is 0.25 % for an outlier and 1 % for any camera."""
    cameras, rng = ring(), np.random.default_rng(4)
    views: Any = {index: {} for index in range(len(BOARD.corners))}
    for k, camera in enumerate(cameras):
        pixels, _ = camera.project(BOARD.corners)
        for index, pixel in enumerate(pixels):
            angle = rng.uniform(0, 2 * np.pi)
            error = (off if k == 0 else usual) * camera.width
            views[index][f"{k:02}"] = camera, pixel + error * np.array([np.cos(angle), np.sin(angle)])
    found, confirmed = target_evidence._check_cameras(views, dict(enumerate(BOARD.corners)))
    assert set(found) == ({"00"} if wrong else set())
    assert confirmed == ({f"{k:02}" for k in range(1, 10)} if usual < target_evidence.MAX_CONTRADICTION else set())


def test_a_bent_board_rejects_no_camera() -> None:
    """Cameras near the table see all of a 2 mm bend that cameras above do not see.

    The triangulated corners have the bend as well.
    """
    bent = BOARD.corners - (0, 0, 0.002) * (np.abs(BOARD.corners[:, :1]) / 0.06) ** 2
    high = ring(30, width=1200)
    low = [Camera.look_at((0.3, y, 0.04), (0, 0, 0), width=1200, height=900, fov_x=45) for y in (-0.1, 0, 0.1)]
    views: Any = {
        index: {f"{k:02}": (camera, camera.project(point)[0][0]) for k, camera in enumerate(high + low)}
        for index, point in enumerate(bent)
    }
    corners = target_evidence._triangulate_corners(views, {f"{k:02}" for k in range(33)})
    assert target_evidence._check_cameras(views, corners) == ({}, frozenset(f"{k:02}" for k in range(33)))


def test_the_stated_scale_error_covers_drifting_cameras() -> None:
    """In 20 models with drifting cameras, the scale error is about as large as stated, within a factor of 2."""
    cameras, rng = ring(), np.random.default_rng(0)
    names = [f"{k:02}.png" for k in range(len(cameras))]
    pixels = [camera.project(BOARD.corners)[0] for camera in cameras]
    ratios = []
    for _ in range(20):
        drifted = [replace(c, world_from_camera=c.world_from_camera @ drift(rng)) for c in cameras]
        seen = {
            index: {n: (c, p[index]) for n, c, p in zip(names, drifted, pixels, strict=True)}
            for index in range(0, len(BOARD.corners), 2)
        }

        def measure(chosen: set[str], seen: Any = seen) -> float | None:
            fitted = target_evidence._fit_board(target_evidence._triangulate_corners(seen, chosen), BOARD)
            return None if fitted is None else fitted[1]

        scale = measure(set(names))
        assert scale is not None
        ratios.append((scale - 1) / target_evidence._scale_error(scale, measure, names, 1e9))
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 2


def drift(rng: np.random.Generator) -> np.ndarray:
    """Draw a small random motion of a camera."""
    pose = np.eye(4)
    pose[:3, 3] = rng.normal(0, 3e-4, 3)
    return pose


def test_tags_determine_scale_and_vertical(tmp_path: Path) -> None:
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    sheet = np.full((1200, 1600), 255, dtype=np.uint8)
    for number, (x, y) in enumerate(((100, 100), (1200, 150), (600, 800))):
        sheet[y : y + 320, x : x + 320] = cv2.aruco.generateImageMarker(family, number, 320)
    cameras = ring()
    images = {f"{k:02}.png": draw(sheet, 8000.0, camera, tmp_path, f"{k:02}.png") for k, camera in enumerate(cameras)}
    assert set(find_tags(np.asarray(Image.open(images["00.png"])))) == {0, 1, 2}
    model = model_of(cameras, np.random.default_rng(0).normal(0, 0.02, (200, 3)))  # no table in the points
    found = find_metric_frame(model, images, tag=0.04)
    scale, tilt, height = errors(found.matrix)
    assert (found.units, found.up, found.source) == ("metre", "z", "3 AprilTags")
    assert abs(scale) < 3e-3
    assert tilt < 0.3
    assert abs(height) < 5e-4
    assert find_metric_frame(model, images).units == "unknown"


@pytest.mark.parametrize("turn", [0.0, 7.0, 40.0])
def test_corners_of_tags_are_found_within_a_fifth_of_a_pixel(turn: float) -> None:
    """A tag is drawn with an edge of 60 px around the middle of a picture, with 64 samples per pixel."""
    family, fine, width = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 8, 160
    printed = np.pad(cv2.aruco.generateImageMarker(family, 5, 600), 400, constant_values=255)
    rotation = Rotation.from_euler("z", turn, degrees=True).as_matrix()[:2, :2]
    y, x = (np.mgrid[: fine * width, : fine * width] + 0.5) / fine - width / 2
    column, row = (np.stack([x, y], axis=-1) @ rotation * 10 + 700).astype(int).clip(0, 1399).transpose(2, 0, 1)
    picture = printed[row, column].reshape(width, fine, width, fine).mean(axis=(1, 3))
    expected = np.array([(-30, -30), (30, -30), (30, 30), (-30, 30)]) @ rotation.T + width / 2
    found = find_tags(np.rint(picture).astype(np.uint8))[5]
    np.testing.assert_allclose(found, expected, atol=0.2)


@pytest.fixture
def blank(tmp_path: Path) -> dict[str, Path]:
    Image.new("L", (640, 480), 90).save(tmp_path / "blank.png")
    return {f"{k:02}.png": tmp_path / "blank.png" for k in range(10)}


def test_a_distance_determines_scale_and_the_table_the_vertical(blank: dict[str, Path]) -> None:
    cameras = ring(rolled=True)
    points = table_and_thing()
    model = model_of(cameras, points)
    gap = float(np.linalg.norm(cameras[0].centre - cameras[4].centre))
    found = find_metric_frame(model, blank, scale_from=("00.png", "04.png", gap))
    scale, tilt, height = errors(found.matrix)
    assert found.source == "the distance of 00.png and 04.png, the table plane"
    assert (found.units, found.up, found.table, found.scale_error) == ("metre", "z", True, None)
    assert abs(scale) < 1e-9
    assert tilt < 0.1
    assert abs(height) < 2e-4
    # Two points given by pixels determine the same scale.
    spots = [f"00.png:{x:.2f},{y:.2f}" for x, y in cameras[0].project(points[[0, 1]])[0]]
    found = find_metric_frame(model, blank, scale_from=(*spots, float(np.linalg.norm(points[0] - points[1]))))
    assert abs(errors(found.matrix)[0]) < 0.02


@pytest.mark.parametrize("height", [-0.03, 0.02])
def test_the_origin_lies_on_the_table_below_the_target(blank: dict[str, Path], height: float) -> None:
    """The cameras are directed at (0.01, 0, 0), above or below the table, and the first one looks along x."""
    cameras = ring(rolled=True)
    model = model_of(cameras, table_and_thing() + np.array((0, 0, height)))
    gap = float(np.linalg.norm(cameras[0].centre - cameras[4].centre))
    whole = find_metric_frame(model, blank, scale_from=("00.png", "04.png", gap)).matrix @ LOST
    np.testing.assert_allclose(whole @ (0.01, 0, height, 1), (0, 0, 0, 1), atol=3e-4)
    ahead = whole[:3, :3] @ cameras[0].world_from_camera[:3, 2]
    assert ahead[0] > 0.5 and abs(ahead[1]) < 1e-3 and ahead[2] < 0


@pytest.mark.parametrize(
    ("spots", "sentence"),
    [
        (("gone.png", "04.png", 1.0), "gone.png: must name a photo with a camera, such as "),
        (("00.png:1", "04.png", 1.0), "00.png:1: a pixel must be given as X,Y (got 1)"),
        (("00.png:0,0", "04.png", 1.0), "00.png:0,0: the photo observes no point within 19 px of this pixel"),
        (("00.png", "04.png", -1.0), "the distance of 00.png and 04.png must be 1e-6 to 1e6 m (got -1)"),
        (("00.png", "00.png", 1.0), "00.png and 00.png must be different points of the model"),
    ],
)
def test_an_invalid_distance_is_refused_in_one_sentence(
    blank: dict[str, Path], spots: tuple[str, str, float], sentence: str
) -> None:
    with pytest.raises(InputError) as raised:
        find_metric_frame(model_of(ring(), table_and_thing()[:1000] * (0.1, 0.1, 1)), blank, scale_from=spots)
    assert sentence in str(raised.value)


def test_without_board_and_distance_scale_and_vertical_are_unknown(blank: dict[str, Path]) -> None:
    model = model_of(ring(), np.random.default_rng(0).normal(0, 0.05, (400, 3)))
    found = find_metric_frame(model, blank)
    assert (found.units, found.up, found.table, found.source) == ("unknown", "unknown", False, "the cameras' attitude")
    centres = np.array([(found.matrix @ np.append(c.centre, 1))[:3] for c in model.cameras.values()])
    assert np.median(np.linalg.norm(centres, axis=1)) == pytest.approx(1, abs=0.01)
    assert errors(found.matrix)[1] < 1.0  # cameras are held level


def test_a_wall_or_ceiling_is_not_taken_for_the_table() -> None:
    rng = np.random.default_rng(1)
    wall = np.column_stack([np.full(600, -0.5), rng.uniform(-0.5, 0.5, 600), rng.uniform(0, 1, 600)])
    table = find_table(model_of(ring(), np.concatenate([table_and_thing(), wall])))
    assert table is not None
    assert table[0] @ LOST[:3, 2] / 3.7 > np.cos(np.radians(0.3))
    assert find_table(model_of(ring(), wall)) is None


def test_the_vertical_from_cameras_needs_views_from_several_sides() -> None:
    found = vertical_from_cameras(model_of(ring(rolled=True), np.zeros((1, 3))))
    assert found is not None
    assert found @ LOST[:3, 2] / 3.7 > np.cos(np.radians(0.5))
    assert vertical_from_cameras(model_of(ring()[:1] * 4, np.zeros((1, 3)))) is None
    rng = np.random.default_rng(0)
    anyhow = [
        replace(camera, world_from_camera=np.block([[r.as_matrix(), np.zeros((3, 1))], [np.eye(4)[3:]]]))
        for camera, r in zip(ring(), Rotation.random(10, random_state=rng), strict=True)
    ]
    assert vertical_from_cameras(model_of(anyhow, np.zeros((1, 3)))) is None


def test_triangulation_ignores_an_outlier() -> None:
    point = np.array([0.02, -0.01, 0.03])
    cameras = [replace(camera, distortion=(-0.1, 0.02, 0.001, 0.0)) for camera in ring()]
    views = [(camera, camera.project(point)[0][0]) for camera in cameras]
    views[4] = (views[4][0], views[4][1] + (40, -25))
    found = triangulate(views)
    assert found is not None
    np.testing.assert_allclose(found, point, atol=1e-7)
    assert triangulate(views[3:6]) is None


def test_fit_similarity_recovers_a_similarity() -> None:
    points = np.random.default_rng(2).normal(size=(9, 3))
    matrix, residuals = fit_similarity(points, points @ LOST[:3, :3].T + LOST[:3, 3])
    np.testing.assert_allclose(matrix, LOST, atol=1e-12)
    np.testing.assert_allclose(residuals, 0, atol=1e-12)


def test_the_nearest_point_to_lines_is_their_intersection() -> None:
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(5, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    point = np.array([1.0, 2, 3])
    np.testing.assert_allclose(
        nearest_point_to_lines(point - directions * rng.uniform(1, 2, (5, 1)), directions), point, atol=1e-6
    )


def test_weak_images_are_dropped_with_the_points_that_only_they_observe() -> None:
    model = model_of(ring(4), np.random.default_rng(0).normal(size=(100, 3)))
    seen = [np.arange(0, 60), np.arange(0, 60), np.arange(50, 95), np.arange(70, 95)]
    model = replace(model, seen=dict(zip(model.cameras, (part.astype(np.int32) for part in seen), strict=True)))
    rest, weak = model.without_weak_images(30)
    assert weak == {"03.png": 25, "02.png": 10}  # without 03, 02 shares only ten points
    assert list(rest.cameras) == ["00.png", "01.png"]
    np.testing.assert_array_equal(rest.points, model.points[:60])
    np.testing.assert_array_equal(rest.seen["01.png"], np.arange(60))


def test_the_printed_board_has_its_stated_size(tmp_path: Path) -> None:
    import re

    board = Board()
    board.write_pdf(tmp_path / "board.pdf", "a4")
    data = (tmp_path / "board.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", data)
    assert box is not None
    width, height = (float(value) / 72 * 0.0254 for value in box.groups())
    assert (width, height) == pytest.approx((0.297, 0.210), abs=1e-6)
    assert b"CCITTFaxDecode" in data  # lossless compression
    # The drawing has every inner corner at its stated position, at 20 dots per millimetre.
    dots = round(20_000 * board.square)
    sheet = cv2.copyMakeBorder(board.draw(dots), *(dots,) * 4, cv2.BORDER_CONSTANT, value=255)
    small = cv2.resize(sheet, None, fx=0.1, fy=0.1, interpolation=cv2.INTER_AREA)
    found = board.find(small)
    assert len(found) == 24
    middle = np.array(small.shape[::-1]) / 2
    expected = middle + board.corners[:, :2] * (1, -1) * 2000
    np.testing.assert_allclose([found[k] for k in range(24)], expected, atol=0.1)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda path: Board(2, 6), "a board must have 3x4 to 500 squares (got 2x6)"),
        (lambda path: Board(3, 3), "a board must have 3x4 to 500 squares (got 3x3)"),
        (lambda path: Board(square=0), "a board's square must be 0.001 to 10 m (got 0)"),
        (lambda path: Board(9, 5).write_pdf(path / "a.pdf", "a4"), "does not fit on a4 with a margin of 0.008 m"),
        (lambda path: Board().write_pdf(path, "a4"), "cannot be written"),
    ],
)
def test_invalid_boards_are_refused_in_one_sentence(tmp_path: Path, make: object, sentence: str) -> None:
    with pytest.raises(InputError) as raised:
        make(tmp_path)  # type: ignore[operator]
    assert sentence in str(raised.value)


def test_cameras_at_one_position_are_refused(tmp_path: Path) -> None:
    Image.new("L", (64, 48)).save(tmp_path / "black.png")
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    model = replace(model_of([camera] * 4, np.zeros((0, 3))), cameras=dict.fromkeys("abcd", camera))
    with pytest.raises(InputError, match="the 4 cameras must not coincide with the point at which they are directed"):
        find_metric_frame(model, dict.fromkeys("abcd", tmp_path / "black.png"))
