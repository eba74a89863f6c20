"""Scenes for the comparison of CPU and GPU; together they use every stage of the renderer.

    python -m tests.gpu.cases VARIANT OUT.npz

renders all of them in one Mitsuba variant. A process can only use one variant.
"""

from __future__ import annotations

import faulthandler
import sys
import tempfile
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

# isort: off
from mitsplat.geometry.camera import Camera  # initialises LLVM before Dr.Jit

import mitsuba as mi
import numpy as np
import trimesh
from ruamel.yaml import YAML

# isort: on
import mitsplat as ms
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.quality import Quality
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers, render_silhouettes
from mitsplat.runtime.dropped_rays import check_dropped_rays
from tests.renderer.test_light import WHITE_SKY, floor, nothing, slab

SIZE = 160, 120
MAX_SECONDS = 600
"""Time after which rendering of all cases ends with the place where it stands; it takes one minute."""

Arrays = dict[str, np.ndarray]


def camera(**options: Any) -> Camera:
    straight = Camera.look_at((0.1, -0.5, 0.4), (0, 0, 0.02), width=SIZE[0], height=SIZE[1], fov_x=40)
    return replace(straight, **options)


def ball(seed: int, at: tuple[float, float, float], radius: float = 0.05) -> tuple[Splats, trimesh.Trimesh]:
    """Return coloured Gaussians of three bands on a ball, and the ball's mesh."""
    mesh = trimesh.creation.icosphere(3, radius)
    mesh.apply_translation(at)
    rng = np.random.default_rng(seed)
    count = len(mesh.vertices)
    splats = Splats(
        means=mesh.vertices,
        quats=np.tile([0, 0, 0, 1.0], (count, 1)),
        scales=rng.uniform(0.06, 0.16, (count, 3)) * radius,
        opacities=rng.uniform(0.5, 0.99, count),
        sh=rng.normal(0, 0.3, (count, 9, 3)),
    )
    return splats, mesh


def lights() -> dict[str, Any]:
    pose = mi.ScalarTransform4f().look_at(origin=[0.5, 0.3, 0.8], target=[0, 0, 0], up=[0, 0, 1]).scale(0.15)
    lamp = {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": 12.0}}
    return {"lamp": lamp, "sky": WHITE_SKY}


def things() -> dict[str, Any]:
    """Return a floor and a wall with captured light, a ball with its own captured light, and a ball without."""
    wall = trimesh.creation.box(bounds=[[-0.16, -0.2, 0.001], [-0.15, 0.2, 0.1]])
    first, second = ball(1, (-0.06, 0, 0.06)), ball(2, (0.07, 0.02, 0.051))
    return {
        "floor": make_splats_shape(floor(), proxy=slab()),
        "wall": make_splats_shape(nothing(), proxy=wall),
        "first": make_splats_shape(first[0], proxy=first[1], instance=1, specular=0.3, roughness=0.3),
        "second": make_splats_shape(second[0], proxy=second[1], instance=2, capture_light="uniform"),
    }


def visible(kind: str) -> dict[str, Any]:
    """Return a mesh with a Mitsuba material, beside the balls."""
    transform = mi.ScalarTransform4f()
    if kind == "plain":
        diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}}
        return {
            "cube": {"type": "cube", "to_world": transform.translate([0.0, -0.1, 0.03]).scale(0.03), "bsdf": diffuse}
        }
    sphere = {"type": "sphere", "to_world": transform.translate([0.02, -0.12, 0.041]).scale(0.04)}
    materials = {"glass": {"type": "dielectric"}, "mirror": {"type": "conductor", "material": "Cu"}}
    return {kind: sphere | {"bsdf": materials[kind]}}


def layers(
    shapes: Callable[[], dict[str, Any]] = things, view: Callable[[], Camera] = camera, **options: Any
) -> Arrays:
    integrator = make_integrator(**options)
    scene = mi.load_dict({"type": "scene", **shapes(), **lights()})
    found = render_layers(integrator, scene, view(), seed=3)
    return {field.name: np.asarray(getattr(found, field.name)) for field in fields(found)}


def silhouettes(source: str) -> Arrays:
    integrator = make_integrator()
    scene = mi.load_dict({"type": "scene", **things(), **lights()})
    found = render_silhouettes(integrator, scene, camera(distortion=(-0.2, 0.05, 0.001, -0.001)), source=source)
    return {f"mask_{number}": silhouette.image_mask(*SIZE) for number, silhouette in found.items()}


def gradients() -> Arrays:
    from tests.renderer.test_backward import gradients, separated

    return {f"gradient_{name}": value for name, value in gradients(separated(200, 16)).items()}


def fit_gradients() -> Arrays:
    """Compute the gradients of the loss that a fit minimises."""
    import drjit as dr

    from mitsplat.renderer.differentiation.photometric_loss import photometric_loss

    make_integrator()
    rng = np.random.default_rng(5)
    wanted, made = ([mi.Float(rng.random(SIZE[0] * SIZE[1], dtype=np.float32)) for _ in range(3)] for _ in range(2))
    for channel in made:
        dr.enable_grad(channel)
    dr.backward(photometric_loss(made, wanted, *SIZE, 0.2))
    return {"gradient_picture": np.stack([np.array(dr.grad(channel)) for channel in made])}


def frame() -> Arrays:
    """Render a frame of a scene file, developed and labelled."""
    from tests.drawn import scatter_boxes

    with tempfile.TemporaryDirectory() as folder:
        scene = drawn_scene(Path(folder), width=SIZE[0], height=SIZE[1])
        made = ms.render_frame(scene, 0, layout=scatter_boxes(scene, 0, progress=None))
    boxes = np.array([[label.id, *label.box] for label in made.labels.instances], dtype=np.float64)
    return {
        "image": made.image,
        "instance": made.instance,
        "depth": made.depth,
        "light": made.layers.light,
        "boxes": boxes,
    }


def drawn_scene(folder: Path, **output: Any) -> ms.Scene:
    """Return a scene of boxes on a table under a lamp and a sky, with camera noise."""
    from tests.conftest import BOTH
    from tests.drawn import large_boxes

    for asset in large_boxes():
        asset.save(folder / "assets" / asset.name)
    data = {
        "name": "drawn",
        "shapes": [
            {"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.3]}, "visible": True},
            {"name": "wall", "box": {"size": [0.02, 0.6, 0.4], "position": [-0.3, 0, 0]}, "proxy": True},
        ],
        "objects": BOTH,
        "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, 0.2]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.7, "height": 0.6},
        "lights": [{"kind": "area", "position": [0.5, 0, 1]}, {"kind": "environment", "radiance": 0.5}],
        "randomise": {"iso": [400, 400], "vignetting": [0.1, 0.1], "motion_blur": [2, 2]},
        "output": output,
        "seed": 7,
    }
    YAML(typ="safe", pure=True).dump(data, folder / "scene.yaml")
    return ms.load_scene(folder / "scene.yaml")


CASES: dict[str, Callable[[], Arrays]] = {
    "fast": lambda: layers(quality="fast"),
    "balanced": lambda: layers(),
    "exact": lambda: layers(quality="exact"),
    "as captured": lambda: layers(shadow="none"),
    "fixed number of rays": lambda: layers(shadow_error=0.0, shadow_samples=16),
    "splats cast shadows": lambda: layers(occluders="splats"),
    "two by two rays": lambda: layers(quality=Quality(samples=2)),
    "dilated": lambda: layers(quality=Quality(kernel="gsplat", response="ewa")),
    "distorted lens": lambda: layers(view=lambda: camera(distortion=(-0.2, 0.05, 0.001, -0.001, 0.01))),
    "fisheye lens": lambda: layers(view=lambda: camera(lens="fisheye", distortion=(0.05, -0.01, 0.002, 0.0))),
    "thin lens": lambda: layers(
        view=lambda: camera(aperture_radius=0.01, focus_distance=0.5), quality=Quality(lens_rings=1)
    ),
    "plain mesh": lambda: layers(lambda: things() | visible("plain")),
    "plain mesh and splats cast shadows": lambda: layers(lambda: things() | visible("plain"), occluders="splats"),
    "path-traced glass": lambda: layers(lambda: things() | visible("glass"), mesh_samples=16),
    "path-traced mirror": lambda: layers(lambda: things() | visible("mirror"), mesh_samples=16),
    "silhouettes of splats": lambda: silhouettes("splats"),
    "silhouettes of proxies": lambda: silhouettes("proxies"),
    "gradients": gradients,
    "gradients of the loss": fit_gradients,
    "frame": frame,
}


def main() -> None:
    variant, out = sys.argv[1:]
    faulthandler.dump_traceback_later(MAX_SECONDS, exit=True)
    mi.set_variant(variant)
    arrays = {f"{case}/{name}": value for case, make in CASES.items() for name, value in make().items()}
    check_dropped_rays()
    np.savez(out, **arrays)
    faulthandler.cancel_dump_traceback_later()


if __name__ == "__main__":
    main()
