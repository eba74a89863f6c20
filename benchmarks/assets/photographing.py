"""Path-traced photographs of known scenes, with noise, exposures, and masks of objects."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

from mitsplat.geometry.camera import Camera
from mitsplat.runtime.cores import usable_cores
from mitsplat.runtime.variant import ensure_variant


class Sensors:
    """Mitsuba cameras: x left and y up, with the same pixel centres as here. Moving one needs no new kernels."""

    def __init__(self) -> None:
        self._made: dict[tuple[int, int, float], Any] = {}

    def like(self, camera: Camera) -> Any:
        """Return the sensor of a camera, valid until the next call."""
        key = camera.width, camera.height, camera.fx
        if key not in self._made:
            film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
            angle = float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx)))
            # Stratified samples: less noise with the same number of paths.
            self._made[key] = mi.load_dict(
                {"type": "perspective", "fov": angle, "film": film, "sampler": {"type": "multijitter"}}
            )
        parameters = mi.traverse(self._made[key])
        parameters["to_world"] = mi.Transform4f(camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0]))
        parameters.update()
        return self._made[key]


def by_name(views: Sequence[Camera], suffix: str = ".png") -> dict[str, Camera]:
    """Return cameras by the names of their photos."""
    return {f"photo{number:02}{suffix}": camera for number, camera in enumerate(views)}


def photograph(
    scene: Mapping[str, Any],
    views: Sequence[Camera],
    folder: Path,
    *,
    samples: int,
    noise: float = 0.01,
    gains: np.ndarray | None = None,
    suffix: str = ".png",
) -> dict[str, Camera]:
    """Path-trace photos of a Mitsuba scene with normal noise; return their cameras by file name.

    Args:
        scene: Scene dictionary.
        views: Cameras.
        folder: Output folder.
        samples: Paths per pixel.
        noise: Standard deviation in display-encoded values.
        gains: Exposure gain of each photo and channel, shape (N, 3).
        suffix: Suffix of the files.
    """
    from mitsplat.renderer.rays.device_arrays import ray_scene

    ensure_variant()
    folder.mkdir(parents=True, exist_ok=True)
    loaded = ray_scene(scene)
    rng = np.random.default_rng(0)
    found = by_name(views, suffix)
    sensors = Sensors()
    # Encoding a large photo takes longer than tracing it on a GPU; the queue holds one photo per core.
    writing: deque[Future[None]] = deque(maxlen=usable_cores())
    with ThreadPoolExecutor(usable_cores()) as threads:
        for number, (name, camera) in enumerate(found.items()):
            radiance = np.array(mi.render(loaded, sensor=sensors.like(camera), spp=samples, seed=number))[..., :3]
            gain = np.ones(3, dtype=np.float32) if gains is None else gains[number]
            if len(writing) == writing.maxlen:
                writing[0].result()
            writing.append(threads.submit(develop, folder / name, radiance, gain, rng.normal(0, noise, radiance.shape)))
        for photo in writing:
            photo.result()
    return found


def develop(file: Path, radiance: np.ndarray, gain: np.ndarray, noise: np.ndarray) -> None:
    """Write a photo of light (H, W, 3), multiplied by a gain per channel, with noise in display-encoded values."""
    # A path that grazes an edge may return NaN.
    noisy = np.nan_to_num(np.clip(radiance * gain, 0, 1)) ** (1 / 2.2) + noise
    Image.fromarray(np.rint(255 * noisy.clip(0, 1)).astype(np.uint8)).save(file, quality=95)


def show_where(scene: Mapping[str, Any], thing: str, views: Sequence[Camera], folder: Path, finer: int = 3) -> None:
    """Write masks of a scene's object: pixels where most of ``finer`` squared samples hit it."""
    from mitsplat.renderer.rays.device_arrays import ray_scene

    ensure_variant()
    folder.mkdir(parents=True, exist_ok=True)
    loaded, alone = ray_scene(scene), ray_scene({thing: scene[thing]})
    depths = mi.load_dict({"type": "aov", "aovs": "depth:depth"})
    sensors = Sensors()
    for name, camera in by_name(views).items():
        fine = sensors.like(camera.resized(finer * camera.width, finer * camera.height))
        near, own = (
            np.array(mi.render(shown, integrator=depths, sensor=fine, spp=1, seed=7))[..., -1]
            for shown in (loaded, alone)
        )
        shown = (own > 0) & (np.abs(own - near) < 1e-4 * np.maximum(own, near))
        seen = shown.reshape(camera.height, finer, camera.width, finer).mean(axis=(1, 3)) >= 0.5
        Image.fromarray(np.uint8(255) * seen.astype(np.uint8)).save(folder / name)


def speckle(rng: np.random.Generator, size: int, colour: tuple[float, float, float]) -> np.ndarray:
    """Return a texture of random brightness, (size, size, 3)."""
    return np.clip(np.array(colour) * rng.uniform(0.1, 1.3, (size, size, 1)), 0, 1).astype(np.float32)


def paint(texture: np.ndarray) -> dict[str, Any]:
    """Return a matt material with this texture, first row at the top."""
    bitmap = mi.Bitmap(np.ascontiguousarray(texture[::-1], dtype=np.float32))
    colour = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}
