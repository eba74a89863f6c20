"""A dataset's BOP scenes in the BOP toolkit, and the toolkit's visibility compared with the exact one.

    PYTHONPATH=../bop_toolkit python -m benchmarks.labels.bop DATASET [--delta 15]

Requires the BOP toolkit (its readers, ``misc`` and ``visibility``) with imageio and pypng. Models are ray cast in their
recorded poses on a canvas of nine images, like ``scripts/calc_gt_info.py`` renders them. With ``labels: {source:
proxies}`` the silhouettes must be equal. Visible fractions differ where an occluder is closer to an instance than the
toolkit's tolerance [mm].
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import figure, recording
from mitsplat.renderer.rays.device_arrays import ray_scene
from mitsplat.runtime.variant import ensure_variant


def cast(mesh: Any, rotation: Any, shift: Any, matrix: Any, width: int, height: int) -> np.ndarray:
    """Return the depth [mm] of a mesh in a pose, 0 for a miss, shape (height, width)."""
    import mitsuba as mi

    y, x = np.mgrid[:height, :width]
    slopes = np.linalg.inv(matrix) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    directions, origin = rotation.T @ slopes, -rotation.T @ shift.ravel()
    ray = mi.Ray3f(
        mi.Point3f(*map(float, origin)), mi.Vector3f(*(mi.Float(row.astype(np.float32)) for row in directions))
    )
    hit = mesh.ray_intersect_preliminary(ray)
    depth = np.where(np.array(hit.is_valid()), np.array(hit.t), 0)  # directions have z = 1, so t is the depth
    return depth.reshape(height, width).astype(np.float32)


def main() -> None:
    """Print the differences."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--delta", type=float, default=15.0)
    options = parser.parse_args()
    with recording("labels.bop", parser, options, ignore=("dataset",)):
        compare(options)


def compare(options: argparse.Namespace) -> None:
    """Ray cast every model of every image."""
    from bop_toolkit_lib import inout, misc, visibility

    ensure_variant()
    root = options.dataset / "bop"
    info = inout.load_json(root / "models/models_info.json", keys_to_int=True)
    meshes, sizes = {}, []
    for number, stated in info.items():
        path = str(root / f"models/obj_{number:06d}.ply")
        extents = np.ptp(inout.load_ply(path)["pts"], axis=0)
        sizes.append(np.abs(extents - [stated[f"size_{axis}"] for axis in "xyz"]).max())
        meshes[number] = ray_scene({"mesh": {"type": "ply", "filename": path}})
    silhouettes, shares, boxes, counts, frames = [], [], [], [], 0
    for scene in sorted(path for path in root.glob("*/*") if (path / "scene_gt.json").is_file()):
        cameras, poses = (
            inout.load_scene_camera(scene / "scene_camera.json"),
            inout.load_scene_gt(scene / "scene_gt.json"),
        )
        infos = inout.load_json(scene / "scene_gt_info.json", keys_to_int=True)
        for index, placed in poses.items():
            frames += 1
            matrix = cameras[index]["cam_K"]
            depth = inout.load_depth(scene / f"depth/{index:06d}.png") * cameras[index]["depth_scale"]
            height, width = depth.shape
            wide = matrix + np.array([[0, 0, width], [0, 0, height], [0, 0, 0]])
            for position, pose in enumerate(placed):
                large = cast(meshes[pose["obj_id"]], pose["cam_R_m2c"], pose["cam_t_m2c"], wide, 3 * width, 3 * height)
                model = large[height : 2 * height, width : 2 * width]
                seen = visibility.estimate_visib_mask_gt(
                    misc.depth_im_to_dist_im_fast(depth, matrix),
                    misc.depth_im_to_dist_im_fast(model, matrix),
                    options.delta,
                )
                mask, visible = (
                    inout.load_im(scene / f"{folder}/{index:06d}_{position:06d}.png") > 0
                    for folder in ("mask", "mask_visib")
                )
                stated = infos[index][position]
                counts.append(abs(stated["px_count_visib"] - int(visible.sum())))
                silhouettes.append(np.count_nonzero(mask ^ (model > 0)) / max(1, np.count_nonzero(mask)))
                shares.append(stated["visib_fract"] - seen.sum() / max(1, np.count_nonzero(large)))
                ys, xs = large.nonzero()
                box = misc.calc_2d_bbox(xs - width, ys - height, (width, height))
                boxes.append(np.abs(np.array(box) - stated["bbox_obj"]).max())
    for value, unit, what in (
        (frames, "", "images"),
        (len(shares), "", "instances"),
        (np.max(silhouettes), "", "silhouettes worst"),
        (np.median(silhouettes), "", "silhouettes median"),
        (np.max(boxes), "px", "boxes worst"),
        ((np.min(shares), np.max(shares)), "", "visible fraction"),
    ):
        figure(value, unit, what)
    print(
        f"{frames} images, {len(shares)} instances; model sizes agree with the stated ones within {max(sizes):.4f} mm"
    )
    print(f"visible pixels of masks and scene_gt_info: at most {max(counts)} apart")
    print(f"pixels of silhouettes that differ: median {np.median(silhouettes):.2%}, worst {np.max(silhouettes):.2%}")
    print(f"boxes of silhouettes: median {np.median(boxes):.0f} px apart, worst {np.max(boxes):.0f} px")
    print(
        f"visible fraction minus the toolkit's at {options.delta:g} mm: median {np.median(shares):+.4f}, "
        f"from {np.min(shares):+.4f} to {np.max(shares):+.4f}"
    )


if __name__ == "__main__":
    main()
