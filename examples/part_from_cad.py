"""Make an asset from a part that is modelled in code, drop it into a tray, and render labelled images.

    python examples/part_from_cad.py [FOLDER]

The asset, the scene and the images are written to FOLDER, by default a temporary folder.
"""

import sys
import tempfile
from pathlib import Path

import cv2
import trimesh

import mitsplat as ms

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())

# A flange of 40 mm with a hub and a bore, in metres, z up.
plate = trimesh.creation.cylinder(radius=0.02, height=0.006)
hub = trimesh.creation.cylinder(radius=0.01, height=0.02).apply_translation((0, 0, 0.01))
bore = trimesh.creation.cylinder(radius=0.005, height=0.06)
flange = trimesh.boolean.difference([trimesh.boolean.union([plate, hub]), bore])
flange.visual.face_colors = (190, 110, 40, 255)

# 1,000 Gaussians bake quickly. Without `settings`, the asset has 20,000.
result = ms.bake_asset(flange, name="flange", density=7800, settings=ms.BakeSettings(gaussians=1000))
result.asset.save(folder / "flange")
print(f"baked: {result.psnr:.1f} dB on unseen views")

(folder / "scene.yaml").write_text("""
name: flanges
shapes:
  - {name: tray, visible: true, colour: [0.5, 0.55, 0.55], box: {size: [0.4, 0.4, 0.02], position: [0, 0, -0.01]}}
objects:
  - {asset: flange, count: 4}
region: {min: [-0.05, -0.05, 0.03], max: [0.05, 0.05, 0.1]}
enclosure: {margin: 0.03}
camera: {kind: orbit, target: [0, 0, 0.01], radius: 0.2, height: 0.25, intrinsics: {fov_x: 45}}
lights:
  - {kind: area, position: [0.3, -0.3, 0.8], target: [0, 0, 0], size: [0.3, 0.3], radiance: 12}
  - {kind: environment, radiance: 0.3}
output: {width: 320, height: 240, layouts: 1, views: 1}
""")
frame = ms.render_frame(ms.load_scene(folder / "scene.yaml"), 0)
cv2.imwrite(str(folder / "frame.png"), frame.image[..., ::-1])
for label in frame.labels.instances:
    print(f"{label.class_name} {label.id}: box {label.box}, {label.visible_fraction:.0%} visible")
print(folder / "frame.png")

assert {label.class_name for label in frame.labels.instances} == {"flange"}
