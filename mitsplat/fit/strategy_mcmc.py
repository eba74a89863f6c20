"""Where Gaussians are: seeds for a capture, and "3D Gaussian splatting as Markov chain Monte Carlo".

Kheradmand et al. 2024 see the Gaussians as samples of a distribution. Noise moves those that are hardly opaque; dead
ones are put where others are opaque, and new ones as well, all so that the picture stays what it was: n Gaussians in
the place of one have the opacity ``1 - (1 - o)^(1/n)`` and scales by eq. 9 of the paper. The densification that 3DGS
was published with is :mod:`mitsplat.fit.strategy_classic`; a fit knows both as a :class:`Densification`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree
from scipy.special import comb

from mitsplat.arrays import Float64Array
from mitsplat.fit.optimizer import GaussianModel
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.rays.device_arrays import number, on_device, wrapped
from mitsplat.renderer.splatting.gaussian import rotation_axes
from mitsplat.runtime.recorded_kernels import recorded

DEAD = 0.005
"""Opacity below which a Gaussian is moved to where it is of use."""

_REFINED = (0.02, 0.8)
"""Shares of the fit between which MCMC moves and adds Gaussians."""
_GROWTH = 1.05
_COPIES_MAX = 51
_NOISE = 5e5
"""Size of the noise per learning rate of the means; they and the covariance are in the model's unit."""

_BINOMIALS = np.array(
    [[comb(n, k) * (-1) ** k / np.sqrt(k + 1) for k in range(_COPIES_MAX)] for n in range(_COPIES_MAX)]
)


class Densification(Protocol):
    """How a fit changes the number and the places of its Gaussians.

    Attributes:
        scale_weight: Weight of the mean scale that it needs in the loss.
    """

    scale_weight: float

    def look(self, model: GaussianModel, camera: Camera) -> None:
        """Note what the gradients of a photo by this camera say, before they are used up."""

    def refine(self, model: GaussianModel, step: int, fraction: float, rate: float, rng: np.random.Generator) -> None:
        """Change the Gaussians after a step.

        Args:
            model: The Gaussians.
            step: Steps made.
            fraction: Share of the fit's schedule that had run off before this one.
            rate: Learning rate of the means.
            rng: The step's random numbers.
        """

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """What it has noted, as arrays that :meth:`restore` takes."""

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what :meth:`state` gave."""


class Mcmc:
    """Markov chain Monte Carlo.

    Args:
        most: Most Gaussians; their number grows to this by the middle of the fit.
        start: Their number at the start.
        every: Steps between moves and additions.
        seed: Decides the jitter.
    """

    scale_weight = 0.01

    def __init__(self, most: int, start: int, every: int, seed: int) -> None:
        self._most, self._start, self._every, self._seed = most, start, every, seed

    def look(self, model: GaussianModel, camera: Camera) -> None:
        """Nothing: opacity alone decides."""

    def refine(self, model: GaussianModel, step: int, fraction: float, rate: float, rng: np.random.Generator) -> None:
        """Move dead Gaussians and add new ones now and then, and always jitter."""
        if _REFINED[0] <= fraction < _REFINED[1] and step % self._every == 0:
            relocate(model, rng)
            grow(model, self._wanted(model.count, fraction), rng)
        jitter(model, rate, (self._seed, step))

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Nothing."""
        return {}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Nothing."""

    def _wanted(self, count: int, fraction: float) -> int:
        """Number of Gaussians by now: 5 % more each time as published, or more if the fit is short."""
        share = min(1.0, (fraction - _REFINED[0]) / (0.5 - _REFINED[0]))
        planned = self._start * (self._most / self._start) ** share
        return min(self._most, int(max(planned, _GROWTH * count)))


def seed_splats(
    points: Float64Array, colours: Float64Array, sh_degree: int, *, opacity: float = 0.5, spread: float = 0.5
) -> Splats:
    """Round Gaussians at points.

    Args:
        points: Centres, shape (N, 3), N > 1.
        colours: Display-encoded, in [0, 1], shape (N, 3).
        sh_degree: Degree of the spherical harmonics; all but the constant ones are zero.
        opacity: Of every Gaussian.
        spread: Standard deviation as a share of the mean distance to the three nearest neighbours.
    """
    distance, _ = KDTree(points).query(points, k=min(4, len(points)))
    near = distance[:, 1:].mean(axis=1)
    near = np.clip(near, 0.05 * np.median(near) + 1e-9, 20 * np.median(near) + 1e-9)
    sh = np.zeros((len(points), (sh_degree + 1) ** 2, 3))
    sh[:, 0] = (colours - 0.5) / SH_C0
    return Splats(
        means=points.astype(np.float32),
        quats=np.tile(np.array([0, 0, 0, 1], dtype=np.float32), (len(points), 1)),
        scales=np.repeat(spread * near[:, None], 3, axis=1).astype(np.float32),
        opacities=np.full(len(points), opacity, dtype=np.float32),
        sh=sh.astype(np.float32),
    )


def relocate(model: GaussianModel, rng: np.random.Generator) -> int:
    """Put dead Gaussians where others are opaque; their number."""
    opacities = np.array(dr.detach(model.activated()[3]), dtype=np.float64)
    dead = opacities <= DEAD
    if not dead.any() or dead.all():
        return 0
    rows = np.arange(len(opacities))
    rows[dead] = _draw(opacities * ~dead, int(dead.sum()), rng)
    _share_out(model, rows, opacities)
    return int(dead.sum())


def grow(model: GaussianModel, count: int, rng: np.random.Generator) -> None:
    """Add Gaussians, up to so many in all, where there is opacity."""
    opacities = np.array(dr.detach(model.activated()[3]), dtype=np.float64)
    missing = count - len(opacities)
    if missing > 0:
        _share_out(model, np.r_[np.arange(len(opacities)), _draw(opacities, missing, rng)], opacities)


def jitter(model: GaussianModel, rate: float, seed: Sequence[int]) -> None:
    """Move Gaussians at random within their own shape, the less the more opaque they are (eq. 8 of the paper).

    Args:
        model: The Gaussians.
        rate: Learning rate of the means.
        seed: Two numbers that decide the noise, such as seed and step.
    """
    p = dr.detach(model.values)
    numbers = wrapped(mi.UInt32, np.array([int(value) % 2**32 for value in seed], dtype=np.uint32))
    shape = p["scales"], p["quats"], p["opacities"]
    model.values["means"] = _jittered(p["means"], *shape, on_device(_NOISE * rate), numbers)


@recorded
def _jittered(means: Any, scales: Any, quats: Any, opacities: Any, size: Any, seed: Any) -> Any:
    i = dr.arange(mi.UInt32, dr.width(opacities))
    sigma = dr.exp(dr.gather(mi.Vector3f, scales, i))
    axes = rotation_axes(dr.normalize(dr.gather(mi.Array4f, quats, i)))
    key, step = (dr.gather(mi.UInt32, seed, place) for place in range(2))
    first = mi.sample_tea_32(i, key + 0x9E3779B9 * step)
    second = mi.sample_tea_32(first[0], first[1])
    uniform = [mi.Float(v >> 8) * 2.0**-24 for v in (*first, *second)]  # below 1, which has no finite normal
    x, y = mi.warp.square_to_std_normal(mi.Point2f(*uniform[:2]))
    z, _ = mi.warp.square_to_std_normal(mi.Point2f(*uniform[2:]))
    noise = mi.Vector3f(x, y, z)
    faint = dr.rcp(1 + dr.exp(-100 * (DEAD - dr.rcp(1 + dr.exp(-opacities)))))
    gain = number(size, 0) * faint
    moved = dr.gather(mi.Vector3f, means, i)
    for axis, s in zip(axes, sigma, strict=True):
        moved += axis * (dr.dot(axis, noise) * s * s * gain)
    result = dr.empty(mi.Float, dr.width(means))
    dr.scatter(result, moved, i)
    return result


def _draw(weights: Float64Array, count: int, rng: np.random.Generator) -> npt.NDArray[np.intp]:
    return rng.choice(len(weights), count, p=weights / weights.sum())


def _share_out(model: GaussianModel, rows: npt.NDArray[np.intp], opacities: Float64Array) -> None:
    """Replace the Gaussians by these rows of them; rows that occur more than once share opacity and size."""
    copies = np.bincount(rows, minlength=len(opacities))
    several = copies > 1
    opacity, factor = shared(opacities[several], copies[several])
    log_factor, logit = np.zeros(len(opacities)), np.zeros(len(opacities))
    log_factor[several] = np.log(factor)
    opacity = np.clip(opacity, DEAD, 1 - 1e-6)
    logit[several] = np.log(opacity / (1 - opacity))
    changed = several[rows]
    model.take(rows.astype(np.uint32), model.widths, changed)
    own = wrapped(mi.Bool, changed)
    model.values["opacities"] = dr.select(
        own, wrapped(mi.Float, logit[rows].astype(np.float32)), model.values["opacities"]
    )
    model.values["scales"] += wrapped(mi.Float, np.repeat(log_factor[rows], 3).astype(np.float32))
    dr.eval(model.values)


def shared(opacities: Float64Array, copies: npt.NDArray[np.intp]) -> tuple[Float64Array, Float64Array]:
    """Opacity of each of n coincident Gaussians that replace one, and the factor on its scales (eq. 9 of the paper)."""
    copies = np.minimum(copies, _COPIES_MAX)
    opacity = 1 - (1 - opacities) ** (1 / copies)
    total = np.zeros(len(opacities))
    for n in range(int(copies.max(initial=0))):
        powers = opacity[:, None] ** (np.arange(n + 1) + 1)
        total += np.where(n < copies, powers @ _BINOMIALS[n, : n + 1], 0.0)
    return opacity, opacities / total
