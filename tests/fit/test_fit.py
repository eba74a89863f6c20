"""Fits to captures with known ground truth."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from benchmarks.assets import strategy_classic
from benchmarks.assets.strategy_classic import Classic
from mitsplat.capture.capture import Capture, Photo
from mitsplat.errors import InputError
from mitsplat.fit import trainer as fit
from mitsplat.fit.depth_priors import DepthMaps, align_maps
from mitsplat.fit.fit_folder import FitResult
from mitsplat.fit.fit_settings import FitProgress, FitSettings
from mitsplat.fit.initial_points import seed_points
from mitsplat.fit.photo_loss import depth_error, depth_image
from mitsplat.fit.trainer import fit_capture
from mitsplat.fit.training_view import TrainingView
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.camera_poses import spiral
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.layers import render_splats
from mitsplat.runtime.variant import ensure_variant

WIDTH, HEIGHT, VIEWS = 64, 48, 20
SMALL = FitSettings(gaussians=800, iterations=60, sh_degree=1, refine_every=10, coarse=0.1)


def ball() -> Splats:
    """Build a coloured ball of flat Gaussians."""
    rng = np.random.default_rng(3)
    index = np.arange(500) + 0.5
    z, azimuth = 1 - index / 250, index * np.pi * (1 + np.sqrt(5))
    normals = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
    turns, _ = zip(*(Rotation.align_vectors([n], [[0, 0, 1]]) for n in normals), strict=True)
    colour = 0.5 + 0.4 * np.sin(normals * (4, 5, 6) + rng.random(3))
    return Splats(
        means=0.4 * normals,
        quats=np.array([turn.as_quat() for turn in turns]),
        scales=np.tile([0.035, 0.035, 0.005], (500, 1)),
        opacities=np.full(500, 0.95),
        sh=((colour - 0.5) / SH_C0)[:, None],
    )


def look(direction: np.ndarray) -> Camera:
    return Camera.look_at(1.5 * direction / np.linalg.norm(direction), (0, 0, 0), width=WIDTH, height=HEIGHT, fov_x=45)


def photograph(folder: Path, *, gains: np.ndarray | None = None) -> Capture:
    """Render photos of the ball from all sides, in front of a background of noise, with masks."""
    rng, truth = np.random.default_rng(5), ball()
    photos = []
    for number in range(VIEWS):
        camera = look(rng.normal(size=3) * (1, 1, 0.5))
        layers = render_splats(truth, camera, quality=fit.QUALITY)
        colour = encode_srgb(layers.rgb / np.maximum(layers.alpha, 1e-6)[..., None]) * layers.alpha[..., None]
        colour += rng.random((HEIGHT, WIDTH, 3)) * (1 - layers.alpha[..., None])
        if gains is not None:
            colour *= gains[number]
        files = folder / f"{number:02}.png", folder / f"mask_{number:02}.png"
        for file, values in zip(files, (colour, layers.alpha), strict=True):
            Image.fromarray(np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)).save(file)
        photos.append(Photo(files[0].name, files[0], camera, files[1]))
    # Points on the ball, and some on the background that a fit of the ball alone must ignore.
    row = np.arange(600) % 500
    points = np.concatenate([truth.means[row] + rng.normal(0, 0.005, (600, 3)), rng.normal((0, 0, 9), 1, (100, 3))])
    shades = np.concatenate([255 * (0.5 + SH_C0 * truth.sh[row, 0]), np.full((100, 3), 128)])
    return Capture(tuple(photos), points, shades.astype(np.uint8), "metre", "z")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return photograph(tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module")
def fitted(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fit")
    fit_capture(capture, folder, SMALL)
    return folder


def test_a_fit_has_24_db_on_photos_that_were_held_out(capture: Capture, tmp_path: Path) -> None:
    states: list[FitProgress] = []
    settings = FitSettings(gaussians=900, iterations=300, sh_degree=1, refine_every=20, coarse=0.0, rate_sh=0.01)
    result = fit_capture(capture, tmp_path, settings, progress=states.append)
    assert result.psnr > 24 and result.ssim > 0.87
    assert [photo.name for photo in result.held_out] == ["00.png", "08.png", "16.png"]
    assert 500 < states[0].gaussians < 700 and states[-1].gaussians == len(result.splats) == 900
    assert states[-1].fraction == 1 and states[-1].psnr > states[0].psnr + 3
    # Masks supervise alpha: no Gaussians of the background remain, and the ball is opaque from a new direction.
    layers = render_splats(result.splats, look(np.array([0.3, 1, 0.2])))
    truth = render_splats(ball(), look(np.array([0.3, 1, 0.2])))
    inside, outside = truth.alpha > 0.99, ~binary_dilation(truth.alpha > 0.01, iterations=2)
    assert layers.alpha[inside].mean() > 0.97 and layers.alpha[outside].mean() < 0.02


def test_the_folder_has_splats_record_and_comparisons(fitted: Path, capture: Capture) -> None:
    record = json.loads((fitted / "fit.json").read_text())
    assert record["gaussians"] == len(Splats.load(fitted / "splats.ply")) and record["iterations"] == 60
    assert record["units"] == "metre" and record["settings"]["masks"] == "alpha"
    for photo in record["held_out"]:
        sheet = np.asarray(Image.open(fitted / "held_out" / photo["name"]))
        assert sheet.shape == (HEIGHT, 3 * WIDTH, 3)
        seen, truth = sheet[:, WIDTH : 2 * WIDTH] / 255, sheet[:, :WIDTH] / 255
        assert photo["psnr"] == pytest.approx(-10 * np.log10(np.mean((seen - truth) ** 2)), abs=0.05)
    assert not (fitted / "checkpoint.npz").exists()


def test_a_finished_fit_is_reused(fitted: Path, capture: Capture) -> None:
    before = (fitted / "splats.ply").stat().st_mtime_ns
    again = fit_capture(capture, fitted, SMALL)
    assert (fitted / "splats.ply").stat().st_mtime_ns == before
    assert again.iterations == 60 and again.psnr == json.loads((fitted / "fit.json").read_text())["psnr"]


def test_a_strategy_with_other_parameters_is_another_fit(capture: Capture) -> None:
    hashes = {fit._input_hash(capture, SMALL, None, Classic(most, every)) for most in (500, 800) for every in (50, 100)}
    assert len(hashes) == 4


@pytest.mark.parametrize("strategy", [Classic, pytest.param(None, marks=pytest.mark.extended)])
def test_an_interrupted_fit_resumes_to_the_same_bytes(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: type[Classic] | None
) -> None:
    """The state of a given densification strategy is restored too."""
    monkeypatch.setattr(strategy_classic, "_RESET_STEPS", 20)  # one reset before the checkpoint, none soon after
    capture = seeing(capture)

    def fitted(out: Path, progress: Callable[[FitProgress], None] | None = None) -> FitResult:
        densification = None if strategy is None else strategy(SMALL.gaussians, SMALL.refine_every)
        return fit_capture(capture, out, SMALL, densification=densification, progress=progress)

    whole = fitted(tmp_path / "whole")
    assert 600 < len(whole.splats) <= 800
    monkeypatch.setattr(fit, "_CHECKPOINT_SECONDS", 0.0)
    steps: list[int] = []

    def interrupt(state: FitProgress) -> None:
        steps.append(state.step)
        if len(steps) == 2:
            raise KeyboardInterrupt

    out = tmp_path / "interrupted"
    with pytest.raises(KeyboardInterrupt):
        fitted(out, interrupt)
    fitted(out, lambda state: steps.append(state.step))
    assert steps == [25, 50, 50, 60]  # the first checkpoint comes after the first report
    assert (out / "splats.ply").read_bytes() == (tmp_path / "whole" / "splats.ply").read_bytes()


def test_an_interrupted_fit_ends_at_its_target_at_the_same_step(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The target is checked every 10 steps, also after an interruption in between."""
    monkeypatch.setattr(fit, "_REPORT_STEPS", 2)
    monkeypatch.setattr(fit, "_CHECKPOINT_SECONDS", 0.0)
    settings = replace(SMALL, iterations=200, gaussians=300, coarse=0.0, target_psnr=99.0)
    found: dict[int, float | None] = {}

    def stop_at(step: int) -> Callable[[FitProgress], None]:
        def look(state: FitProgress) -> None:
            found[state.step] = state.validation
            if state.step == step:
                raise KeyboardInterrupt

        return look

    with pytest.raises(KeyboardInterrupt):
        fit_capture(capture, tmp_path / "probe", settings, progress=stop_at(22))
    assert [step for step in range(4, 22, 2) if found[step] != found[step - 2]] == [10, 20]
    settings = replace(settings, target_psnr=found[20])
    whole = fit_capture(capture, tmp_path / "whole", settings)
    assert whole.iterations == 20 and whole.validation_psnr == found[20]
    with pytest.raises(KeyboardInterrupt):
        fit_capture(capture, tmp_path / "again", settings, progress=stop_at(14))
    again = fit_capture(capture, tmp_path / "again", settings)
    assert (again.iterations, again.validation) == (whole.iterations, whole.validation)
    assert (tmp_path / "again/splats.ply").read_bytes() == (tmp_path / "whole/splats.ply").read_bytes()


def test_a_fit_has_no_more_gaussians_than_its_limit(capture: Capture, tmp_path: Path) -> None:
    counts: list[int] = []
    settings = replace(SMALL, gaussians=700, refine_every=5)
    fit_capture(capture, tmp_path, settings, progress=lambda state: counts.append(state.gaussians))
    assert counts[0] > 600 and max(counts) == 700


def test_another_seed_changes_the_splats(fitted: Path, capture: Capture, tmp_path: Path) -> None:
    fit_capture(capture, tmp_path, replace(SMALL, seed=1))
    assert (tmp_path / "splats.ply").read_bytes() != (fitted / "splats.ply").read_bytes()


def test_the_folder_of_another_fit_is_refused_without_overwrite(fitted: Path, capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"fit\.json: belongs to a fit of other photos or settings"):
        fit_capture(capture, fitted, replace(SMALL, seed=2))
    (tmp_path / "checkpoint.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"checkpoint\.npz: not a checkpoint"):
        fit_capture(capture, tmp_path, SMALL)
    fit_capture(capture, tmp_path, replace(SMALL, iterations=5), overwrite=True)
    assert json.loads((tmp_path / "fit.json").read_text())["iterations"] == 5


def test_more_gaussians_compile_no_new_kernels(capture: Capture, tmp_path: Path) -> None:
    """Depths do not compile new kernels either, for any number of Gaussians or of points in a photo."""
    seen: list[set[int]] = []
    counts: list[int] = []

    def keep(state: FitProgress) -> None:
        seen.append({entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])})
        counts.append(state.gaussians)
        if len(seen) == 4:
            raise KeyboardInterrupt

    settings = replace(SMALL, iterations=200, sh_degree=0, refine_every=5, gaussians=2000, coarse=0.0)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), pytest.raises(KeyboardInterrupt):
        fit_capture(seeing(capture), tmp_path, settings, progress=keep)
    assert 600 < counts[1] < counts[2] < counts[3]
    assert seen[2] and seen[3] and seen[2] | seen[3] <= seen[0] | seen[1]


def test_a_fit_ends_within_its_time_limit(capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mock clock advances by 10 ms at every call."""
    now = itertools.count()
    monkeypatch.setattr(fit.time, "monotonic", lambda: 0.01 * next(now))
    short = fit_capture(capture, tmp_path, replace(SMALL, iterations=10**6, budget=2.0))
    assert short.seconds == pytest.approx(2, abs=0.05) and 20 < short.iterations < 200
    (warning,) = short.warnings
    assert warning == f"the budget of 2 s allowed only {short.iterations} of 1000000 steps; a longer fit is sharper"
    again = fit_capture(capture, tmp_path, replace(SMALL, iterations=10**6, budget=2.0))
    assert again.warnings == short.warnings
    enough = fit_capture(capture, tmp_path / "enough", replace(SMALL, iterations=20, budget=1e4))
    assert enough.iterations == 20 and enough.warnings == ()
    assert short.validation == ()


def test_the_target_is_measured_on_photos_other_than_those_held_out(capture: Capture, tmp_path: Path) -> None:
    """Noise in place of the held-out photos changes the reported values, but neither the splats nor the last step."""
    settings = replace(SMALL, iterations=400, target_psnr=12.0)
    early = fit_capture(capture, tmp_path / "early", settings)
    assert early.iterations < 200 and early.validation_psnr is not None and early.validation_psnr >= 12
    assert [photo.name for photo in early.held_out] == ["00.png", "08.png", "16.png"]
    assert [photo.name for photo in early.validation] == ["05.png", "14.png"]
    noise = tmp_path / "noise.png"
    Image.fromarray(np.random.default_rng(4).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(noise)
    photos = [replace(p, file=noise) if p in capture.held_out else p for p in capture.photos]
    other = fit_capture(replace(capture, photos=tuple(photos)), tmp_path / "other", settings)
    assert other.psnr < early.psnr - 3
    assert other.iterations == early.iterations
    assert (tmp_path / "other/splats.ply").read_bytes() == (tmp_path / "early/splats.ply").read_bytes()
    with pytest.raises(InputError, match="target_psnr needs at least two photos besides the held-out ones"):
        fit_capture(replace(capture, photos=capture.photos[:2]), tmp_path / "few", settings)


def test_masks_are_not_read_if_they_are_off(capture: Capture, tmp_path: Path) -> None:
    """The background differs in every photo. Its mean is the best result of a fit to all pixels."""
    settings = replace(SMALL, masks="off", iterations=30, coarse=0.0)
    result = fit_capture(capture, tmp_path, settings)
    truth = np.asarray(Image.open(tmp_path / "held_out" / "00.png"))[:, :WIDTH]
    assert truth[0, 0].any()
    with pytest.raises(InputError):
        fit_capture(capture, tmp_path, replace(settings, masks="alpha"))
    assert len(result.held_out) == 3


def seeing(capture: Capture) -> Capture:
    """Return the capture with each photo's visible points: those on its side of the ball."""
    facing = [
        np.flatnonzero(((photo.camera.centre - capture.points[:600]) * capture.points[:600]).sum(axis=1) > 0.1)
        for photo in capture.photos
    ]
    photos = tuple(replace(p, seen=own.astype(np.int32)) for p, own in zip(capture.photos, facing, strict=True))
    return replace(capture, photos=photos)


def test_pixels_that_may_be_hidden_do_not_change_the_fit(capture: Capture, tmp_path: Path) -> None:
    """The splats do not depend on the colour of the occluder, and the surface behind it is complete."""
    veil = np.zeros((HEIGHT, WIDTH), dtype=bool)
    veil[:, 24:34] = True

    def veiled(number: int, shade: int) -> Photo:
        photo = capture.photos[number]
        picture, mask = (np.array(Image.open(file)) for file in (photo.file, photo.mask) if file is not None)
        picture[veil], mask[veil] = shade, 0
        folder = tmp_path / str(shade)
        folder.mkdir(exist_ok=True)
        Image.fromarray(picture).save(folder / f"{number}.png")
        cut = Image.fromarray(mask)
        cut.putalpha(Image.fromarray(np.uint8(255) * (~veil).astype(np.uint8)))
        cut.save(folder / f"{number}_mask.png")
        return replace(photo, file=folder / f"{number}.png", mask=folder / f"{number}_mask.png")

    def fit_of(shade: int) -> FitResult:
        photos = tuple(veiled(number, shade) for number in range(VIEWS))
        settings = replace(SMALL, iterations=120)
        return fit_capture(replace(capture, photos=photos), tmp_path / f"fit{shade}", settings)

    dark, bright = fit_of(10), fit_of(250)
    np.testing.assert_array_equal(dark.splats.means, bright.splats.means)
    np.testing.assert_array_equal(dark.splats.sh, bright.splats.sh)
    assert dark.psnr == bright.psnr
    layers, truth = (render_splats(splats, capture.photos[3].camera) for splats in (dark.splats, ball()))
    behind = veil & (truth.alpha > 0.99)
    assert layers.alpha[behind].mean() > 0.9


def test_depths_of_points_move_the_surface(capture: Capture, tmp_path: Path) -> None:
    settings = replace(SMALL, iterations=20, coarse=0.0, depth_weight=1.0)
    with_depths = fit_capture(seeing(capture), tmp_path / "with", settings).splats
    without = fit_capture(seeing(capture), tmp_path / "without", replace(settings, depth_weight=0.0)).splats
    assert np.abs(with_depths.means - without.means).max() > 1e-5


def test_the_nearest_of_several_points_in_a_pixel_counts(capture: Capture) -> None:
    """Gradients of several points would be added in any order, so that two fits would differ."""
    ensure_variant()
    camera = look(np.array([1.0, 0, 0]))
    depths = np.array([3.0, 1.0, 2.0, 1.0])
    slopes = np.array([[0, 0], [0, 0], [0, 0], [0.1, 0]])
    local = np.column_stack([slopes, np.ones(4)]) * depths[:, None] + (1e-4, 1e-4, 0)
    points = local @ camera.world_from_camera[:3, :3].T + camera.centre
    photo = replace(capture.photos[0], camera=camera, seen=np.arange(4, dtype=np.int32))
    pixel, inverse = (np.array(values) for values in TrainingView(photo, 1.0, masked=False).depths(points))
    middle = HEIGHT // 2 * WIDTH + WIDTH // 2
    np.testing.assert_array_equal(pixel, [middle, middle + int(0.1 * camera.fx)])
    np.testing.assert_allclose(inverse, [1, 1], rtol=1e-4)


def depth_maps(capture: Capture, folder: Path) -> DepthMaps:
    """Write inverse depth maps of the photos like those of a network, each with a scale and a shift of its own."""
    files = {}
    for number, photo in enumerate(capture.photos):
        layers = render_splats(ball(), photo.camera, quality=fit.QUALITY)
        inverse = np.where(layers.alpha > 0.9, 1 / np.maximum(layers.depth, 1), 0.1)
        files[photo.name] = folder / f"{photo.name}.npy"
        np.save(files[photo.name], (2 + 0.3 * number) * inverse - 0.1 * number)
    return DepthMaps(files)


def test_depth_maps_replace_points(capture: Capture, tmp_path: Path) -> None:
    """A map has a depth for every pixel of the object, the points only for their own pixels."""
    photo = seeing(capture).training[0]
    maps = depth_maps(capture, tmp_path)
    inverse, warnings = align_maps([photo], capture.points, maps, 64)
    ensure_variant()
    dense = TrainingView(photo, 1.0, masked=True, inverse_depth=inverse[photo.name])
    assert warnings == ()
    for sight in (dense, dense.half):
        pixel, found = (np.array(values) for values in sight.depths(capture.points))
        np.testing.assert_array_equal(pixel, np.flatnonzero(sight.mask > 0.5))
        depth = render_splats(ball(), sight.camera, quality=fit.QUALITY).depth.ravel()[pixel]
        assert np.median(np.abs(found * depth - 1)) < 0.02


def test_depth_maps_move_the_surface_and_are_hashed_as_inputs(capture: Capture, tmp_path: Path) -> None:
    settings = replace(SMALL, iterations=20, coarse=0.0, depth_weight=1.0)
    photos, maps = seeing(capture), depth_maps(capture, tmp_path)
    few = replace(photos.photos[1], seen=photos.photos[1].seen[:5])
    photos = replace(photos, photos=(photos.photos[0], few, *photos.photos[2:]))
    first = fit_capture(photos, tmp_path / "fit", settings, depths=maps)
    assert first.warnings == (
        "depth maps that are not used, because fewer than 10 of the capture's points are in them: 01.png",
    )
    assert fit_capture(photos, tmp_path / "fit", settings, depths=maps).warnings == first.warnings
    without = fit_capture(photos, tmp_path / "without", settings)
    assert np.abs(first.splats.means - without.splats.means).max() > 1e-5 and without.warnings == ()
    with pytest.raises(InputError, match="belongs to a fit of other photos or settings"):
        fit_capture(photos, tmp_path / "fit", settings, depths=replace(maps, kind="metric"))
    values = np.load(maps.files["03.png"])
    np.save(maps.files["03.png"], values + np.eye(*values.shape))
    with pytest.raises(InputError, match="belongs to a fit of other photos or settings"):
        fit_capture(photos, tmp_path / "fit", settings, depths=maps)


def test_the_weight_of_maps_decays_and_that_of_points_does_not(capture: Capture) -> None:
    ensure_variant()
    photo = capture.training[0]
    state = fit._Fit(capture, (photo,), (photo,), replace(SMALL, depth_weight=2.0), {})
    sparse, dense = (
        TrainingView(photo, 1.0, masked=True, inverse_depth=m) for m in (None, np.ones((3, 4), np.float32))
    )
    assert [state._depth_weight(sparse, fraction) for fraction in (0.0, 1.0)] == [2.0, 2.0]
    assert [state._depth_weight(dense, f) for f in (0.0, 0.5, 1.0)] == pytest.approx([2.0, 0.2, 0.02])
    state.steps = 1
    assert state._depth_weight(dense, 0.0) == 0


def test_depth_error_is_the_difference_of_known_inverse_depths() -> None:
    ensure_variant()
    camera = replace(look(np.ones(3)), width=2, height=2)
    alpha, moment = mi.Float([1.0, 0.5, 0.05, 1.0]), mi.Float([2.0, 2.0, 1.0, 5.0])
    known = depth_image(camera, mi.UInt32([0, 1, 2]), mi.Float([0.4, 0.35, 0.9]))
    assert np.isnan(np.array(known)).tolist() == [False, False, False, True]
    found = depth_error(alpha, moment, known)
    assert found[0] == pytest.approx(0.1 + 0.1 + 0.0, abs=1e-6)  # pixels with little coverage are ignored


def test_too_few_photos_are_refused(capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a fit needs a training photo and a held-out photo"):
        fit_capture(replace(capture, photos=capture.photos[:1]), tmp_path)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"gaussians": 1}, "gaussians"),
        ({"sh_degree": 4}, "sh_degree"),
        ({"budget": 0.0}, "budget"),
        ({"coarse": 2}, "coarse"),
    ],
)
def test_settings_out_of_range_are_refused(change: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        FitSettings(**change)  # type: ignore[arg-type]


def test_photos_that_differ_in_their_suffix_have_comparisons_of_their_own(tmp_path: Path) -> None:
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), up=(0, 1, 0), width=40, height=30, fov_x=40)
    for name in ("a.png", "a.jpg"):
        Image.new("RGB", (40, 30)).save(tmp_path / name)
        view = TrainingView(Photo(name, tmp_path / name, camera), 1.0, masked=False)
        view.compare(np.zeros((30, 40, 3), np.float32), tmp_path / "held_out")
    assert sorted(path.name for path in (tmp_path / "held_out").iterdir()) == ["a.jpg.png", "a.png"]


def seeds(capture: Capture, points: np.ndarray, *, masked: bool = True) -> np.ndarray:
    cameras = [photo.camera for photo in capture.training]
    masks = [photo.read().mask for photo in capture.training] if masked else None
    colours = np.zeros(points.shape, np.uint8)
    nothing = [np.zeros(0, np.int32)] * len(cameras)
    return seed_points(points, colours, cameras, nothing, masks, np.random.default_rng(0), 10_000)[0]


def test_initial_gaussians_are_the_points_inside_the_masks(capture: Capture) -> None:
    inside = np.random.default_rng(1).normal(size=(600, 3))
    inside *= 0.35 / np.linalg.norm(inside, axis=1, keepdims=True)
    outside = inside + np.array([0, 0, 1.3])
    np.testing.assert_array_equal(seeds(capture, np.concatenate([inside, outside])), inside)


def test_without_points_the_visual_hull_is_filled(capture: Capture) -> None:
    radius = np.linalg.norm(seeds(capture, np.zeros((0, 3))), axis=1)
    assert len(radius) > 1000 and np.percentile(radius, 95) < 0.6
    free = seeds(capture, np.zeros((0, 3)), masked=False)
    assert len(free) == 3000 and np.linalg.norm(free, axis=1).max() > 1


def test_the_visual_hull_of_a_small_part_is_filled() -> None:
    """The part has a hundredth of the cameras' distance, and is not where they are directed."""
    middle, radius = np.array([0.02, 0.01, 0.0]), 0.005
    cameras = [
        Camera.look_at(eye, (0, 0, 0), width=400, height=300, fov_x=40)
        for eye in 0.4 * spiral(np.linspace(0.2, 0.9, 12))
    ]
    masks = []
    for camera in cameras:
        (pixel,), (depth,) = camera.project([middle])
        y, x = np.mgrid[:300, :400] + 0.5
        masks.append((np.hypot(x - pixel[0], y - pixel[1]) < radius * camera.fx / depth).astype(np.float32))
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.uint8), cameras, [np.zeros(0, np.int32)] * 12, masks
    points, _ = seed_points(*nothing, np.random.default_rng(0), 10_000)
    assert len(points) > 500 and np.linalg.norm(points - middle, axis=1).max() < 1.5 * radius
