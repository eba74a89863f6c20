"""CPU-seconds per settled layout, with both steppers: ``python benchmarks/settle.py [--layouts N]``.

Drops ten parts (nuts, bolts, washers, brackets, plates of 10 to 150 mm) into a box of 0.5 x 0.4 m, and then thirty.
The first layout of each row includes what is made once: convex pieces, compiled kernels, the model.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh
from ruamel.yaml import YAML
from trimesh.creation import annulus, box, cylinder

from mitsplat.assets import Asset
from mitsplat.errors import InputError
from mitsplat.mesh import convex_pieces
from mitsplat.scene import load_scene
from mitsplat.settle import settle_layout
from mitsplat.splats import Splats


def parts() -> dict[str, trimesh.Trimesh]:
    def at(mesh: trimesh.Trimesh, *offset: float) -> trimesh.Trimesh:
        return mesh.apply_translation(offset)

    hexagon = cylinder(radius=0.00575, height=0.005, sections=6)
    plates = trimesh.boolean.union([box((0.06, 0.04, 0.004)), at(box((0.004, 0.04, 0.05)), -0.028, 0, 0.023)])
    return {
        "nut": trimesh.boolean.difference([hexagon, cylinder(radius=0.003, height=0.02, sections=32)]),
        "bolt": trimesh.boolean.union([hexagon, at(cylinder(radius=0.003, height=0.026, sections=32), 0, 0, 0.0145)]),
        "washer": annulus(r_min=0.0032, r_max=0.006, height=0.0015, sections=48),
        "bracket": trimesh.boolean.difference([plates, at(cylinder(radius=0.004, height=0.02), 0.015, 0, 0)]),
        "plate": box((0.15, 0.06, 0.012)),
    }


def write_scene(folder: Path, count: int, stepper: str) -> Path:
    point = Splats(
        means=np.zeros((1, 3), np.float32),
        quats=np.float32([[0, 0, 0, 1]]),
        scales=np.full((1, 3), 1e-3, np.float32),
        opacities=np.ones(1, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
    )
    meshes = parts()
    for name, mesh in meshes.items():
        Asset(name, name, point, mesh=mesh, pieces=convex_pieces(mesh), density=3000.0).save(folder / name)
    scene = {
        "name": "settle",
        "shapes": [{"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}, "visible": True}],
        "objects": [{"asset": name, "count": count // len(meshes)} for name in meshes],
        "region": {"min": [-0.25, -0.2, 0.01], "max": [0.25, 0.2, 0.2 if count <= 10 else 0.45]},
        "enclosure": {},
        "settle": {"stepper": stepper},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 1, "height": 1},
        "lights": [{"kind": "point", "position": [0, 0, 1]}],
    }
    path = folder / "scene.yaml"
    YAML(typ="safe").dump(scene, path)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layouts", type=int, default=5)
    layouts = parser.parse_args().layouts
    print("objects stepper  first  others [CPU s]  simulated [s]  draws  given up  deepest [mm]  gap [mm]")
    for count in (10, 30):
        for stepper in ("warp", "mujoco"):
            with tempfile.TemporaryDirectory() as folder:
                scene = load_scene(write_scene(Path(folder), count, stepper))
                seconds, certificates = [], []
                for index in range(layouts):
                    start = time.process_time()
                    try:
                        certificates.append(settle_layout(scene, index).certificate)
                    except InputError:
                        certificates.append(None)
                    seconds.append(time.process_time() - start)
            held = [certificate for certificate in certificates if certificate is not None]
            print(
                f"{count:7} {stepper:7} {seconds[0]:6.1f} {np.mean(seconds[1:]):7.2f}"
                f"{np.mean([c.time_to_rest for c in held]):23.2f}{sum(c.attempts for c in held):7}"
                f"{len(certificates) - len(held):10}"
                f"{max(c.deepest_penetration for c in held) * 1e3:14.3f}{max(c.support_gap for c in held) * 1e3:10.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
