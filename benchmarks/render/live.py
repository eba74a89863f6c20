"""Time of a labelled frame whose poses come from MuJoCo: ten parts of the workcell fall under a camera of 640x480.

    python -m benchmarks.render.live [--frames 12] [--gausscam ENVIRONMENT/bin/python]

Every frame is rendered with traced shadows, and without light. The first three frames of each are not counted, because
they compile kernels. With ``--gausscam``, the splat camera gausscam renders the same cloud with the same poses: colour
of degree 0 and depth, without light and labels. It runs in an environment of its own::

    python -m venv ENVIRONMENT && ENVIRONMENT/bin/pip install 'gausscam[webgpu]'

It needs Vulkan. Without a GPU, Mesa's llvmpipe of version 25 or newer runs it on the CPU; version 22 refuses the number
of its buffers. Times are CPU seconds of all threads.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import mitsplat as ms
from benchmarks.record import figure, recording
from benchmarks.render.frame import ROOT, ten_objects
from mitsplat.geometry.rigid import OPENCV_FROM_OPENGL
from mitsplat.images.colour import encode_srgb
from mitsplat.usd.mjcf import export_scene_mjcf

SIZE = 640, 480
FOVY = 36.0
WARM = 3
"""Frames that are not counted."""


def falling(path: Path, frames: int) -> Iterator[tuple[mujoco.MjModel, mujoco.MjData]]:
    """Yield the states of a simulation every 0.03 s, in which all bodies of a model fall from different heights."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.add_camera(name="side", pos=[0.0, -0.5, 0.3], xyaxes=[1, 0, 0, 0, 0.6, 0.8], fovy=FOVY)
    model = spec.compile()
    data = mujoco.MjData(model)
    heights = data.qpos.reshape(-1, 7)[:, 2]
    heights += 0.015 * (1 + np.argsort(np.argsort(heights)))
    for _ in range(frames):
        mujoco.mj_forward(model, data)
        yield model, data
        mujoco.mj_step(model, data, nstep=round(0.03 / model.opt.timestep))


def time_frames(scene: ms.Scene, path: Path, frames: int, name: str) -> tuple[float, list[ms.Frame]]:
    """Record the median time of a frame, and that of its layout and camera alone.

    Returns:
        CPU seconds per frame, and the frames.
    """
    whole, adapter, shown = [], [], []
    with ms.Renderer(scene) as renderer:
        for model, data in falling(path, WARM + frames):
            start = time.process_time()
            layout = ms.layout_from_mujoco(scene, model, data)
            camera = ms.camera_from_mujoco(model, data, "side", width=SIZE[0], height=SIZE[1])
            adapter.append(time.process_time() - start)
            shown.append(renderer.render(0, layout=layout, camera=camera))
            whole.append(time.process_time() - start)
    shown, whole, adapter = shown[WARM:], whole[WARM:], adapter[WARM:]
    seconds, milliseconds = statistics.median(whole), 1000 * statistics.median(adapter)
    labels = min(len(frame.labels.instances) for frame in shown)
    figure(seconds, "s", name)
    figure(milliseconds, "ms", name, "poses and camera")
    figure(labels, "", name, "labels")
    print(f"{name}: {seconds:.3f} CPU s per frame with {labels} labels or more; poses and camera {milliseconds:.2f} ms")
    return seconds, shown


def compare_with_gausscam(python: Path, scene: ms.Scene, shown: list[ms.Frame], folder: Path) -> tuple[float, Any]:
    """Record the time of gausscam for the same cloud, poses and camera, and the PSNR of both pictures without light.

    Returns:
        CPU seconds per frame, and its last picture.
    """
    parts = [scene.environments[0].splats, *(scene.assets[one.asset].splats for one in shown[0].layout.instances)]
    poses = np.array([[one.world_from_object for one in frame.layout.instances] for frame in shown])
    np.savez(
        folder / "cloud.npz",
        xyz=np.concatenate([splats.means for splats in parts]),
        # Its kernels expect w first in quaternions of the static cloud, and w last in those of bodies.
        rot=np.concatenate([np.roll(parts[0].quats, 1, axis=1), *(splats.quats for splats in parts[1:])]),
        scale=np.concatenate([splats.scales for splats in parts]),
        opacity=np.concatenate([splats.opacities for splats in parts]),
        sh=np.concatenate([splats.sh[:, 0] for splats in parts]),
        slots=np.repeat(np.arange(len(parts) - 1), [len(splats) for splats in parts[1:]]),
        size=SIZE,
        fovy=FOVY,
        position=poses[:, :, :3, 3],
        quaternion=[Rotation.from_matrix(row[:, :3, :3]).as_quat(scalar_first=True) for row in poses],
        camera=shown[0].camera.world_from_camera @ OPENCV_FROM_OPENGL,
    )
    script = Path(__file__).with_name("live_gausscam.py")
    out = subprocess.run([python, script, folder], check=True, capture_output=True, text=True).stdout
    told = json.loads(out.splitlines()[-1])
    theirs = np.load(folder / "pictures.npy") / 255.0
    mine = encode_srgb(np.array([frame.layers.captured for frame in shown]))
    error = np.mean((mine - theirs) ** 2, axis=(1, 2, 3))
    seconds = statistics.median(told["seconds"][1:])
    count = sum(len(splats) for splats in parts)
    figure(told["version"], "", "gausscam", "version")
    figure(told["device"], "", "gausscam", "device")
    figure(seconds, "s", "gausscam")
    figure(count, "", "gaussians")
    figure(-10 * np.log10(error.mean()), "dB", "gausscam", "psnr")
    print(f"gausscam {told['version']}, {told['device']}: {seconds:.3f} CPU s per frame of {count} Gaussians")
    print(f"  PSNR of both without light: {-10 * np.log10(error.max()):.1f} to {-10 * np.log10(error.min()):.1f} dB")
    return seconds, np.uint8(255 * theirs[-1] + 0.5)


def main() -> None:
    """Parse the command line and print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--gausscam", type=Path, metavar="PYTHON", help="Python of an environment with gausscam")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the last frame")
    options = parser.parse_args()
    path = ROOT / "scenes/workcell.yaml"
    overrides = ten_objects(path) | {"output.width": SIZE[0], "output.height": SIZE[1]}
    del overrides["objects"][0]["appearance"]  # gausscam shows the colours of the assets
    scene = ms.load_scene(path, overrides=overrides)
    dark = ms.load_scene(path, overrides=overrides | {"composite.shadow": "none"})
    with recording("render.live", parser, options, ignore=("pictures",)), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export_scene_mjcf(scene, 0, folder / "cell.xml")
        lit, shown = time_frames(scene, folder / "cell.xml", options.frames, "with shadows")
        plain, dark_frames = time_frames(dark, folder / "cell.xml", options.frames, "without light")
        pictures = {"lit": shown[-1].image, "dark": dark_frames[-1].image}
        if options.gausscam:
            theirs, pictures["gausscam"] = compare_with_gausscam(options.gausscam, scene, shown, folder)
            figure(theirs / lit, "", "gausscam", "ratio with shadows")
            figure(theirs / plain, "", "gausscam", "ratio without light")
            print(f"  its time is {theirs / lit:.1f} times that with shadows, {theirs / plain:.1f} times without light")
        for name, picture in pictures.items() if options.pictures else ():
            cv2.imwrite(str(options.pictures / f"{name}.png"), picture[..., ::-1])


if __name__ == "__main__":
    main()
