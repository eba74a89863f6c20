"""Gaussians as unconstrained optimiser parameters on the device, with the moments of Adam."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import AnyArray, BoolArray
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.quality import Quality
from mitsplat.renderer.differentiation.backward import (
    Eye,
    RenderOp,
    gather_gradients,
    pack_cloud,
    project_cloud,
    render_records,
)
from mitsplat.renderer.projection.clouds import Cloud
from mitsplat.renderer.rays.camera_rays import Kind
from mitsplat.renderer.rays.device_arrays import number, on_device, wrapped
from mitsplat.runtime.recorded_kernels import recorded

QUALITY = Quality(transmittance_min=1e-3)
"""Cut-offs of renderings during a fit."""

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-15
"""Constants of Adam as in 3DGS. mi.ad.Adam is not used: it loses all moments when the number of Gaussians changes."""


class BandRates(NamedTuple):
    """Learning rates of SH coefficients.

    Attributes:
        constant: Rate of the constant coefficients.
        rest: Rate of the others.
        sh_count: Number of coefficients per channel.
    """

    constant: float
    rest: float
    sh_count: int


Rate = float | BandRates
_Arrays = dict[str, "mi.Float"]


class Adam:
    """Flat parameters by name, with Adam's moments (Kingma and Ba 2015).

    Attributes:
        values: Parameters.
        first: Running means of the gradients.
        second: Running means of the squared gradients.
        steps: Number of updates.
    """

    def __init__(self, values: Mapping[str, AnyArray]) -> None:
        self.values: _Arrays = {k: wrapped(mi.Float, np.asarray(v, dtype=np.float32)) for k, v in values.items()}
        self.first: _Arrays = {k: dr.zeros(mi.Float, dr.width(v)) for k, v in self.values.items()}
        self.second: _Arrays = {k: dr.zeros(mi.Float, dr.width(v)) for k, v in self.values.items()}
        self.steps = 0
        self._evaluate()

    def track(self) -> None:
        """Enable gradients of the parameters."""
        dr.enable_grad(self.values)

    def update(self, rates: Mapping[str, Rate]) -> None:
        """Make one optimiser step, with a learning rate per parameter."""
        self.steps += 1
        unbias = np.sqrt(1 - _BETA_2**self.steps) / (1 - _BETA_1**self.steps)
        sh_count: dict[str, int] = {}
        pairs: list[float] = []
        for name in self.values:
            rate = rates[name]
            sh_count[name] = rate.sh_count if isinstance(rate, BandRates) else 1
            if isinstance(rate, BandRates):
                pairs += [float(np.float32(value) * np.float32(unbias)) for value in (rate.constant, rate.rest)]
            else:
                pairs += [rate * unbias] * 2
        numbers = on_device(*pairs)
        gradients = {name: dr.grad(value) for name, value in self.values.items()}
        values = dr.detach(self.values)
        dr.eval(gradients, values)
        self.values, self.first, self.second = _adam_step(values, gradients, self.first, self.second, numbers, sh_count)

    def take(self, rows: npt.NDArray[np.uint32], widths: Mapping[str, int], fresh: BoolArray) -> None:
        """Replace the parameters by a selection of their rows.

        Args:
            rows: Indices of the rows, shape (N,); they may repeat.
            widths: Floats per row, by parameter.
            fresh: True for rows whose moments are reset, shape of ``rows``.
        """
        index, kept = wrapped(mi.UInt32, rows), wrapped(mi.Float, (~fresh).astype(np.float32))
        for name, width in widths.items():
            element = dr.arange(mi.UInt32, len(rows) * width)
            row = element // width
            source = dr.gather(mi.UInt32, index, row) * width + (element - row * width)
            self.values[name] = dr.gather(mi.Float, dr.detach(self.values[name]), source)
            for moments in (self.first, self.second):
                moments[name] = dr.gather(mi.Float, moments[name], source) * dr.gather(mi.Float, kept, row)
        self._evaluate()

    def state(self) -> dict[str, AnyArray]:
        """Return the complete state as arrays for :meth:`restore`."""
        groups = {"value": self.values, "first": self.first, "second": self.second}
        arrays = {
            f"{group}.{name}": np.array(dr.detach(array))
            for group, members in groups.items()
            for name, array in members.items()
        }
        return arrays | {"steps": np.array(self.steps)}

    def restore(self, state: Mapping[str, AnyArray]) -> None:
        """Restore a state from :meth:`state`."""
        for group, members in (("value", self.values), ("first", self.first), ("second", self.second)):
            for name in members:
                members[name] = wrapped(mi.Float, state[f"{group}.{name}"])
        self.steps = int(state["steps"])
        self._evaluate()

    def _evaluate(self) -> None:
        dr.eval(self.values, self.first, self.second)


@recorded
def _adam_step(
    values: _Arrays, gradients: _Arrays, first: _Arrays, second: _Arrays, rates: mi.Float, sh_count: dict[str, int]
) -> tuple[_Arrays, _Arrays, _Arrays]:
    """Return parameters and moments after a step.

    ``rates`` has two values per parameter: for its constant SH bands and for the rest.
    """
    values, first, second = dict(values), dict(first), dict(second)
    for place, (name, value) in enumerate(values.items()):
        gradient = gradients[name]
        # The derivative is undefined exactly in the camera plane; a NaN would stay in the moments.
        gradient = dr.select(dr.isfinite(gradient), gradient, 0)
        rate = number(rates, 2 * place)
        if sh_count[name] > 1:
            element = dr.arange(mi.UInt32, dr.width(value)) % (3 * sh_count[name])
            rate = dr.select(element < 3, rate, number(rates, 2 * place + 1))
        first[name] = dr.lerp(gradient, first[name], _BETA_1)
        second[name] = dr.lerp(gradient * gradient, second[name], _BETA_2)
        values[name] = value - rate * first[name] / (dr.sqrt(second[name]) + _EPSILON)
    return values, first, second


class GaussianModel(Adam):
    """Gaussians in unconstrained parameters.

    Means and logarithms of scales are in ``unit``. Opacities are logits. Quaternions are xyzw with any norm. SH
    coefficients are channel-last.

    Attributes:
        unit: Length [m] that makes learning rates independent of the size of the scene.
        sh_count: SH coefficients per channel.
    """

    def __init__(self, splats: Splats, unit: float) -> None:
        self.unit, self.sh_count = unit, splats.sh.shape[1]
        opacities = np.clip(splats.opacities.astype(np.float64), 1e-4, 1 - 1e-4)
        super().__init__(
            {
                "means": splats.means / unit,
                "quats": splats.quats,
                "scales": np.log(splats.scales / unit),
                "opacities": np.log(opacities / (1 - opacities)),
                "sh": splats.sh,
            }
        )

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(dr.width(self.values["opacities"]))

    @property
    def widths(self) -> dict[str, int]:
        """Floats per Gaussian, by parameter."""
        return {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh": 3 * self.sh_count}

    def activated(self) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float, mi.Float]:
        """Return means [m], quaternions, scales [m], opacities and SH coefficients as flat arrays.

        The arrays carry gradients if :meth:`track` was called.
        """
        return _activated(self.values, self._unit)

    def cloud(self) -> Cloud:
        """Return the Gaussians as a renderer cloud."""
        return pack_cloud(*self.activated(), self.sh_count)

    def render(self, eye: Eye, quality: Quality, *, depth: bool = False) -> RenderOp:
        """Render the Gaussians; :meth:`set_gradients` computes the gradients of the parameters.

        Args:
            eye: The camera.
            quality: Cut-offs and SH degree.
            depth: True to render depths as well.

        Returns:
            The rendering; a :class:`~mitsplat.renderer.differentiation.backward.DepthRendering` if ``depth`` is True.
        """
        found = _project(dr.detach(self.values), self._unit, eye.view.kind, eye.numbers, quality, self.sh_count)
        return render_records(*found, eye.view, quality, depth=depth)

    def set_gradients(
        self,
        eye: Eye,
        quality: Quality,
        gradients: Sequence[mi.Float],
        *,
        opacity_weight: float = 0,
        scale_weight: float = 0,
    ) -> None:
        """Set the gradients of the parameters from the gradients of a loss, for :meth:`update`.

        Args:
            eye: Camera of the rendering.
            quality: Quality of the rendering.
            gradients: Gradients with respect to the view records; they are summed.
            opacity_weight: Additional gradient with respect to every opacity.
            scale_weight: Additional gradient with respect to every scale [1/m].
        """
        values = dr.detach(self.values)
        weights = on_device(opacity_weight, scale_weight)
        found = _gradients(
            values, self._unit, eye.view.kind, eye.numbers, quality, self.sh_count, list(gradients), weights
        )
        self.track()
        for name, gradient in found.items():
            dr.set_grad(self.values[name], gradient)

    def sh_rates(self, rate: float, rest_rate: float) -> Rate:
        """Return the rates of ``sh``: one for the constant coefficients and another for the rest."""
        return rate if self.sh_count == 1 else BandRates(rate, rest_rate, self.sh_count)

    def splats(self) -> Splats:
        """Return the current Gaussians."""
        means, quats, scales, opacities, sh = (np.array(dr.detach(value)) for value in self.activated())
        return Splats(
            means=means.reshape(-1, 3),
            quats=quats.reshape(-1, 4),
            scales=scales.reshape(-1, 3),
            opacities=opacities,
            sh=sh.reshape(-1, self.sh_count, 3),
        )

    @cached_property
    def _unit(self) -> mi.Float:
        return dr.opaque(mi.Float, self.unit)


def _activated(values: _Arrays, unit: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float, mi.Float, mi.Float]:
    return (
        values["means"] * unit,
        values["quats"],
        dr.exp(values["scales"]) * unit,
        dr.rcp(1 + dr.exp(-values["opacities"])),
        values["sh"],
    )


@recorded
def _project(
    values: _Arrays, unit: mi.Float, kind: Kind, numbers: _Arrays, quality: Quality, sh_count: int
) -> tuple[mi.Float, mi.Float, mi.UInt32]:
    """Return the view records of Gaussians, their least depths and their tile boxes."""
    records, least, box, _ = project_cloud(pack_cloud(*_activated(values, unit), sh_count), kind, numbers, quality)
    return records, least, box


@recorded
def _gradients(
    values: _Arrays,
    unit: mi.Float,
    kind: Kind,
    numbers: _Arrays,
    quality: Quality,
    sh_count: int,
    found: list[mi.Float],
    weights: mi.Float,
) -> _Arrays:
    """Return parameter gradients from gradients of view records and from the weights of opacities and scales."""
    values = {name: mi.Float(value) for name, value in values.items()}
    dr.enable_grad(values)
    _, _, scales, opacities, _ = _activated(values, unit)
    dr.backward(dr.sum(opacities) * number(weights, 0) + dr.sum(scales) * number(weights, 1))
    gather_gradients(pack_cloud(*_activated(values, unit), sh_count), kind, numbers, quality, sum(found[1:], found[0]))
    return {name: dr.grad(value) for name, value in values.items()}
