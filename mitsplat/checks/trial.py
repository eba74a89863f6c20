"""Tiny test scene with a known picture, which reveals devices that render wrong.

    python -m mitsplat.checks.trial cpu|cuda

prints the faults and the version of LLVM as JSON. It runs in its own process for two reasons: an unusable LLVM aborts
the process instead of raising an error, and a process can use only one device.
"""

from __future__ import annotations

import json
import sys

import numpy as np
import trimesh

from mitsplat.arrays import Float64Array
from mitsplat.gaussians.splat_arrays import SplatArrays
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.renderer.layers import Layers, make_integrator, make_splats_shape, render_layers
from mitsplat.runtime.device import use_device

BLOCK = 8
"""Edge length of the squares whose means are compared [px]."""

TOLERANCE = 0.02
"""Maximum difference of a mean; 1 is white or unshadowed. One pixel at an edge changes a mean by 0.016."""

WHITE = 1.437
"""Irradiance of lamp and sky on the middle of the floor [W/m^2], at which the ball keeps its colours."""

# fmt: off
KNOWN_MEANS = {
    "picture": [
        [0.577, 0.540, 0.556, 0.561, 0.505, 0.582, 0.625, 0.640],
        [0.340, 0.331, 0.310, 0.127, 0.099, 0.152, 0.314, 0.334],
        [0.334, 0.310, 0.285, 0.056, 0.067, 0.090, 0.275, 0.328],
        [0.331, 0.283, 0.203, 0.098, 0.054, 0.131, 0.307, 0.325],
        [0.330, 0.309, 0.273, 0.259, 0.281, 0.304, 0.320, 0.327],
        [0.331, 0.326, 0.325, 0.324, 0.324, 0.324, 0.327, 0.329],
    ],
    "light": [
        [0.998, 0.992, 0.986, 0.989, 0.981, 1.010, 0.999, 0.999],
        [1.000, 0.993, 0.938, 0.738, 0.935, 1.172, 0.998, 0.996],
        [1.000, 0.929, 0.895, 0.498, 0.636, 0.846, 0.970, 0.984],
        [0.993, 0.847, 0.611, 0.440, 0.421, 0.641, 0.937, 0.974],
        [0.989, 0.926, 0.819, 0.776, 0.843, 0.912, 0.960, 0.981],
        [0.993, 0.977, 0.974, 0.971, 0.970, 0.970, 0.981, 0.984],
    ],
    "instance": [
        [0.000, 0.000, 0.000, 0.016, 0.234, 0.062, 0.000, 0.000],
        [0.000, 0.000, 0.000, 0.750, 1.000, 0.891, 0.047, 0.000],
        [0.000, 0.000, 0.000, 0.984, 1.000, 1.000, 0.203, 0.000],
        [0.000, 0.000, 0.000, 0.484, 0.875, 0.625, 0.000, 0.000],
        [0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000],
        [0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000],
    ],
    "proxy": [
        [0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000],
        [0.000, 0.000, 0.000, 0.203, 0.734, 0.312, 0.000, 0.000],
        [0.000, 0.000, 0.000, 0.531, 1.000, 0.719, 0.000, 0.000],
        [0.000, 0.000, 0.000, 0.094, 0.484, 0.141, 0.000, 0.000],
        [0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000],
        [0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000, 0.000],
    ],
}
# fmt: on
"""Values of :func:`trial_means` in the variant llvm_ad_rgb.

After an intended change of the renderer, inspect light and picture, then replace these values.
"""


def render_trial(**options: object) -> Layers:
    """Render a ball in front of a wall on a floor, lit by a lamp and a sky.

    The wall occludes light in the captured floor, and the ball is an added object that occludes light.
    """
    integrator = make_integrator(quality="fast", white=WHITE, **options)
    import mitsuba as mi  # after the variant was set

    x, y = (values.ravel() for values in np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 30)]))
    floor = _splats(np.column_stack([x, y, np.zeros_like(x)]), (0.03, 0.03, 0.001), 0.4)
    slab = trimesh.creation.box(bounds=[[-0.5, -0.5, -0.05], [0.5, 0.5, 0]])
    wall = trimesh.creation.box(bounds=[[-0.2, -0.3, 0], [-0.18, 0.3, 0.15]])
    ball = trimesh.creation.icosphere(2, 0.1)
    ball.apply_translation((0.05, 0, 0.1))
    lamp = mi.ScalarTransform4f().look_at(origin=[0.8, 0.4, 1.0], target=[0, 0, 0], up=[0, 0, 1]).scale(0.1)
    scene = {
        "type": "scene",
        "floor": make_splats_shape(floor, proxy=trimesh.util.concatenate([slab, wall])),
        "ball": make_splats_shape(
            _splats(ball.vertices, (0.02, 0.02, 0.02), -0.5), proxy=ball, instance=1, capture_light="uniform"
        ),
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 30.0}},
        "sky": {"type": "constant", "radiance": 0.3},
    }
    camera = Camera.look_at((0.1, -0.8, 0.6), (0, 0, 0.03), width=8 * BLOCK, height=6 * BLOCK, fov_x=40)
    return render_layers(integrator, mi.load_dict(scene), camera)


def _splats(means: Float64Array, scales: tuple[float, float, float], sh: float) -> Splats:
    count = len(means)
    quats, sizes = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), np.tile(scales, (count, 1))
    parts = means, quats, sizes, np.full(count, 0.95), np.full((count, 1, 3), sh)
    return Splats(*SplatArrays(*(part.astype(np.float32) for part in parts)))


def trial_means(layers: Layers) -> dict[str, Float64Array]:
    """Return means over squares, shape (6, 8), of picture, light, and coverage by the ball's splats and proxy."""
    maps = {
        "picture": layers.rgb.mean(axis=-1),
        "light": layers.light.mean(axis=-1),
        "instance": layers.instance == 1,
        "proxy": layers.proxy_instance == 1,
    }
    height, width = layers.alpha.shape
    shape = height // BLOCK, BLOCK, width // BLOCK, BLOCK
    return {name: np.float64(values).reshape(shape).mean(axis=(1, 3)) for name, values in maps.items()}


def trial_faults(layers: Layers) -> list[str]:
    """Return the differences from the known picture, a text each."""
    faults = []
    for name, means in trial_means(layers).items():
        worst = float(np.abs(means - KNOWN_MEANS[name]).max())
        if not worst <= TOLERANCE:
            faults.append(f"{name} is off by {worst:.2f}")
    return faults


def main() -> None:
    """Render on the device given on the command line, and print the result."""
    use_device(sys.argv[1])
    faults = trial_faults(render_trial())
    import drjit as dr  # after LLVM was selected

    sys.stdout.write(json.dumps({"faults": faults, "llvm": ".".join(map(str, dr.detail.llvm_version()))}))


if __name__ == "__main__":
    main()
