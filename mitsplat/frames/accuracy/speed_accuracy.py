"""Benchmark of speed and accuracy: presets, cheaper light models and other kinds of objects against references.

Every step runs in a separate process, so that its time and memory are measured alone. Pictures are compared
display-encoded, before the camera's development, because sensor noise would mask the differences. The reference of
whole pictures is the preset ``exact``, and that of objects their meshes, path-traced with many paths per pixel.
"""

from __future__ import annotations

import math
import resource
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter

from mitsplat.arrays import BoolArray, Float32Array, Float64Array
from mitsplat.engine.answers import LostWorkersError
from mitsplat.engine.pool import run_in_process
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.frames.accuracy.object_steps import MeshSceneBuilder, without_materials
from mitsplat.frames.frame import Renderer
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.images.masks import iou
from mitsplat.progress import Note, Progress
from mitsplat.quality import PRESETS, Quality
from mitsplat.renderer.layers import Layers, render_splats
from mitsplat.runtime.device import Device, current_device
from mitsplat.scene.loading.scene_loading import load_scene

INSTANCE_MIN = 50
"""Minimum size of an instance for the mask IoU [px]."""


@dataclass(frozen=True)
class Step:
    """One configuration.

    Attributes:
        name: Name in the table.
        quality: Quality of the splat renderer.
        overrides: Changes to the scene file by key.
        captured: True if the objects are captured assets: their base colours times the light ratio.
        mesh_paths: Paths per pixel of objects that are path-traced meshes; 0 for splats.
    """

    name: str
    quality: Quality
    overrides: Mapping[str, object] = field(default_factory=dict)
    captured: bool = False
    mesh_paths: int = 0


_FAST = PRESETS["fast"]
TOLERANCE_PREFIX, BUDGET_PREFIX, MESH_PREFIX = "balanced at ", "fast, shadow error ", "meshes, "
"""Prefixes of the names of steps with other tolerances, with other ray budgets, and with path-traced meshes."""

CAPTURED = "fast, captured objects"
"""Name of the step without materials."""

STEPS = (
    *(Step(name, quality) for name, quality in PRESETS.items()),
    Step("fast, EWA response", replace(_FAST, response="ewa")),
    Step("fast, cut at 1/255, SH 1", replace(_FAST, alpha_min=1 / 255, sh_degree=1)),
)
LIGHT_STEPS = (
    *(Step(f"{BUDGET_PREFIX}{error}", _FAST, {"composite.shadow_error": error}) for error in (0.1, 0.015)),
    Step("fast, shadows of splats", _FAST, {"composite.occluders": "splats"}),
    Step("fast, no bounce", _FAST, {"composite.bounce": False}),
    Step("fast, image shadow", _FAST, {"composite.shadow": "image"}),
    Step("fast, no shadow", _FAST, {"composite.shadow": "none"}),
)
MATERIAL_STEPS = (
    Step(CAPTURED, _FAST, captured=True),
    *(Step(f"{MESH_PREFIX}{paths} paths", _FAST, mesh_paths=paths) for paths in (4, 16, 64, 256)),
)
"""Steps for scenes whose objects all have materials. The last one is the reference of objects."""


def tolerance_steps(tolerances: Sequence[float]) -> tuple[Step, ...]:
    """Return steps with the preset ``balanced`` at other tolerances of the blending order.

    Raises:
        InputError: If a tolerance is negative or not a number.
    """
    balanced = PRESETS["balanced"]
    return tuple(Step(f"{TOLERANCE_PREFIX}{t:g}", replace(balanced, tolerance=t)) for t in tolerances)


@dataclass(frozen=True)
class Row:
    """Cost and error of one step over all pictures.

    Attributes:
        name: Name of the step.
        seconds: Median time of one image, without settling and writing [s].
        rmse: Root mean square error of display-encoded colours in [0, 1], against ``exact``.
        psnr: The same in dB; infinite for ``exact``.
        largest: Largest error of a channel.
        ssim: Mean structural similarity (Wang et al. 2004).
        mask_iou: Mean IoU of the instances' pixels; NaN without instances.
        memory: Peak memory of the process [GiB].
        estimate: Largest error due to the blending order by the step's own estimate; NaN without an estimate.
        objects: PSNR inside of objects [dB]: against their path-traced meshes if all objects have materials, otherwise
            against ``exact``. Infinite for the reference, NaN without objects.
    """

    name: str
    seconds: float
    rmse: float
    psnr: float
    largest: float
    ssim: float
    mask_iou: float
    memory: float
    estimate: float
    objects: float


@dataclass(frozen=True, eq=False)
class _StepResult:
    """Pictures (K, H, W, 3) and instances (K, H, W) of one step, their median time [s], peak memory [GiB], estimate."""

    pictures: Float32Array
    instances: npt.NDArray[np.uint16]
    seconds: float
    memory: float
    estimate: float


def measure_steps(
    path: str | Path,
    steps: Sequence[Step] | None = None,
    *,
    tolerances: Sequence[float] = (),
    frames: int = 3,
    overrides: Mapping[str, object] | None = None,
    allow_outside: bool = False,
    progress: Progress | None = None,
    device: Device | None = None,
) -> list[Row]:
    """Measure steps against the preset ``exact``, and objects against path-traced meshes if these are among the steps.

    Args:
        path: Scene file, or a file of splats, which is rendered from a circle of cameras.
        steps: Steps to measure; by default, all that apply to the file.
        tolerances: Additional tolerances of the blending order for ``balanced``.
        frames: Number of pictures to compare, spread evenly over the scene's frames.
        overrides: Changes to the scene file by key, such as ``output.width``.
        allow_outside: Accept files outside of the scene's folder.
        progress: Callback with (steps done, number of steps, name of the next step).
        device: Device; that of :func:`mitsplat.runtime.device.current_device` if None.

    Raises:
        InputError: If the file is invalid, or ``frames`` is below 1.
        MissingResourceError: If a step's process dies, for example because memory is exhausted.
    """
    path = Path(path)
    if frames < 1:
        raise InputError(f"frames must be at least 1 (got {frames})")
    if steps is None:
        steps = _steps_of(path, overrides, allow_outside)
    steps = (*steps, *tolerance_steps(tolerances))
    exact = Step("exact", PRESETS["exact"])
    traced = max(steps, key=lambda step: step.mesh_paths, default=exact)
    references = [exact, traced] if traced.mesh_paths else [exact]
    plan = [*references, *(step for step in steps if step not in references)]
    done = count()

    def run(step: Step) -> _StepResult:
        if progress is not None:
            progress(next(done), len(plan), step.name)
        job = _RenderJob(path, step, frames, {**(overrides or {}), **step.overrides}, allow_outside)
        return _run_job(job, device or current_device())

    known = {step.name: run(step) for step in references}
    whole, objects = known[exact.name], known[references[-1].name]
    rows = {step.name: _compare(step, known.get(step.name) or run(step), whole, objects) for step in plan}
    return [rows[step.name] for step in steps]


def _steps_of(path: Path, overrides: Mapping[str, object] | None, allow_outside: bool) -> tuple[Step, ...]:
    """Return all steps that apply to a file."""
    if _is_splats(path):
        return STEPS
    assets = load_scene(path, overrides=dict(overrides or {}), allow_outside=allow_outside).assets
    has_materials = bool(assets) and all(asset.splats.materials is not None for asset in assets)
    return STEPS + LIGHT_STEPS + (MATERIAL_STEPS if has_materials else ())


def fastest_preset(rows: Sequence[Row], tolerance: float) -> Row:
    """Return the fastest preset whose RMSE is within the tolerance; ``rows`` must contain all presets.

    Raises:
        InputError: If the tolerance is negative.
    """
    check_tolerance(tolerance)
    within = [row for row in rows if row.name in PRESETS and row.rmse <= tolerance]
    return min(within, key=lambda row: row.seconds)


def check_tolerance(tolerance: float) -> None:
    """Check that a tolerance is a number >= 0.

    Raises:
        InputError: If it is negative or not a number.
    """
    if not tolerance >= 0:
        raise InputError(f"tolerance must be at least 0 (got {tolerance})")


def choose_preset(
    path: str | Path,
    tolerance: float,
    *,
    overrides: Mapping[str, object] | None = None,
    allow_outside: bool = False,
    progress: Progress | None = None,
    device: Device | None = None,
) -> Row:
    """Return the fastest preset for a scene, measured on two of its frames; see :func:`measure_steps`.

    Raises:
        InputError: If the tolerance is negative, or the scene file is invalid.
    """
    check_tolerance(tolerance)
    steps = STEPS[: len(PRESETS)]
    rows = measure_steps(
        path, steps, frames=2, overrides=overrides, allow_outside=allow_outside, progress=progress, device=device
    )
    return fastest_preset(rows, tolerance)


def _is_splats(path: Path) -> bool:
    return path.suffix.lower() not in (".yaml", ".yml")


@dataclass(frozen=True)
class _RenderJob:
    """Job of a process: the pictures of one step."""

    path: Path
    step: Step
    frames: int
    overrides: Mapping[str, Any]
    allow_outside: bool

    def __call__(self, _index: int, _note: Note, /) -> _StepResult:
        """Render the pictures; the first one is rendered twice, because it compiles or loads kernels."""
        render = _splats_renderer(self) if _is_splats(self.path) else _scene_renderer(self)
        views = [render(number) for number in (0, *range(self.frames))][1:]
        pictures, instances, seconds, estimates = zip(*views, strict=True)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # in KiB
        return _StepResult(np.stack(pictures), np.stack(instances), statistics.median(seconds), peak, max(estimates))


def _run_job(job: _RenderJob, device: Device) -> _StepResult:
    """Run a job in a process of its own."""
    try:
        return run_in_process(job, device)
    except LostWorkersError as error:
        raise MissingResourceError(
            f"{job.path}: the process of step '{job.step.name}' died, possibly because memory is exhausted"
        ) from error


View = tuple[Float32Array, npt.NDArray[np.uint16], float, float]
"""Picture, instances, time [s], and the estimated largest error, or NaN."""


def _scene_renderer(job: _RenderJob) -> Callable[[int], View]:
    """Return a function that renders one of the pictures of a scene."""
    scene = load_scene(job.path, overrides=dict(job.overrides), allow_outside=job.allow_outside)
    options = dict(scene.splat_options)
    if job.step.quality.response == "ewa":  # the step itself sets the response
        del options["response"]
    if job.step.captured:
        scene = without_materials(scene)
    renderer = Renderer(scene, quality=replace(job.step.quality, **options))
    indices = np.linspace(0, scene.num_frames - 1, job.frames).round().astype(int)

    def render(number: int) -> View:
        frame = renderer.render(int(indices[number]))
        seconds = sum(value for stage, value in frame.seconds.items() if stage != "settle")
        picture = encode_srgb(np.clip(frame.rgb, 0, 1)).astype(np.float32)
        return picture, frame.instance, seconds, _largest_error(frame.order_error)

    def render_meshes(number: int) -> View:
        # The first picture of a layout prepares the splats that meshes mirror, which takes longer than the paths.
        renderer.integrator.renderer.mesh_samples = 1
        render(number)
        renderer.integrator.renderer.mesh_samples = job.step.mesh_paths
        return render(number)

    if job.step.mesh_paths:
        renderer.scene_builder = MeshSceneBuilder(scene)
        return render_meshes
    return render


def _splats_renderer(job: _RenderJob) -> Callable[[int], View]:
    """Return a function that renders one of the pictures of a file of splats."""
    splats = Splats.load(job.path)
    width, height = job.overrides.get("output.width", 1280), job.overrides.get("output.height", 720)

    def render(number: int) -> View:
        camera = look_around(splats, number, job.frames, width=width, height=height)
        start = time.perf_counter()
        layers = render_splats(splats, camera, quality=job.step.quality)
        seconds = time.perf_counter() - start
        return picture_of(layers), layers.instance, seconds, _largest_error(layers.order_error)

    return render


def _largest_error(order_error: Mapping[str, float] | None) -> float:
    return math.nan if order_error is None else order_error["largest"]


def picture_of(layers: Layers) -> Float32Array:
    """Blend the encoded colours over black, (H, W, 3) in [0, 1], as in captures of splats."""
    colour = layers.rgb / np.maximum(layers.alpha, 1e-6)[..., None]
    return np.clip(encode_srgb(colour) * layers.alpha[..., None], 0, 1).astype(np.float32)


def look_around(splats: Splats, index: int, count: int, *, width: int, height: int) -> Camera:
    """Return camera ``index`` of ``count`` on a circle around splats whose up axis is -y, as in 3DGS files."""
    centre = np.median(splats.means, axis=0)
    size = np.percentile(np.linalg.norm(splats.means - centre, axis=1), 80)
    angle = 2 * math.pi * index / count + 0.25
    eye = centre + 2 * size * np.array([math.sin(angle), -0.5, -math.cos(angle)])
    return Camera.look_at(eye, centre, up=(0, -1, 0), width=width, height=height, fov_x=50)


def _compare(step: Step, result: _StepResult, whole: _StepResult, objects: _StepResult) -> Row:
    """Compare pictures with the reference of whole pictures, and inside of objects with that of objects."""
    # Imported here, because it would add to the peak memory of the measuring processes.
    from skimage.metrics import structural_similarity

    difference = result.pictures.astype(np.float64) - whole.pictures
    ssim = [
        structural_similarity(picture, exact, channel_axis=-1, data_range=1.0)  # type: ignore[no-untyped-call]
        for picture, exact in zip(result.pictures, whole.pictures, strict=True)
    ]
    inside = _inside_objects(whole.instances)
    return Row(
        step.name,
        result.seconds,
        rmse=_rms(difference),
        psnr=_psnr(difference),
        largest=float(np.abs(difference).max()),
        ssim=float(np.mean(ssim)),
        mask_iou=math.nan if step.mesh_paths else _mask_iou(result.instances, whole.instances),
        memory=result.memory,
        estimate=result.estimate,
        objects=_psnr((result.pictures.astype(np.float64) - objects.pictures)[inside]) if inside.any() else math.nan,
    )


def _rms(difference: Float64Array) -> float:
    return float(np.sqrt(np.mean(difference**2)))


def _psnr(difference: Float64Array) -> float:
    """Return the PSNR [dB] of values in [0, 1]; infinite without a difference."""
    rms = _rms(difference)
    return -20 * math.log10(rms) if rms > 0 else math.inf


def _inside_objects(instances: npt.NDArray[np.uint16]) -> BoolArray:
    """Return True for pixels whose neighbours all show the same instance, which excludes silhouettes."""
    least, most = (find(instances, size=(1, 3, 3)) for find in (minimum_filter, maximum_filter))
    return np.asarray((least == most) & (least > 0))


def _mask_iou(instances: npt.NDArray[np.uint16], true_instances: npt.NDArray[np.uint16]) -> float:
    """Compute the mean IoU over the instances of all pictures, or NaN."""
    ious = [
        iou(ids == instance, true_ids == instance)
        for ids, true_ids in zip(instances, true_instances, strict=True)
        for instance, count in zip(*np.unique(true_ids[true_ids > 0], return_counts=True), strict=True)
        if count >= INSTANCE_MIN
    ]
    return float(np.mean(ious)) if ious else math.nan
