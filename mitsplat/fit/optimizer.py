"""Gaussians as an optimiser moves them: unconstrained parameters on the device, and Adam's moments beside them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsplat.arrays import BoolArray
from mitsplat.plugins.backward import pack_cloud
from mitsplat.plugins.device import wrapped
from mitsplat.plugins.gaussian import Cloud
from mitsplat.splats import Splats

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-15
"""Adam as in 3DGS; mi.ad.Adam forgets all moments when the number of Gaussians changes."""


class Adam:
    """Flat parameters by name, and their running moments (Kingma and Ba 2015).

    Attributes:
        values: The parameters.
        first: Running mean of their gradients.
        second: Running mean of the squares of their gradients.
        steps: Updates so far.
    """

    def __init__(self, values: Mapping[str, npt.NDArray[Any]]) -> None:
        self.values: dict[str, Any] = {k: wrapped(mi.Float, np.asarray(v, dtype=np.float32)) for k, v in values.items()}
        self.first: dict[str, Any] = {k: dr.zeros(mi.Float, dr.width(v)) for k, v in self.values.items()}
        self.second: dict[str, Any] = {k: dr.zeros(mi.Float, dr.width(v)) for k, v in self.values.items()}
        self.steps = 0
        self._settle()

    def track(self) -> None:
        """Collect gradients from here on."""
        dr.enable_grad(self.values)

    def update(self, rates: Mapping[str, Any]) -> None:
        """One step down the gradients, with a rate per parameter: a number, or an array for its elements."""
        self.steps += 1
        unbias = np.sqrt(1 - _BETA_2**self.steps) / (1 - _BETA_1**self.steps)
        for name, value in self.values.items():
            gradient = dr.grad(value)
            # Exactly in the camera's plane a derivative is undefined, and would stay in the moments for ever.
            gradient = dr.select(dr.isfinite(gradient), gradient, 0)
            rate = rates[name]
            rate = dr.opaque(mi.Float, rate * unbias) if isinstance(rate, float) else rate * dr.opaque(mi.Float, unbias)
            first = dr.lerp(gradient, self.first[name], _BETA_1)
            second = dr.lerp(gradient * gradient, self.second[name], _BETA_2)
            self.first[name], self.second[name] = first, second
            self.values[name] = dr.detach(value) - rate * first / (dr.sqrt(second) + _EPSILON)
        self._settle()

    def take(self, rows: npt.NDArray[np.uint32], widths: Mapping[str, int], fresh: BoolArray) -> None:
        """Become these rows of the parameters, of so many floats each; ``fresh`` rows lose their moments."""
        index, kept = wrapped(mi.UInt32, rows), wrapped(mi.Float, (~fresh).astype(np.float32))
        for name, width in widths.items():
            element = dr.arange(mi.UInt32, len(rows) * width)
            row = element // width
            source = dr.gather(mi.UInt32, index, row) * width + (element - row * width)
            self.values[name] = dr.gather(mi.Float, dr.detach(self.values[name]), source)
            for moments in (self.first, self.second):
                moments[name] = dr.gather(mi.Float, moments[name], source) * dr.gather(mi.Float, kept, row)
        self._settle()

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Everything, as arrays that :meth:`restore` takes."""
        groups = {"value": self.values, "first": self.first, "second": self.second}
        arrays = {
            f"{group}.{name}": np.array(dr.detach(array))
            for group, members in groups.items()
            for name, array in members.items()
        }
        return arrays | {"steps": np.array(self.steps)}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what :meth:`state` gave."""
        for group, members in (("value", self.values), ("first", self.first), ("second", self.second)):
            for name in members:
                members[name] = wrapped(mi.Float, state[f"{group}.{name}"])
        self.steps = int(state["steps"])
        self._settle()

    def _settle(self) -> None:
        dr.eval(self.values, self.first, self.second)


class GaussianModel(Adam):
    """Gaussians in terms of unconstrained parameters.

    Means and logarithms of scales are in ``unit``, opacities are logits; quaternions are xyzw and of any length. The SH
    coefficients are channel-last.

    Attributes:
        unit: Length [m] by which learning rates become independent of the scene's size.
        bands: SH coefficients per channel.
    """

    def __init__(self, splats: Splats, unit: float) -> None:
        self.unit, self.bands = unit, splats.sh.shape[1]
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
        """Floats per Gaussian of every parameter."""
        return {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh": 3 * self.bands}

    def activated(self) -> tuple[Any, Any, Any, Any, Any]:
        """Means [m], quaternions, scales [m], opacities and SH coefficients, flat, with gradients if tracked."""
        p = self.values
        return (
            p["means"] * self._unit,
            p["quats"],
            dr.exp(p["scales"]) * self._unit,
            dr.rcp(1 + dr.exp(-p["opacities"])),
            p["sh"],
        )

    def cloud(self) -> Cloud:
        """The Gaussians as the renderer takes them."""
        return pack_cloud(*self.activated(), self.bands)

    def sh_rates(self, rate: float, rest_rate: float) -> Any:
        """Rates of the elements of ``sh``: one for the constant coefficients, another for the rest."""
        if self.bands == 1:
            return rate
        element = dr.arange(mi.UInt32, 3 * self.bands * self.count) % (3 * self.bands)
        return dr.select(element < 3, dr.opaque(mi.Float, rate), dr.opaque(mi.Float, rest_rate))

    def splats(self) -> Splats:
        """The Gaussians as they are now."""
        means, quats, scales, opacities, sh = (np.array(dr.detach(value)) for value in self.activated())
        return Splats(
            means=means.reshape(-1, 3),
            quats=quats.reshape(-1, 4),
            scales=scales.reshape(-1, 3),
            opacities=opacities,
            sh=sh.reshape(-1, self.bands, 3),
        )

    @property
    def _unit(self) -> Any:
        return dr.opaque(mi.Float, self.unit)
