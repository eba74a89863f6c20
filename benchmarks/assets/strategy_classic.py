"""Adaptive density control, the original densification of 3DGS (Kerbl et al. 2023, section 5).

A large image-space position gradient indicates too few Gaussians in an area. Small Gaussians there are cloned, and
large ones are split in two. Transparent or too large Gaussians are removed. Opacities are lowered at intervals, so that
only Gaussians that the photos need become opaque again. Constants are those of the published code and of gsplat's
``DefaultStrategy``. Step ranges are shares of the fit, because the published fit has 30,000 steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.fit.optimizer import GaussianModel
from mitsplat.fit.strategy_mcmc import DEAD_OPACITY
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.rays.device_arrays import wrapped

_ACTIVE_RANGE = (1 / 60, 0.5)
"""Range of the fit, as shares, in which Gaussians are added and removed."""
_RESET_EVERY = 0.1
"""Share of the fit between opacity resets."""
_RESET_STEPS = 300
"""Least number of steps between opacity resets; Adam needs 100 steps to make a Gaussian half opaque again."""
_RESET_OPACITY = 2 * DEAD_OPACITY
_GRADIENT_MIN = 2e-4
"""Mean image-space gradient above which a Gaussian is cloned or split; the image is 2 wide and 2 high."""
_MAX_CLONE_SCALE = 0.01
"""Largest scale of a Gaussian that is cloned instead of split, in the model's unit."""
_MAX_SCALE = 0.1
"""Scale above which a Gaussian is removed after the first opacity reset, in the model's unit."""
_SHRINK = 1.6
_RADIUS_SIGMAS = 3.0
"""Radius of a Gaussian in the visibility test [standard deviations], as published."""


class Classic:
    """Densification by clones, splits, removals and opacity resets.

    Args:
        most: Largest number of Gaussians; at this limit, those with the largest gradients have priority.
        every: Steps between changes.
    """

    def __init__(self, most: int, every: int) -> None:
        self._most, self._every = most, every
        self._reset_step, self._reset_fraction = 0, 0.0
        self._gradient_sum: Any = mi.Float(0)
        self._photo_counts: Any = mi.Float(0)

    def accumulate(self, model: GaussianModel, camera: Camera) -> None:
        """Accumulate the gradients of a photo since the last change."""
        pull, seen = image_gradient(model, camera)
        self._gradient_sum += dr.select(seen, pull, 0)
        self._photo_counts += dr.select(seen, mi.Float(1), 0)
        dr.eval(self._gradient_sum, self._photo_counts)

    def refine(self, model: GaussianModel, step: int, fraction: float, rate: float, rng: np.random.Generator) -> None:
        """Clone, split and remove Gaussians at intervals, and reset opacities at longer intervals."""
        if not (_ACTIVE_RANGE[0] <= fraction < _ACTIVE_RANGE[1] and step % self._every == 0):
            return
        pull = np.array(self._gradient_sum / dr.maximum(self._photo_counts, 1), dtype=np.float64)
        control_density(model, pull, self._most, rng, remove_large=self._reset_step > 0)
        self._gradient_sum, self._photo_counts = (
            mi.Float(0),
            mi.Float(0),
        )  # two arrays, because both are accumulated in place
        if fraction - self._reset_fraction >= _RESET_EVERY and step - self._reset_step >= _RESET_STEPS:
            self._reset_step, self._reset_fraction = step, fraction
            lower_opacities(model)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return the accumulated gradients and photo counts, and the time of the last opacity reset."""
        reset = np.array([self._reset_step, self._reset_fraction])
        return {"pull": np.array(self._gradient_sum), "photos": np.array(self._photo_counts), "reset": reset}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Restore a state from :meth:`state`."""
        self._gradient_sum, self._photo_counts = (wrapped(mi.Float, state[name]) for name in ("pull", "photos"))
        self._reset_step, self._reset_fraction = int(state["reset"][0]), float(state["reset"][1])


def image_gradient(model: GaussianModel, camera: Camera) -> tuple[Any, Any]:
    """Compute the image-space position gradients of Gaussians, and the Gaussians in the image, on the device.

    If a mean m moves by dX along the camera's x axis at depth z, its image moves by fx dX / z pixels. So the gradient
    with respect to the image position (u, v) follows from that with respect to the mean:

        dL/du = (dL/dm . e_x) z / fx,    dL/dv = (dL/dm . e_y) z / fy,

    times half of the image's width and height, because the published threshold is for an image 2 wide and 2 high.
    Unlike the published gradient, this one includes all effects of a move: also those of the footprint's perspective
    and of the view direction on the SH colour. Lens distortion is ignored.

    Args:
        model: Gaussians whose means have gradients.
        camera: Camera of the photo behind these gradients.

    Returns:
        Norm of the gradient, and True if the sphere of three standard deviations overlaps the image and does not reach
        the near plane, both of width N.
    """
    i = dr.arange(mi.UInt32, model.count)
    axes = [mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in axis)) for axis in camera.world_from_camera[:3, :3].T]
    centre = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in camera.centre / model.unit))
    means, log_scales = dr.detach(model.values["means"]), dr.detach(model.values["scales"])
    place = dr.gather(mi.Vector3f, means, i) - centre
    pull = dr.gather(mi.Vector3f, dr.grad(model.values["means"]), i)
    x, y, z = (dr.dot(axis, place) for axis in axes)
    reach = _RADIUS_SIGMAS * dr.exp(dr.max(dr.gather(mi.Vector3f, log_scales, i)))
    seen = z - reach > dr.opaque(mi.Float, camera.near / model.unit)
    total = mi.Float(0)
    for axis, offset, focal, middle, size in (
        (axes[0], x, camera.fx, camera.cx, camera.width),
        (axes[1], y, camera.fy, camera.cy, camera.height),
    ):
        # The result is the same in the model's unit and in metres: lengths in z and in the gradient cancel.
        total += dr.square(dr.dot(axis, pull) * z * dr.opaque(mi.Float, 0.5 * size / focal))
        low, high = dr.opaque(mi.Float, -middle / focal), dr.opaque(mi.Float, (size - middle) / focal)
        seen &= (offset + reach > low * z) & (offset - reach < high * z)
    return dr.select(dr.isfinite(total), dr.sqrt(total), 0), seen


def control_density(
    model: GaussianModel, pull: Float64Array, most: int, rng: np.random.Generator, *, remove_large: bool
) -> None:
    """Clone or split Gaussians with a large mean image-space gradient, and remove transparent ones.

    A clone has the position of its original; Adam's moments move only the original away. The two parts of a split
    Gaussian are sampled from it, with scales divided by 1.6.

    Args:
        model: The Gaussians, N.
        pull: Mean norm of :func:`image_gradient`, shape (N,).
        most: Largest number of Gaussians.
        rng: Random number generator for the positions of parts.
        remove_large: True to remove also Gaussians larger than a tenth of the model's unit.
    """
    scales = np.exp(np.array(dr.detach(model.values["scales"]), dtype=np.float64)).reshape(-1, 3)
    size = scales.max(axis=1)
    transparent = np.array(dr.detach(model.activated()[3])) < DEAD_OPACITY
    if remove_large:
        transparent |= size > _MAX_SCALE
    if transparent.all():
        return
    kept, wanted = np.flatnonzero(~transparent), np.flatnonzero(~transparent & (pull > _GRADIENT_MIN))
    wanted = wanted[np.argsort(-pull[wanted], kind="stable")][: max(0, most - len(kept))]
    split = np.zeros(len(scales), dtype=bool)
    split[wanted] = size[wanted] > _MAX_CLONE_SCALE
    rows = np.concatenate([kept, wanted])
    part = split[rows]
    added = np.arange(len(rows)) >= len(kept)
    model.take(rows.astype(np.uint32), model.widths, added | part)
    turns = Rotation.from_quat(np.array(dr.detach(model.values["quats"])).reshape(-1, 4)[part])
    shift, shrink = np.zeros((2, len(rows), 3), dtype=np.float32)
    shift[part] = turns.apply(scales[rows[part]] * rng.normal(size=(part.sum(), 3)))
    shrink[part] = np.log(_SHRINK)
    model.values["means"] += wrapped(mi.Float, shift)
    model.values["scales"] -= wrapped(mi.Float, shrink)
    dr.eval(model.values)


def lower_opacities(model: GaussianModel) -> None:
    """Limit opacities to twice the removal threshold, and reset their moments."""
    most = dr.opaque(mi.Float, float(np.log(_RESET_OPACITY / (1 - _RESET_OPACITY))))
    model.values["opacities"] = dr.minimum(dr.detach(model.values["opacities"]), most)
    for moments in (model.first, model.second):
        moments["opacities"] = dr.zeros(mi.Float, model.count)
    dr.eval(model.values, model.first, model.second)
