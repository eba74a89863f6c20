"""Frames of gausscam for :mod:`benchmarks.render.live`, in an environment without mitsplat.

Reads ``cloud.npz`` of a folder and writes ``pictures.npy``. Prints CPU seconds per frame, version and device as JSON.
"""

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from gausscam.backends.webgpu import Pipeline, pick_variant


def main() -> None:
    """Render all poses of the folder that the command line names."""
    folder = Path(sys.argv[1])
    given = dict(np.load(folder / "cloud.npz"))
    camera = given["camera"]
    cloud = {name: given[name].astype(np.float32) for name in ("xyz", "rot", "scale", "opacity", "sh", "fovy")}
    cloud |= {"slots": given["slots"].astype(np.int32), "W": given["size"][0], "H": given["size"][1]}
    cloud |= {"cam_pos": camera[None, :3, 3].astype(np.float32), "cam_xmat": camera[None, :3, :3].astype(np.float32)}
    pipeline = Pipeline(cloud, variant=pick_variant(""))
    links = np.zeros((13, 7), np.float32)  # the number of bodies that its buffer holds
    links[:, 3] = 1.0
    bodies = given["position"].shape[1]
    seconds, pictures = [], []
    for position, quaternion in zip(given["position"], given["quaternion"], strict=True):
        start = time.process_time()
        links[:bodies, :3], links[:bodies, 3:] = position, quaternion
        pipeline.set_links(links[:, :3], links[:, 3:])
        pipeline.set_cam(cloud["cam_pos"], cloud["cam_xmat"])
        colours, _ = pipeline.unpack(*pipeline.render_frame())
        seconds.append(time.process_time() - start)
        pictures.append(colours[0])
    np.save(folder / "pictures.npy", np.array(pictures))
    device = pipeline.adapter.info["device"]
    print(json.dumps({"seconds": seconds, "version": version("gausscam"), "device": device}))


if __name__ == "__main__":
    main()
