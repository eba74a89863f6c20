"""Render labelled frames of parts that fall in MuJoCo, while they fall.

    python examples/falling_parts.py [FOLDER] [--frames N] [--size WIDTHxHEIGHT]

The workcell is exported to MuJoCo with the parts of its first layout, and gets a camera there. The parts are lifted to
different heights. After each 0.03 s of the simulation, the same renderer shows the poses of MuJoCo's bodies in
MuJoCo's camera. The frames are written as a dataset, which the audit checks.
"""

import argparse
import tempfile
from pathlib import Path

import mujoco
import numpy as np

import mitsplat as ms
from mitsplat.usd.mjcf import export_scene_mjcf

parser = argparse.ArgumentParser()
parser.add_argument("folder", type=Path, nargs="?")
parser.add_argument("--frames", type=int, default=20)
parser.add_argument("--size", default="320x240")
arguments = parser.parse_args()
folder = arguments.folder or Path(tempfile.mkdtemp())
width, height = map(int, arguments.size.split("x"))

output = {"width": width, "height": height, "layouts": 1, "views": arguments.frames, "formats": ["coco", "depth"]}
scene = ms.load_scene(Path(__file__).parents[1] / "scenes/workcell.yaml", overrides={"output": output})
export_scene_mjcf(scene, 0, folder / "cell.xml")  # mitsplat export scene.yaml -o cell.xml --mjcf

spec = mujoco.MjSpec.from_file(str(folder / "cell.xml"))
spec.worldbody.add_camera(name="side", pos=[0.0, -0.5, 0.3], xyaxes=[1, 0, 0, 0, 0.6, 0.8], fovy=36)
model = spec.compile()
data = mujoco.MjData(model)
heights = data.qpos.reshape(-1, 7)[:, 2]  # each body has a free joint: position and quaternion
heights += 0.03 * (1 + np.argsort(np.argsort(heights)))
mujoco.mj_forward(model, data)


def simulate():
    """Yield a frame per 0.03 s of the simulation."""
    with ms.Renderer(scene) as renderer:
        for index in range(arguments.frames):
            layout = ms.layout_from_mujoco(scene, model, data)
            camera = ms.camera_from_mujoco(model, data, "side", width=width, height=height)
            yield renderer.render(index, layout=layout, camera=camera)
            mujoco.mj_step(model, data, nstep=round(0.03 / model.opt.timestep))
            mujoco.mj_forward(model, data)  # mj_step leaves the poses before its last step


frames = []
for frame in simulate():
    frames.append(frame)
    print(f"frame {frame.index}: {len(frame.labels.instances)} parts in view")
out = ms.write_frames(scene, folder / "fall", frames, overwrite=True).path
print(out)

assert frames[0].layout.instances[0].world_from_object[2, 3] > frames[-1].layout.instances[0].world_from_object[2, 3]
assert frames[-1].labels.instances
assert not ms.audit_dataset(out).violations
