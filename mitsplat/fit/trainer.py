"""Fit of splats to captures: 3D Gaussian splatting (Kerbl et al. 2023) with this package's differentiable renderer.

Gaussians start at the points of the capture and are densified (:mod:`mitsplat.fit.strategy_mcmc`). The files of a fit
are described in :mod:`mitsplat.fit.fit_folder`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsplat.arguments import check_type, path_of
from mitsplat.arrays import AnyArray
from mitsplat.capture.capture import HELD_OUT_EVERY, Capture, Photo, Window
from mitsplat.errors import InputError
from mitsplat.fit.depth_priors import DepthMap, DepthMaps, align_maps, crop_map
from mitsplat.fit.fit_folder import FitFolder, FitResult
from mitsplat.fit.fit_settings import FitProgress, FitSettings
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.fit.initial_points import seed_points
from mitsplat.fit.optimizer import QUALITY, Adam, GaussianModel
from mitsplat.fit.photo_loss import LossConstants, depth_image, photo_gradients
from mitsplat.fit.strategy_mcmc import Densification, Mcmc, seed_splats
from mitsplat.fit.training_view import HeldOut, TrainingView
from mitsplat.fit.windows import object_windows
from mitsplat.quality import Quality
from mitsplat.renderer.differentiation.backward import DepthRendering
from mitsplat.renderer.rays.device_arrays import on_device
from mitsplat.runtime.cores import usable_cores
from mitsplat.runtime.variant import ensure_variant
from mitsplat.storage.content_hash import ContentHash
from mitsplat.version import __version__

_REPORT_STEPS = 25
"""Steps between reports; reading a loss waits for the device."""
_ENOUGH_STEPS = 0.5
"""Least share of the stated steps that a time limit should allow; a warning states a smaller one."""
_MAX_READERS = 16
"""Largest number of photos that are read in parallel.

With this number, reading takes less time than the fit on a GPU. A photo of 24 megapixels takes up to 0.6 GB meanwhile,
as two float copies.
"""
_EXTENT = 1.1
_CHECKPOINT_SECONDS = 60.0
_VALIDATION_INTERVAL = 0.05
"""Share of the schedule between evaluations of the validation photos."""
_DEPTH_INTERVAL = 4
"""Steps between steps with a depth loss, which doubles the time of a step."""
_FINAL_MAP_WEIGHT = 0.01
"""Final weight of depth maps relative to the initial one (Kerbl et al. 2024, as published for 3DGS)."""


def fit_capture(
    capture: Capture,
    out: str | Path,
    settings: FitSettings | None = None,
    *,
    depths: DepthMaps | None = None,
    densification: Densification | None = None,
    overwrite: bool = False,
    progress: Callable[[FitProgress], None] | None = None,
) -> FitResult:
    """Fit splats to the training photos of a capture, or resume an interrupted fit.

    Runs with equal inputs give equal splats on the same device, resumed or not, unless ``settings.budget`` is set.

    Args:
        capture: Photos, cameras, points.
        out: Folder of the fit.
        settings: Settings of the fit; by default those of :class:`FitSettings`.
        depths: Depth maps of photos, which replace the visible points in the depth loss.
        densification: New strategy that adds and removes Gaussians; :class:`~mitsplat.fit.strategy_mcmc.Mcmc` if None.
        overwrite: True to replace files of other inputs, or damaged files, in the folder.
        progress: Called every few steps.

    Raises:
        InputError: If there are too few photos, a photo or a depth map cannot be read, or the folder contains another
            fit.
    """
    check_type(capture, Capture, "capture", "read a folder with mitsplat.Capture.load")
    settings = FitSettings() if settings is None else settings
    check_type(settings, FitSettings, "settings", "for example mitsplat.FitSettings(iterations=1000)")
    out = path_of(out, "out")
    training, held_out = _usable_photos(capture.training, settings), _usable_photos(capture.held_out, settings)
    if not (training and held_out):
        raise InputError(
            "a fit needs a training photo and a held-out photo, with masks if any photo has one "
            f"(got {len(training)} of {len(capture.training)} and {len(held_out)} of {len(capture.held_out)})"
        )
    validation: tuple[Photo, ...] = ()
    if settings.target_psnr is not None:
        training, validation = _split_validation(training)
    ensure_variant()
    folder = FitFolder(Path(out), _input_hash(capture, settings, depths, densification))
    if not overwrite:
        folder.refuse_others()
    done = folder.finished(overwrite=overwrite)
    if done is not None:
        return done
    state = folder.checkpoint(overwrite=overwrite)
    maps, warnings = ({}, ()) if depths is None else align_maps(training, capture.points, depths, settings.max_size)
    fit = _Fit(capture, training, validation, settings, maps, densification)
    if state is not None:
        fit.restore(state)
    held = [_training_view(photo, settings) for photo in held_out]
    folder.start(resumed=state is not None)
    _run_steps(fit, folder, progress)
    seconds = fit.elapsed
    result = FitResult(
        splats=fit.model.splats(),
        iterations=fit.steps,
        seconds=seconds,
        held_out=fit.evaluate(held, folder.held_out),
        inputs=folder.inputs,
        warnings=(*warnings, *_budget_warnings(fit, seconds)),
        validation=fit.evaluate(fit.validation, None),
    )
    folder.save(result, {"units": capture.units, "variant": mi.variant(), "settings": asdict(settings)})
    return result


def _budget_warnings(fit: _Fit, seconds: float) -> list[str]:
    """Return a warning if the budget ended the fit after ``seconds``, early in its schedule."""
    budget, iterations = fit.settings.budget, fit.settings.iterations
    if budget is None or seconds < budget or fit.steps >= iterations * _ENOUGH_STEPS:
        return []
    return [f"the budget of {budget:g} s allowed only {fit.steps} of {iterations} steps; a longer fit is sharper"]


def _run_steps(fit: _Fit, folder: FitFolder, progress: Callable[[FitProgress], None] | None) -> None:
    """Make the steps that are left, up to the end of the schedule or the target PSNR, and write checkpoints."""
    saved, target = time.monotonic(), fit.settings.target_psnr
    while fit.fraction < 1:
        fit.step()
        if fit.steps % _REPORT_STEPS and fit.fraction < 1:
            continue
        now = fit.report()
        if progress is not None:
            progress(now)
        if target is not None and (now.validation or 0) >= target:
            return
        if time.monotonic() - saved > _CHECKPOINT_SECONDS:
            folder.save_checkpoint(fit.state())
            saved = time.monotonic()


class _Fit:
    """State of a fit between two steps."""

    def __init__(
        self,
        capture: Capture,
        training: tuple[Photo, ...],
        validation: tuple[Photo, ...],
        settings: FitSettings,
        maps: Mapping[str, DepthMap],
        densification: Densification | None = None,
    ) -> None:
        self.settings, self.points = settings, capture.points
        with ThreadPoolExecutor(min(_MAX_READERS, usable_cores())) as threads:
            cut = settings.crop and settings.masks == "alpha" and all(photo.mask is not None for photo in training)
            windows = object_windows(training) if cut else [None] * len(training)
            self.photos = list(
                threads.map(
                    lambda photo, window: _training_view(photo, settings, maps.get(photo.name), window),
                    training,
                    windows,
                )
            )
            if settings.coarse > 0:
                list(threads.map(lambda view: view.half, self.photos))
            self.validation = list(threads.map(lambda photo: _training_view(photo, settings), validation))
        centres = np.array([photo.camera.centre for photo in training])
        self.extent = _EXTENT * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max(initial=0))
        rng = np.random.default_rng([settings.seed, 0])
        subject = settings.masks == "alpha" and any(photo.masked for photo in self.photos)
        masks = [photo.mask for photo in self.photos] if subject else None
        cameras = [photo.camera for photo in self.photos]
        seen = [photo.seen for photo in training]
        points, colours = seed_points(capture.points, capture.colours, cameras, seen, masks, rng, settings.gaussians)
        self.extent = self.extent or float(np.linalg.norm(points - centres[0], axis=1).mean())
        self.model = GaussianModel(seed_splats(points, colours, settings.sh_degree), self.extent)
        self.densification = densification or Mcmc(
            settings.gaussians, self.model.count, settings.refine_every, settings.seed
        )
        self.steps, self.seconds = 0, 0.0
        self.errors: list[mi.Float] = []
        self.began = time.monotonic()
        self.last_validation, self.validation_psnr = 0.0, float("nan")

    @property
    def elapsed(self) -> float:
        """Duration of the fit over all runs [s]."""
        return self.seconds + time.monotonic() - self.began

    @property
    def fraction(self) -> float:
        """Finished share of the schedule."""
        s = self.settings
        spent = self.elapsed / s.budget if s.budget else 0.0
        return min(1.0, max(self.steps / s.iterations, spent))

    def step(self) -> None:
        """Fit one photo, and change the number and the positions of Gaussians."""
        s, fraction = self.settings, self.fraction
        epoch, turn = divmod(self.steps, len(self.photos))
        number = int(np.random.default_rng([s.seed, 1, epoch]).permutation(len(self.photos))[turn])
        rng = np.random.default_rng([s.seed, 2, self.steps])
        view = self.photos[number].half if fraction < s.coarse else self.photos[number]
        degree = min(s.sh_degree, int(5 * fraction))
        error = self._backpropagate(view, replace(QUALITY, sh_degree=degree), fraction, rng)
        self.densification.accumulate(self.model, view.camera)
        rate = s.rate_means * 0.01**fraction
        self.model.update(
            {
                "means": rate,
                "quats": s.rate_quats,
                "scales": s.rate_scales,
                "opacities": s.rate_opacities,
                "sh": self.model.sh_rates(s.rate_sh, s.rate_sh / 20),
            }
        )
        self.steps += 1
        self.densification.refine(self.model, self.steps, fraction, rate, rng)
        self.errors.append(error)

    def _depth_weight(self, view: TrainingView, fraction: float) -> float:
        """Return the weight of the depth loss of a photo in this step."""
        if self.steps % _DEPTH_INTERVAL:
            return 0.0
        return self.settings.depth_weight * (1 if view.inverse_depth is None else _FINAL_MAP_WEIGHT**fraction)

    def _backpropagate(
        self, view: TrainingView, quality: Quality, fraction: float, rng: np.random.Generator
    ) -> mi.Float:
        """Set the parameter gradients of the loss of a photo, and return its mean squared error."""
        s = self.settings
        weight = self._depth_weight(view, fraction)
        pixel, inverse = view.depths(self.points) if weight > 0 else (mi.UInt32(), mi.Float())
        known = dr.width(pixel)
        seen = self.model.render(view.eye, quality, depth=known > 0)
        behind = rng.random(3) if s.background == "random" else np.zeros(3)
        numbers = on_device(*behind, weight * self.extent, 1 / max(known, 1))
        constants = LossConstants(
            view.camera.width,
            view.camera.height,
            s.ssim_share,
            s.alpha_weight if s.masks == "alpha" and view.masked else None,
            background=s.background == "random",
        )
        depth = (seen.moment, depth_image(view.camera, pixel, inverse)) if isinstance(seen, DepthRendering) else None
        rgb, alpha, moment, error = photo_gradients(
            seen.rgb, seen.alpha, depth, (view.packed, view.hidden), numbers, constants
        )
        records = [seen.gradient(rgb, alpha)]
        if isinstance(seen, DepthRendering):
            records.append(seen.gradient_of_moment(moment))
        count = self.model.count
        self.model.set_gradients(
            view.eye,
            quality,
            records,
            opacity_weight=s.opacity_weight / count,
            scale_weight=s.scale_weight / (3 * count * self.extent),
        )
        return error

    def report(self) -> FitProgress:
        """Return the progress, and evaluate the validation photos at intervals."""
        error = float(np.mean([e.numpy()[0] for e in self.errors]))
        self.errors = []
        fraction = self.fraction
        if self.validation and (fraction >= self.last_validation + _VALIDATION_INTERVAL or fraction >= 1):
            self.last_validation = fraction
            self.validation_psnr = float(np.mean([photo.psnr for photo in self.evaluate(self.validation, None)]))
        validation_psnr = None if np.isnan(self.validation_psnr) else self.validation_psnr
        return FitProgress(self.steps, fraction, psnr_of(error), validation_psnr, self.model.count)

    def evaluate(self, photos: Sequence[TrainingView], folder: Path | None) -> tuple[HeldOut, ...]:
        """Evaluate photos that are not fitted, and write a comparison of each to the folder if it is not None."""
        quality = replace(QUALITY, sh_degree=self.settings.sh_degree)
        return tuple(view.compare(view.render(self.model, quality)[0], folder) for view in photos)

    def state(self) -> dict[str, AnyArray | float]:
        """Return everything that determines the rest of the fit after a report, as arrays for :meth:`restore`."""
        own = {
            "steps": self.steps,
            "seconds": self.elapsed,
            "last_validation": self.last_validation,
            "validation_psnr": self.validation_psnr,
        }
        return own | {f"{name}.{k}": v for name, part in self._stateful_parts.items() for k, v in part.state().items()}

    def restore(self, state: Mapping[str, AnyArray]) -> None:
        """Restore a state from :meth:`state`."""
        self.steps, self.seconds = int(state["steps"]), float(state["seconds"])
        self.last_validation, self.validation_psnr = float(state["last_validation"]), float(state["validation_psnr"])
        for name, part in self._stateful_parts.items():
            part.restore({k.removeprefix(f"{name}."): v for k, v in state.items() if k.startswith(f"{name}.")})

    @property
    def _stateful_parts(self) -> dict[str, Adam | Densification]:
        """Parts with a state that changes in every step, by their names in checkpoints."""
        return {"model": self.model, "densification": self.densification}


def _usable_photos(photos: tuple[Photo, ...], settings: FitSettings) -> tuple[Photo, ...]:
    """Return the photos; if some have masks, drop those without, because they show more than the object."""
    masked = tuple(photo for photo in photos if photo.mask is not None)
    return photos if settings.masks == "off" or not masked else masked


def _split_validation(training: tuple[Photo, ...]) -> tuple[tuple[Photo, ...], tuple[Photo, ...]]:
    """Split photos into training and validation photos; the middle one of every eight, or the last, is for validation.

    Raises:
        InputError: If there is only one photo.
    """
    if len(training) < 2:
        raise InputError(f"target_psnr needs at least two photos besides the held-out ones (got {len(training)})")
    validation = training[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY] or training[-1:]
    return tuple(photo for photo in training if photo not in validation), validation


def _training_view(
    photo: Photo, settings: FitSettings, inverse_depth: DepthMap | None = None, window: Window | None = None
) -> TrainingView:
    camera = photo.camera
    if window is not None:
        camera = camera.cropped(*window)
        inverse_depth = None if inverse_depth is None else crop_map(inverse_depth, photo.camera, window)
    scale = min(1.0, settings.max_size / max(camera.size))
    return TrainingView(photo, scale, masked=settings.masks != "off", inverse_depth=inverse_depth, window=window)


def _input_hash(
    capture: Capture, settings: FitSettings, depths: DepthMaps | None, densification: Densification | None
) -> str:
    """Return the SHA-256 of all inputs of a fit."""
    digest = ContentHash(capture.content_hash)
    fields = getattr(densification, "__dict__", {})
    options = {name: value for name, value in fields.items() if isinstance(value, int | float | str)}
    digest.add_json([__version__, asdict(settings), type(densification).__name__, options])
    if depths is not None:
        digest.add(depths.kind)
        for name, file in sorted(depths.files.items()):
            digest.add(name)
            digest.add_file(file)
    return digest.hexdigest()
