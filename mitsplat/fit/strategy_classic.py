"""Adaptive density control, the densification that 3DGS was published with (Kerbl et al. 2023, section 5).

Where photos pull at the place of a Gaussian in the image, too few of them stand for too much: small ones are cloned,
large ones split in two. What is transparent or too large is removed, and opacities are lowered now and then, so that
only what the photos want becomes opaque again. Constants are those of the published code and of gsplat's
``DefaultStrategy``; spans of steps are kept as shares of the fit, for the published one has 30,000 steps.
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
from mitsplat.fit.strategy_mcmc import DEAD
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.rays.device_arrays import wrapped

_REFINED = (1 / 60, 0.5)
"""Shares of the fit between which Gaussians are added and removed."""
_RESET_EVERY = 0.1
"""Share of the fit between resets of the opacities."""
_RESET_STEPS = 300
"""Steps between them at least: Adam needs a hundred at its rate to make a Gaussian half opaque again."""
_RESET_TO = 2 * DEAD
_GRADIENT_MIN = 2e-4
"""Mean gradient in the image from which a Gaussian is cloned or split; the image is 2 wide and 2 high."""
_SMALL = 0.01
"""Largest scale of a Gaussian that is cloned and not split, in the model's unit."""
_LARGE = 0.1
"""Scale in the model's unit from which a Gaussian is removed, once opacities have been reset."""
_SHRINK = 1.6
_REACH = 3.0
"""Standard deviations up to which a Gaussian is in an image, as published."""


class Classic:
    """Clones, splits, removals and resets.

    Args:
        most: Most Gaussians; if more are wanted, those with the largest gradients come first.
        every: Steps between changes.
    """

    scale_weight = 0.0

    def __init__(self, most: int, every: int) -> None:
        self._most, self._every = most, every
        self._reset_step, self._reset_fraction = 0, 0.0
        self._pull: Any = mi.Float(0)
        self._photos: Any = mi.Float(0)

    def look(self, model: GaussianModel, camera: Camera) -> None:
        """Add the gradients of a photo to those since the last change."""
        pull, seen = image_gradient(model, camera)
        self._pull += dr.select(seen, pull, 0)
        self._photos += dr.select(seen, mi.Float(1), 0)
        dr.eval(self._pull, self._photos)

    def refine(self, model: GaussianModel, step: int, fraction: float, rate: float, rng: np.random.Generator) -> None:
        """Clone, split and remove now and then, and reset opacities more rarely."""
        if not (_REFINED[0] <= fraction < _REFINED[1] and step % self._every == 0):
            return
        pull = np.array(self._pull / dr.maximum(self._photos, 1), dtype=np.float64)
        control_density(model, pull, self._most, rng, remove_large=self._reset_step > 0)
        self._pull, self._photos = mi.Float(0), mi.Float(0)  # two, for they are added to in place
        if fraction - self._reset_fraction >= _RESET_EVERY and step - self._reset_step >= _RESET_STEPS:
            self._reset_step, self._reset_fraction = step, fraction
            lower_opacities(model)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Gradients and photos since the last change, and when opacities were reset."""
        reset = np.array([self._reset_step, self._reset_fraction])
        return {"pull": np.array(self._pull), "photos": np.array(self._photos), "reset": reset}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what :meth:`state` gave."""
        self._pull, self._photos = (wrapped(mi.Float, state[name]) for name in ("pull", "photos"))
        self._reset_step, self._reset_fraction = int(state["reset"][0]), float(state["reset"][1])


def image_gradient(model: GaussianModel, camera: Camera) -> tuple[Any, Any]:
    """How strongly the loss pulls at the places of Gaussians in an image, and which of them are in it, on the device.

    A mean m that moves by dX along the camera's x axis at depth z moves in the image by fx dX / z pixels. So the
    gradient with respect to its place (u, v) follows from that with respect to the mean:

        dL/du = (dL/dm . e_x) z / fx,    dL/dv = (dL/dm . e_y) z / fy,

    times half of the image's width and height, because the published threshold is for an image 2 wide and 2 high.
    Unlike the published gradient, this one holds what a move changes beside the place: the footprint's perspective and
    the direction from which colours are seen. A lens's distortion is left out.

    Args:
        model: Gaussians whose means have gradients.
        camera: Of the photo that they are of.

    Returns:
        Norm of the gradient, and whether a Gaussian's sphere of three standard deviations reaches into the image and
        not to the camera's plane, both of width N.
    """
    i = dr.arange(mi.UInt32, model.count)
    axes = [mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in axis)) for axis in camera.world_from_camera[:3, :3].T]
    centre = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in camera.centre / model.unit))
    means, log_scales = dr.detach(model.values["means"]), dr.detach(model.values["scales"])
    place = dr.gather(mi.Vector3f, means, i) - centre
    pull = dr.gather(mi.Vector3f, dr.grad(model.values["means"]), i)
    x, y, z = (dr.dot(axis, place) for axis in axes)
    reach = _REACH * dr.exp(dr.max(dr.gather(mi.Vector3f, log_scales, i)))
    seen = z - reach > dr.opaque(mi.Float, camera.near / model.unit)
    total = mi.Float(0)
    for axis, offset, focal, middle, size in (
        (axes[0], x, camera.fx, camera.cx, camera.width),
        (axes[1], y, camera.fy, camera.cy, camera.height),
    ):
        # In the model's unit as well as in metres: lengths in z and in the gradient cancel.
        total += dr.square(dr.dot(axis, pull) * z * dr.opaque(mi.Float, 0.5 * size / focal))
        low, high = dr.opaque(mi.Float, -middle / focal), dr.opaque(mi.Float, (size - middle) / focal)
        seen &= (offset + reach > low * z) & (offset - reach < high * z)
    return dr.select(dr.isfinite(total), dr.sqrt(total), 0), seen


def control_density(
    model: GaussianModel, pull: Float64Array, most: int, rng: np.random.Generator, *, remove_large: bool
) -> None:
    """Clone or split Gaussians whose mean gradient in the image is large, and remove those that show nothing.

    A clone lies on what it was made of, and Adam's moments pull only that away. The two parts of a split one are drawn
    from it, with scales smaller by 1.6.

    Args:
        model: The Gaussians, N.
        pull: Mean norm of :func:`image_gradient`, shape (N,).
        most: Number that may not be exceeded.
        rng: Draws the places of parts.
        remove_large: Whether Gaussians of more than a tenth of the model's unit are removed as well.
    """
    scales = np.exp(np.array(dr.detach(model.values["scales"]), dtype=np.float64)).reshape(-1, 3)
    size = scales.max(axis=1)
    useless = np.array(dr.detach(model.activated()[3])) < DEAD
    if remove_large:
        useless |= size > _LARGE
    if useless.all():
        return
    kept, wanted = np.flatnonzero(~useless), np.flatnonzero(~useless & (pull > _GRADIENT_MIN))
    wanted = wanted[np.argsort(-pull[wanted], kind="stable")][: max(0, most - len(kept))]
    split = np.zeros(len(scales), dtype=bool)
    split[wanted] = size[wanted] > _SMALL
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
    """Make no Gaussian more opaque than twice the opacity at which it is removed; opacities lose Adam's moments."""
    most = dr.opaque(mi.Float, float(np.log(_RESET_TO / (1 - _RESET_TO))))
    model.values["opacities"] = dr.minimum(dr.detach(model.values["opacities"]), most)
    for moments in (model.first, model.second):
        moments["opacities"] = dr.zeros(mi.Float, model.count)
    dr.eval(model.values, model.first, model.second)
