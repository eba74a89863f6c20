"""Initial Gaussians, and the densification of "3D Gaussian splatting as Markov chain Monte Carlo".

Kheradmand et al. 2024 treat the Gaussians as samples of a distribution. Noise moves Gaussians of low opacity. Dead
Gaussians move to positions of opaque ones, and new Gaussians are added there. The rendered image stays the same: n
Gaussians that replace one have the opacity ``1 - (1 - o)^(1/n)`` and scales by eq. 9 of the paper. A fit accepts other
strategies by the protocol :class:`Densification`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree
from scipy.special import comb

from mitsplat.arrays import AnyArray, Float64Array
from mitsplat.fit.optimizer import GaussianModel
from mitsplat.gaussians.spherical_harmonics import rgb_to_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.projection.gaussian import rotation_axes
from mitsplat.renderer.rays.device_arrays import number, on_device, wrapped
from mitsplat.runtime.recorded_kernels import recorded

DEAD_OPACITY = 0.005
"""Opacity below which a Gaussian counts as dead and is relocated."""

_ACTIVE_RANGE = (0.02, 0.8)
"""Range of the fit, as shares, in which MCMC relocates and adds Gaussians."""
_GROWTH = 1.05
_COPIES_MAX = 51
_NOISE = 5e5
"""Noise per learning rate of the means; means and covariance are in the model's unit."""

_BINOMIALS = np.array(
    [[comb(n, k) * (-1) ** k / np.sqrt(k + 1) for k in range(_COPIES_MAX)] for n in range(_COPIES_MAX)]
)


class Densification(Protocol):
    """Strategy that changes the number and the positions of Gaussians during a fit."""

    def accumulate(self, model: GaussianModel, camera: Camera) -> None:
        """Accumulate the gradients of a photo by this camera, before the optimiser step."""

    def refine(self, model: GaussianModel, step: int, fraction: float, rate: float, rng: np.random.Generator) -> None:
        """Change the Gaussians after a step.

        Args:
            model: The Gaussians; changed in place.
            step: Number of finished steps.
            fraction: Share of the fit's schedule before this step.
            rate: Learning rate of the means.
            rng: Random number generator of the step.
        """

    def state(self) -> dict[str, AnyArray]:
        """Return the state as arrays for :meth:`restore`."""

    def restore(self, state: Mapping[str, AnyArray]) -> None:
        """Restore a state from :meth:`state`."""


class Mcmc:
    """Markov chain Monte Carlo densification.

    Args:
        most: Largest number of Gaussians; their number grows to this by the middle of the fit.
        start: Initial number of Gaussians.
        every: Steps between relocations and additions.
        seed: Seed of the noise.
    """

    def __init__(self, most: int, start: int, every: int, seed: int) -> None:
        self._most, self._start, self._every, self._seed = most, start, every, seed

    def accumulate(self, model: GaussianModel, camera: Camera) -> None:
        """Do nothing, because MCMC depends only on opacities."""

    def refine(self, model: GaussianModel, step: int, fraction: float, rate: float, rng: np.random.Generator) -> None:
        """Relocate dead Gaussians and add new ones at intervals, and add noise in every step."""
        if _ACTIVE_RANGE[0] <= fraction < _ACTIVE_RANGE[1] and step % self._every == 0:
            relocate(model, rng)
            grow(model, self._target_count(model.count, fraction), rng)
        jitter(model, rate, (self._seed, step))

    def state(self) -> dict[str, AnyArray]:
        """Return no state."""
        return {}

    def restore(self, state: Mapping[str, AnyArray]) -> None:
        """Do nothing, because there is no state."""

    def _target_count(self, count: int, fraction: float) -> int:
        """Return the target number of Gaussians: 5 % growth each time as published, or more in short fits."""
        share = min(1.0, (fraction - _ACTIVE_RANGE[0]) / (0.5 - _ACTIVE_RANGE[0]))
        planned = self._start * (self._most / self._start) ** share
        return min(self._most, int(max(planned, _GROWTH * count)))


def seed_splats(points: Float64Array, colours: Float64Array, sh_degree: int) -> Splats:
    """Return isotropic, half opaque Gaussians at points.

    Their standard deviation is half the mean distance to the three nearest neighbours.

    Args:
        points: Centres, shape (N, 3), N > 1.
        colours: Display-encoded colours in [0, 1], shape (N, 3).
        sh_degree: Degree of the spherical harmonics; all but the constant ones are zero.
    """
    distance, _ = KDTree(points).query(points, k=min(4, len(points)))
    near = distance[:, 1:].mean(axis=1)
    near = np.clip(near, 0.05 * np.median(near) + 1e-9, 20 * np.median(near) + 1e-9)
    sh = np.zeros((len(points), (sh_degree + 1) ** 2, 3))
    sh[:, 0] = rgb_to_sh(colours)
    return Splats(
        means=points.astype(np.float32),
        quats=np.tile(np.array([0, 0, 0, 1], dtype=np.float32), (len(points), 1)),
        scales=np.repeat(0.5 * near[:, None], 3, axis=1).astype(np.float32),
        opacities=np.full(len(points), 0.5, dtype=np.float32),
        sh=sh.astype(np.float32),
    )


def relocate(model: GaussianModel, rng: np.random.Generator) -> int:
    """Move dead Gaussians to positions of opaque ones, and return their number."""
    opacities = np.array(dr.detach(model.activated()[3]), dtype=np.float64)
    dead = opacities <= DEAD_OPACITY
    if not dead.any() or dead.all():
        return 0
    rows = np.arange(len(opacities))
    rows[dead] = _draw(opacities * ~dead, int(dead.sum()), rng)
    _replace_rows(model, rows, opacities)
    return int(dead.sum())


def grow(model: GaussianModel, count: int, rng: np.random.Generator) -> None:
    """Add Gaussians at positions drawn by opacity, up to a total of ``count``."""
    opacities = np.array(dr.detach(model.activated()[3]), dtype=np.float64)
    missing = count - len(opacities)
    if missing > 0:
        _replace_rows(model, np.r_[np.arange(len(opacities)), _draw(opacities, missing, rng)], opacities)


def jitter(model: GaussianModel, rate: float, seed: Sequence[int]) -> None:
    """Add noise to means within the shape of each Gaussian, less for higher opacity (eq. 8 of the paper).

    Args:
        model: The Gaussians.
        rate: Learning rate of the means.
        seed: Two numbers that determine the noise, such as seed and step.
    """
    p = dr.detach(model.values)
    numbers = wrapped(mi.UInt32, np.array([int(value) % 2**32 for value in seed], dtype=np.uint32))
    shape = p["scales"], p["quats"], p["opacities"]
    model.values["means"] = _jittered(p["means"], *shape, on_device(_NOISE * rate), numbers)


@recorded
def _jittered(
    means: mi.Float, scales: mi.Float, quats: mi.Float, opacities: mi.Float, size: mi.Float, seed: mi.UInt32
) -> mi.Float:
    """Return the flat means with the noise of :func:`jitter`, from logarithms of scales and logits of opacities.

    ``size`` is one number, the factor of the noise. ``seed`` has two.
    """
    i = dr.arange(mi.UInt32, dr.width(opacities))
    sigma = dr.exp(dr.gather(mi.Vector3f, scales, i))
    axes = rotation_axes(dr.normalize(dr.gather(mi.Array4f, quats, i)))
    key, step = (dr.gather(mi.UInt32, seed, place) for place in range(2))
    first = mi.sample_tea_32(i, key + 0x9E3779B9 * step)
    second = mi.sample_tea_32(first[0], first[1])
    uniform = [mi.Float(v >> 8) * 2.0**-24 for v in (*first, *second)]  # below 1, which has no finite normal deviate
    x, y = mi.warp.square_to_std_normal(mi.Point2f(*uniform[:2]))
    z, _ = mi.warp.square_to_std_normal(mi.Point2f(*uniform[2:]))
    noise = mi.Vector3f(x, y, z)
    faint = dr.rcp(1 + dr.exp(-100 * (DEAD_OPACITY - dr.rcp(1 + dr.exp(-opacities)))))
    gain = number(size, 0) * faint
    moved = dr.gather(mi.Vector3f, means, i)
    for axis, s in zip(axes, sigma, strict=True):
        moved += axis * (dr.dot(axis, noise) * s * s * gain)
    result = dr.empty(mi.Float, dr.width(means))
    dr.scatter(result, moved, i)
    return result


def _draw(weights: Float64Array, count: int, rng: np.random.Generator) -> npt.NDArray[np.intp]:
    return rng.choice(len(weights), count, p=weights / weights.sum())


def _replace_rows(model: GaussianModel, rows: npt.NDArray[np.intp], opacities: Float64Array) -> None:
    """Replace the Gaussians by the selected rows; copies of one row share its opacity and size."""
    copies = np.bincount(rows, minlength=len(opacities))
    several = copies > 1
    opacity, factor = split_opacity(opacities[several], copies[several])
    log_factor, logit = np.zeros(len(opacities)), np.zeros(len(opacities))
    log_factor[several] = np.log(factor)
    opacity = np.clip(opacity, DEAD_OPACITY, 1 - 1e-6)
    logit[several] = np.log(opacity / (1 - opacity))
    changed = several[rows]
    model.take(rows.astype(np.uint32), model.widths, changed)
    own = wrapped(mi.Bool, changed)
    model.values["opacities"] = dr.select(
        own, wrapped(mi.Float, logit[rows].astype(np.float32)), model.values["opacities"]
    )
    model.values["scales"] += wrapped(mi.Float, np.repeat(log_factor[rows], 3).astype(np.float32))
    dr.eval(model.values)


def split_opacity(opacities: Float64Array, copies: npt.NDArray[np.intp]) -> tuple[Float64Array, Float64Array]:
    """Return the opacity of each of n coincident Gaussians that replace one, and the factor on its scales (eq. 9).

    ``opacities`` and ``copies`` (n) have the shape (N,), and so have the results.
    """
    copies = np.minimum(copies, _COPIES_MAX)
    opacity = 1 - (1 - opacities) ** (1 / copies)
    total = np.zeros(len(opacities))
    for n in range(int(copies.max(initial=0))):
        powers = opacity[:, None] ** (np.arange(n + 1) + 1)
        total += np.where(n < copies, powers @ _BINOMIALS[n, : n + 1], 0.0)
    return opacity, opacities / total
