"""Layouts: objects dropped at random poses and simulated until they rest, each with a certificate that they do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsplat.scene import Scene

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Instance:
    """One object of a layout.

    Attributes:
        id: Instance id, from 1.
        asset: Index into the scene's assets.
        class_index: Index into the scene's class names.
        world_from_object: Rigid transform of the asset's frame, shape (4, 4).
    """

    id: int
    asset: int
    class_index: int
    world_from_object: FloatArray


@dataclass(frozen=True)
class RestCertificate:
    """What was measured of a layout at rest; penetration and gap on the true meshes, not on their convex pieces.

    Attributes:
        rested: Whether everything was within its limit.
        time_to_rest: Simulated time [s].
        max_speed, max_spin: Residual motion of the fastest object [m/s, rad/s].
        surface_motion: Farthest that a point of any surface moved in the last half second [m].
        deepest_penetration: Of any pair of objects, or object and collider [m].
        support_gap: Distance of the most isolated object from what is nearest to it [m]; 0 if all touch.
        attempts: Draws of poses that it took.
        refused: Why each earlier draw was refused.
    """

    rested: bool
    time_to_rest: float
    max_speed: float
    max_spin: float
    surface_motion: float
    deepest_penetration: float
    support_gap: float
    attempts: int
    refused: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the objects of one layout lie."""

    index: int
    instances: tuple[Instance, ...]
    certificate: RestCertificate

    def to_json(self) -> dict[str, Any]:
        """The layout as JSON values; floats survive the round trip exactly."""
        return {
            "index": self.index,
            "instances": [
                {**vars(instance), "world_from_object": instance.world_from_object.tolist()}
                for instance in self.instances
            ],
            "certificate": {**asdict(self.certificate), "refused": list(self.certificate.refused)},
        }

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Layout:
        """The layout that :meth:`to_json` described."""
        return cls(
            index=stored["index"],
            instances=tuple(
                Instance(**{**entry, "world_from_object": np.array(entry["world_from_object"], dtype=np.float64)})
                for entry in stored["instances"]
            ),
            certificate=RestCertificate(
                **{**stored["certificate"], "refused": tuple(stored["certificate"]["refused"])}
            ),
        )


def settle_layout(scene: Scene, index: int, *, progress: Progress | None = None) -> Layout:
    """Drop the objects of one layout until they rest. The scene's seed and ``index`` decide the result.

    Args:
        scene: What to drop, from where, and on what.
        index: Index of the layout.
        progress: Told in a few words what takes long: making convex pieces, compiling.

    Raises:
        InputError: If the region is too small for the objects, or no draw of poses comes to rest within the limits.
    """
    with warp_settings(progress):
        from mitsplat.drop import drop_of

        return drop_of(scene, progress or (lambda text: None)).settle(index)


@contextmanager
def warp_settings(progress: Progress | None = None) -> Iterator[None]:
    """Keep Warp quiet and leave gradients out, without which the simulation compiles in two thirds of the time."""
    import warp as wp

    kept = wp.config.log_level, wp.config.enable_backward
    wp.config.log_level, wp.config.enable_backward = wp.LOG_ERROR, False
    try:
        wp.init()  # type: ignore[no-untyped-call]
        compiled = Path(wp.config.kernel_cache_dir or ".").glob("wp_newton._src.solvers.mujoco.kernels*")
        if progress is not None and not any(compiled):
            progress("compiling physics, once (about a minute)")
        yield
    finally:
        wp.config.log_level, wp.config.enable_backward = kept
