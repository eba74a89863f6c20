"""Render images from the recorded poses of a robot's camera; each image has its true pose.

    python examples/robot_poses.py [FOLDER]

The log has one row per photograph: position [m] and viewing direction of the camera in the frame of the workcell, z up.
Hand-eye calibration gives a matrix `world_from_camera` (x right, y down, z forward), whose last and third columns
contain these values.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

import mitsplat as ms

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
log = np.array(
    [
        # position             direction of view
        (0.05, -0.50, 0.30, -0.05, 0.85, -0.55),
        (-0.30, -0.35, 0.35, 0.55, 0.55, -0.65),
        (0.30, -0.25, 0.40, -0.55, 0.40, -0.75),
    ]
)

scene = ms.load_scene(
    Path(__file__).parents[1] / "scenes/workcell.yaml",
    overrides={
        "camera": {
            "kind": "path",
            "keys": [{"eye": row[:3].tolist(), "target": (row[:3] + row[3:]).tolist()} for row in log],
            "intrinsics": {"fx": 300.0, "fy": 300.0, "cx": 160.0, "cy": 90.0},
        },
        "output": {"width": 320, "height": 180, "layouts": 1, "views": len(log), "formats": ["coco", "poses"]},
    },
)
out = folder / "cell"
ms.write_dataset(scene, out)

(path,) = (path for path in (out / "annotations").glob("poses_*.json") if json.loads(path.read_text())["frames"])
frames = json.loads(path.read_text())["frames"]
eyes = np.array([frame["camera"]["world_from_camera"] for frame in frames])[:, :3, 3]
for frame in frames:
    near = min(frame["instances"], key=lambda entry: entry["camera_from_object"][2][3])
    print(
        f"{frame['file_name']}: nearest is {near['class']}, {near['camera_from_object'][2][3]:.3f} m before the camera"
    )
print(out)

assert np.allclose(eyes, log[:, :3], atol=1e-9)
