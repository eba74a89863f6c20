"""Render a robot arm that MuJoCo simulates in the workcell: images, depth, ids of its links and optical flow.

    python examples/robot_arm.py [FOLDER] [--frames N] [--size WIDTHxHEIGHT]

Each link of `arm.xml` consists of boxes and cylinders and is baked as an asset of its own. In every frame, the poses of
the links are those of MuJoCo's bodies. Poses from the kinematics of a robot, 4x4 matrices world_from_body, are given by
`ms.Layout.from_poses`. Finally the frames are written as a dataset, which the audit checks.
"""

import argparse
import tempfile
from pathlib import Path

import cv2
import mujoco
import numpy as np
import trimesh

import mitsplat as ms

parser = argparse.ArgumentParser()
parser.add_argument("folder", type=Path, nargs="?")
parser.add_argument("--frames", type=int, default=2)
parser.add_argument("--size", default="160x90")
arguments = parser.parse_args()
here = Path(__file__).resolve().parent
folder = arguments.folder or Path(tempfile.mkdtemp())
width, height = map(int, arguments.size.split("x"))

model = mujoco.MjModel.from_xml_path(str(here / "arm.xml"))
data = mujoco.MjData(model)
links = [model.body(number).name for number in range(1, model.nbody)]


def shape_of(geom):
    """Return a geom of MuJoCo as a mesh in the frame of its body."""
    make = {
        mujoco.mjtGeom.mjGEOM_BOX: lambda size: trimesh.creation.box(2 * size),
        mujoco.mjtGeom.mjGEOM_CYLINDER: lambda size: trimesh.creation.cylinder(size[0], 2 * size[1]),
    }
    mesh = make[geom.type.item()](geom.size)
    pose = trimesh.transformations.quaternion_matrix(geom.quat)
    pose[:3, 3] = geom.pos
    mesh.visual.face_colors = np.uint8(255 * geom.rgba)
    return mesh.apply_transform(pose)


few = ms.BakeSettings(gaussians=1500, verify_views=0)
for name in links:
    geoms = [
        shape_of(model.geom(n)) for n in range(model.ngeom) if model.body(model.geom(n).bodyid.item()).name == name
    ]
    baked = ms.bake_asset(trimesh.util.concatenate(geoms), name=name, class_name="robot", settings=few)
    baked.asset.save(folder / "assets" / name)

workcell = ms.load_scene(here.parent / "scenes/workcell.yaml")
scene = ms.make_scene(
    ms.SceneSpec(
        name="arm",
        environment=str(here.parent / "scenes/assets/workcell"),
        objects=[{"asset": f"assets/{name}"} for name in links],
        region=workcell.spec.region,
        camera=workcell.spec.camera,
        lights=workcell.spec.lights,
        output={"width": width, "height": height, "formats": ["coco", "depth", "poses"], "validation": 0},
        quality="fast",
    ),
    folder=folder,
)


def layouts():
    """Yield the poses of the links at every tenth of a second of a movement."""
    while True:
        data.ctrl[:] = 0.9 * np.sin(3 * data.time + np.arange(model.nu))
        mujoco.mj_step(model, data, nstep=round(0.1 / model.opt.timestep))
        mujoco.mj_forward(model, data)  # mj_step leaves the poses before its last step
        yield ms.layout_from_mujoco(scene, model, data, {name: name for name in links})


camera = ms.Camera.look_at((0.35, -0.75, 0.45), (0, 0, 0.15), width=width, height=height, fov_x=45)
film = ms.render_frames(scene, arguments.frames, layouts=layouts(), cameras=camera)
frames = []
for frame in film:
    frames.append(frame)
    near = frame.depth[frame.instance > 0].min()
    print(f"frame {frame.index}: {len(frame.labels.instances)} links, the nearest point {near:.3f} m before the camera")
    if frame.flow is not None:
        cv2.writeOpticalFlow(str(folder / f"{frame.index:06}.flo"), frame.flow)
out = ms.write_frames(scene, folder / "arm", frames, overwrite=True).path
print(out)

flow = frames[0].flow
moved = np.abs(flow).max(axis=2) < 1e9
assert all(len(frame.labels.instances) == len(links) for frame in frames)
assert np.abs(flow[moved & (frames[0].instance == len(links))]).max() > 0.3  # the forearm moves
assert np.abs(flow[moved & (frames[0].instance == 0)]).max() < 1e-3  # and nothing of the workcell moves
assert not ms.audit_dataset(out).violations
