"""Audit of datasets from faulty writers: each writes a complete, self-consistent dataset with one fault that is
reported.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_mask
from scipy.spatial.transform import Rotation

import mitsplat
from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset.shard_file import Shard
from mitsplat.dataset.shards import merge_shards
from mitsplat.dataset.write import write_dataset
from mitsplat.formats import bop, coco, colmap, map_files, maps, yolo
from mitsplat.formats import registry as writers
from mitsplat.frames import frame
from mitsplat.geometry import camera
from mitsplat.labels import labels as label
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.camera_spec import Intrinsics
from mitsplat.scene.spec.image_spec import TimeOfFlightSensor
from mitsplat.scene.spec.scene_spec import FORMATS
from tests.conftest import BOTH, box_asset, small_scene
from tests.drawn import large_boxes, render_boxes, scatter_boxes
from tests.manifests import records_of, store

Patch = Callable[[pytest.MonkeyPatch], None]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return small_scene(tmp_path_factory.mktemp("scene"), large_boxes(), BOTH, layouts=3, views=2)


def write(scene: Scene, out: Path, formats: list[str], **options: Any) -> Path:
    output = scene.spec.output.model_copy(update={"formats": tuple(formats)})
    sensor = TimeOfFlightSensor()
    changed = replace(scene, spec=scene.spec.model_copy(update={"output": output, "depth_sensor": sensor}))
    return write_dataset(changed, out, render=render_boxes, settle=scatter_boxes, **options).path


def changing(owner: Any, name: str, change: Callable[..., Any]) -> Patch:
    """Patch a writer to return ``change(result, *args)``."""
    made = getattr(owner, name)

    def wrapped(*args: Any, **options: Any) -> Any:
        return change(made(*args, **options), *args)

    return lambda patch: patch.setattr(owner, name, wrapped)


def each_annotation(change: Callable[[dict[str, Any]], object]) -> Patch:
    def change_all(made: Any, *args: Any) -> Any:
        for entry in made:
            change(entry)
            yield entry

    return changing(coco, "annotations_of", change_all)


def each_segment(change: Callable[[dict[str, Any]], object]) -> Patch:
    def change_all(made: dict[str, Any], *args: Any) -> Any:
        for segment in made["segments_info"]:
            change(segment)
        return made

    return changing(coco, "panoptic_annotation", change_all)


def each_entry(owner: Any, name: str, change: Callable[[dict[str, Any]], object]) -> Patch:
    def change_all(made: Any, *args: Any) -> Any:
        for entry in made:
            change(entry)
        return made

    return changing(owner, name, change_all)


def entry(owner: Any, name: str, change: Callable[[dict[str, Any]], object]) -> Patch:
    def changed(made: Any, *args: Any) -> Any:
        change(made)
        return made

    return changing(owner, name, changed)


def task(name: str, change: Callable[[Any], Any]) -> Patch:
    """Patch a YOLO task to write changed numbers on every line [px]."""
    real = yolo.TASKS[name]
    return lambda patch: patch.setitem(yolo.TASKS, name, yolo.Task(real.folder, lambda *of: change(real.numbers(*of))))


def by_rows(code: dict[str, Any]) -> dict[str, Any]:
    """Encode the same mask with its runs counted along rows instead of columns."""
    mask = coco_mask.decode(code)
    turned = np.asfortranarray(mask.ravel(order="C").reshape(mask.shape, order="F"))
    return {"size": code["size"], "counts": coco_mask.encode(turned)["counts"].decode()}


def inverse(flat: list[float]) -> list[float]:
    return list(np.array(flat).reshape(3, 3).T.ravel())


class Swapped(Rotation):
    """Rotation whose quaternion is scalar-first, although COLMAP's writer expects scalar-last."""

    @classmethod
    def from_matrix(cls, matrix: Any) -> Any:
        x, y, z, w = Rotation.from_matrix(matrix).as_quat()
        return SimpleNamespace(as_quat=lambda: (w, x, y, z))


def with_camera(change: Callable[[camera.Camera], Any]) -> Patch:
    """Patch the modules that write cameras to write a changed camera."""

    def patch(monkeypatch: pytest.MonkeyPatch) -> None:
        for owner in (coco, bop, colmap):
            read = SimpleNamespace(from_json=lambda stored: change(camera.Camera.from_json(stored)))
            monkeypatch.setattr(owner, "Camera", read)

    return patch


def world_for_camera(it: camera.Camera) -> camera.Camera:
    return replace(it, world_from_camera=it.camera_from_world)


def millimetres_for_metres(it: camera.Camera) -> camera.Camera:
    pose = np.array(it.world_from_camera)
    pose[:3, 3] *= 1000
    return replace(it, world_from_camera=pose)


def swap(entry: dict[str, Any], one: str, other: str) -> None:
    entry[one], entry[other] = entry[other], entry[one]


def add_to(place: list[Any], position: int, amount: float) -> None:
    place[position] += amount


def models_in_metres(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(bop, "MILLIMETRES", 1.0)  # also scales poses, so that all values are consistent


def record_camera(change: Callable[[Any], Any]) -> Patch:
    """Patch the manifest to record a camera that differs from that of the image; all formats follow the manifest."""
    real = writers.write_frame

    def write_frame(frame: Any, *args: Any) -> Any:
        seen = replace(frame, plan=replace(frame.plan, camera=change(frame.camera)))
        return real(seen, *args)

    return lambda patch: patch.setattr("mitsplat.dataset.frame_job.write_frame", write_frame)


def farther(it: camera.Camera) -> camera.Camera:
    return replace(it, fx=it.fx * 1.01, fy=it.fy * 1.01)


COCO, AMODAL = "annotations/instances_train.json", "annotations/amodal_train.json"
POLYGONS = "annotations/polygons_train.json"
PANOPTIC, POSES = "annotations/panoptic_train.json", "annotations/poses_train.json"
GT, INFO, BOP_CAMERA = (f"bop/train/000000/scene_{part}.json" for part in ("gt", "gt_info", "camera"))
OTHER = {1: 2, 2: 1, 3: 3}

FAULTS: dict[str, tuple[str, Patch, str, str]] = {
    "coco: box one too far": ("coco", each_annotation(lambda e: add_to(e["bbox"], 0, 1)), COCO, "bbox is"),
    "coco: box to its last pixel": ("coco", each_annotation(lambda e: add_to(e["bbox"], 2, -1)), COCO, "bbox is"),
    "coco: box as corners": (
        "coco",
        each_annotation(lambda e: (add_to(e["bbox"], 2, e["bbox"][0]), add_to(e["bbox"], 3, e["bbox"][1]))),
        COCO,
        "bbox is",
    ),
    "coco: runs along rows": (
        "coco",
        each_annotation(lambda e: e.update(segmentation=by_rows(e["segmentation"]))),
        COCO,
        "differs from its mask",
    ),
    "coco: size as width, height": (
        "coco",
        each_annotation(lambda e: e["segmentation"]["size"].reverse()),
        COCO,
        "not a run-length code",
    ),
    "coco: classes swapped": (
        "coco",
        each_annotation(lambda e: e.update(category_id=OTHER[e["category_id"]])),
        COCO,
        "category_id is",
    ),
    "coco: classes from zero": ("coco", each_annotation(lambda e: e.update(category_id=0)), COCO, "category_id is"),
    "coco: one id for all": ("coco", each_annotation(lambda e: e.update(id=1)), COCO, "id 1 is not above"),
    "coco: area of the box": (
        "coco",
        each_annotation(lambda e: e.update(area=e["bbox"][2] * e["bbox"][3])),
        COCO,
        "area is",
    ),
    "coco-polygons: shifted": (
        "coco-polygons",
        each_annotation(lambda e: add_to(e["segmentation"][0], 0, 3)),
        POLYGONS,
        "differs from its mask",
    ),
    "coco-polygons: one part only": (
        "coco-polygons",
        each_annotation(lambda e: e.update(segmentation=[])),
        POLYGONS,
        "is no mask that pycocotools reads",
    ),
    "coco-polygons: run lengths": (
        "coco-polygons",
        each_annotation(lambda e: e.update(segmentation={"size": [48, 64], "counts": ""})),
        POLYGONS,
        "is no mask that pycocotools reads",
    ),
    "bop: camera.json with OpenGL's pixel centres": (
        "bop",
        entry(bop, "dataset_camera", lambda e: e.update(cx=e["cx"] + 0.5)),
        "bop/camera.json",
        "cx is not that of the first frame",
    ),
    "coco: no info": (
        "coco",
        lambda patch: patch.setattr(coco, "_HEAD", {}),
        COCO,
        "cannot be read by pycocotools (KeyError: 'info')",
    ),
    "amodal: seen for covered": (
        "amodal",
        each_annotation(lambda e: swap(e, "segmentation", "visible_segmentation")),
        AMODAL,
        "differs from its mask",
    ),
    "panoptic: box one too far": ("panoptic", each_segment(lambda e: add_to(e["bbox"], 1, 1)), PANOPTIC, "bbox is"),
    "panoptic: classes swapped": (
        "panoptic",
        each_segment(lambda e: e.update(category_id=OTHER[e["category_id"]])),
        PANOPTIC,
        "category_id is",
    ),
    "panoptic: blue for red": (
        "panoptic",
        changing(coco, "panoptic_image", lambda made, *args: made[..., ::-1]),
        "panoptic/train/000000.png",
        "differ from the masks",
    ),
    "panoptic: environment one too far": (
        "panoptic",
        entry(coco, "environment_segment", lambda e: add_to(e["box"], 2, -1)),
        "panoptic/train/000000.png",
        "its environment has the box",
    ),
    "poses: world for camera": ("poses", with_camera(world_for_camera), POSES, "camera_from_object differs"),
    "poses: millimetres": ("poses", with_camera(millimetres_for_metres), POSES, "camera_from_object differs"),
    "poses: objects from one": (
        "poses",
        entry(
            coco,
            "pose_entry",
            lambda e: [instance.update(object=instance["object"] + 1) for instance in e["instances"]],
        ),
        POSES,
        "object is",
    ),
    "bop: millimetres and metres": ("bop", models_in_metres, GT, "cam_t_m2c is"),
    "bop: world for camera": ("bop", with_camera(world_for_camera), GT, "cam_R_m2c is"),
    "bop: rotation transposed": (
        "bop",
        each_entry(bop, "pose_entries", lambda e: e.update(cam_R_m2c=inverse(e["cam_R_m2c"]))),
        GT,
        "cam_R_m2c is",
    ),
    "bop: objects from zero": (
        "bop",
        each_entry(bop, "pose_entries", lambda e: e.update(obj_id=e["obj_id"] - 1)),
        GT,
        "obj_id is",
    ),
    "bop: box one too wide": (
        "bop",
        each_entry(bop, "info_entries", lambda e: add_to(e["bbox_visib"], 2, 1)),
        INFO,
        "bbox_visib is",
    ),
    "bop: counts swapped": (
        "bop",
        each_entry(bop, "info_entries", lambda e: e.update(px_count_valid=e["px_count_visib"] - 1)),
        INFO,
        "px_count_valid is",
    ),
    "bop: principal point at +0.5": (
        "bop",
        entry(bop, "camera_entry", lambda e: add_to(e["cam_K"], 2, 0.5)),
        BOP_CAMERA,
        "cam_K is",
    ),
    "bop: masks swapped": (
        "bop",
        changing(
            bop,
            "mask_pictures",
            lambda made, *args: [({"mask": "mask_visib"}.get(folder, "mask"), *rest) for folder, *rest in made],
        ),
        "bop/train/",
        "differ from the manifest's mask",
    ),
    "bop: models in metres": (
        "bop",
        changing(bop, "write_models", lambda made, root, meshes: bop_models(root, meshes, 0.001)),
        "bop/models/obj_000001.ply",
        "does not fit its silhouettes",
    ),
    "colmap: scalar first for last": (
        "colmap",
        lambda patch: patch.setattr(colmap, "Rotation", Swapped),
        "colmap/images.txt",
        "its pose differs",
    ),
    "colmap: world for camera": ("colmap", with_camera(world_for_camera), "colmap/images.txt", "its pose differs"),
    "colmap: principal point at 0": (
        "colmap",
        with_camera(lambda it: replace(it, cx=it.cx - 0.5)),
        "colmap/images.txt",
        "its camera differs",
    ),
    "yolo: one pixel off": (
        "yolo",
        task("yolo", lambda made: made + 1.0),
        "labels/train/000000.txt",
        "reproduce its mask",
    ),
    "yolo: x and y swapped": (
        "yolo",
        task("yolo", lambda made: made[:, ::-1]),
        "labels/train/000000.txt",
        "its polygon",
    ),
    "yolo: class names swapped": (
        "yolo",
        changing(yolo, "data_yaml", lambda made, *args: made.replace("0:", "2:").replace("1:", "0:")),
        "data.yaml",
        "names are",
    ),
    "yolo-detect: corner for middle": (
        "yolo-detect",
        task("yolo-detect", lambda made: made - np.array([made[2] / 2, made[3] / 2, 0, 0])),
        "yolo-detect/labels/train/000000.txt",
        "does not match its box",
    ),
    "yolo-obb: pixels' centres": (
        "yolo-obb",
        task("yolo-obb", lambda made: made.mean(axis=0) + 0.85 * (made - made.mean(axis=0))),
        "yolo-obb/labels/train/000000.txt",
        "pixels lie outside",
    ),
    "yolo-obb: twice as large": (
        "yolo-obb",
        task("yolo-obb", lambda made: made.mean(axis=0) + 1.4 * (made - made.mean(axis=0))),
        "yolo-obb/labels/train/000000.txt",
        "fits",
    ),
    "instances: classes for ids": (
        "instances",
        changing(maps, "instance_picture", lambda made, *args: np.minimum(made, 2)),
        "instances/train/000000.png",
        "differ from the masks",
    ),
    "semantic: classes from zero": (
        "semantic",
        changing(map_files, "semantic_picture", lambda made, *args: np.where(made > 0, made - 1, made)),
        "semantic/train/000000.png",
        "differ from the masks' classes",
    ),
    "depth: metres": (
        "depth",
        changing(maps, "depth_picture", lambda made, *args: np.maximum(made // 1000, made > 0).astype(np.uint16)),
        "manifest.jsonl",
        "depths of asset",
    ),
    "depth-sensor: metres": (
        "depth-sensor exr",
        changing(map_files, "depth_picture", lambda made, *args: np.maximum(made // 1000, made > 0).astype(np.uint16)),
        "depth-sensor/train/000000.png",
        "have a median error",
    ),
    "exr: distances for depths": (
        "exr depth",
        changing(maps, "depth_picture", lambda made, *args: (made + 20 * (made > 0)).astype(np.uint16)),
        "depth/train/000000.png",
        "another depth",
    ),
    "normals: blue for red": (
        "exr normals",
        changing(map_files, "normal_picture", lambda made, *args: made[..., ::-1]),
        "normals/train/000000.png",
        "differ from the normals",
    ),
    "flow: backwards": (
        "depth flow",
        changing(frame, "optical_flow", lambda made, *args: -made),
        "flow/train/000000.flo",
        "contradicts depth",
    ),
    "manifest: runs along rows": (
        "instances",
        changing(label, "encode_mask", lambda made, mask, box, size: rows_of(made, size)),
        "manifest.jsonl",
        "",
    ),
    "manifest: world for camera": (
        "yolo",
        record_camera(world_for_camera),
        "manifest.jsonl, frame 0",
        "off the scene's orbit",
    ),
    "manifest: focal length": ("yolo", record_camera(farther), "manifest.jsonl, frame 0", "its intrinsics are not"),
}


def bop_models(root: Path, meshes: dict[int, Any], scale: float) -> None:
    REAL_MODELS(root, {number: mesh.copy().apply_scale(scale) for number, mesh in meshes.items()})


REAL_MODELS = bop.write_models


def rows_of(code: str, size: tuple[int, int]) -> str:
    return str(by_rows({"size": [size[1], size[0]], "counts": code})["counts"])


SLOW = ("colmap: principal point at 0", "colmap: world for camera")
"""Faults of COLMAP beside the quick one: each audit starts a process that imports pycolmap."""


@pytest.mark.parametrize(
    "fault", [pytest.param(fault, marks=pytest.mark.extended if fault in SLOW else ()) for fault in FAULTS]
)
def test_the_fault_of_each_wrong_writer_is_a_violation(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    formats, patch, file, text = FAULTS[fault]
    with monkeypatch.context() as patched:
        patch(patched)
        out = write(scene, tmp_path / "out", formats.split())
    found = audit_dataset(out).violations
    assert any(where.startswith(file) and text in violation for where, violation in found), found


def test_all_formats_of_merged_shards_have_no_violations(scene: Scene, tmp_path: Path) -> None:
    """Merged shards with all formats pass the audit."""
    formats = list(FORMATS)
    shards = [write(scene, tmp_path / str(number), formats, shard=Shard(number, 2)) for number in (1, 2)]
    merge_shards(shards, tmp_path / "out")
    assert audit_dataset(tmp_path / "out").violations == ()


def test_poses_that_differ_from_the_layout_are_violations(scene: Scene, tmp_path: Path) -> None:
    out = write(scene, tmp_path / "out", ["yolo"])
    (out / "layouts/0000.json").write_text((out / "layouts/0001.json").read_text())
    texts = [text for _, text in audit_dataset(out).violations]
    assert any("has another pose than in layouts/0000.json" in text for text in texts)
    assert "is of layout 1" in texts


@pytest.mark.parametrize("shift", [0, 3])
def test_flow_may_differ_by_the_rounding_of_depth(scene: Scene, tmp_path: Path, shift: int) -> None:
    """Depths in units of 100 mm contain the true depth, from which the flow was computed, unless they are shifted."""
    out = write(scene, tmp_path / "out", ["depth", "flow"])
    records = records_of(out)
    for one in records:
        path = out / f"depth/{one['split']}/{one['index']:06d}.png"
        millimetres = one["depth_scale"] * cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), (np.rint(millimetres / 100) + shift).astype(np.uint16))
        one["depth_scale"] = 100.0
    store(out, records)
    found = {file for file, _ in audit_dataset(out).violations if file.startswith("flow/")}
    assert found == ({file for one in records for file in one["files"] if file.startswith("flow/")} if shift else set())


def test_small_objects_far_from_the_image_corner_have_no_violation(tmp_path: Path) -> None:
    """Offsets between silhouettes and poses are compared with the size of objects, about 10 of 240 px."""
    sizes = {"nut": (0.02, 0.025, 0.015), "bolt": (0.012, 0.012, 0.04)}
    boxes = [box_asset(name, size) for name, size in sizes.items()]
    scene = small_scene(tmp_path, boxes, BOTH, layouts=4, views=2, width=240, height=180, formats=["yolo"])
    found = audit_dataset(write_dataset(scene, tmp_path / "out", render=render_boxes, settle=scatter_boxes).path)
    assert found.violations == () and found.instances > 24


WRITERS = ("formats", "frames", "labels", "plugins", "renderer")
"""Packages that make and write labels."""


def test_the_audit_imports_no_writer() -> None:
    package = Path(mitsplat.__file__).parent
    readers = list((package / "audit").glob("*.py"))
    assert len(readers) > 8
    for path in (*readers, *(package / "dataset/records").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mitsplat"):
                taken = {f"{node.module}.{alias.name}".split(".")[1] for alias in node.names}
                assert not taken & set(WRITERS), (path, node.lineno)


@pytest.mark.parametrize(
    "lens",
    [
        {"lens": "fisheye", "fx": 40.0, "fy": 41.0, "cx": 31.0, "cy": 25.0, "distortion": (0.02, -0.01, 0.003, 0.001)},
        pytest.param(
            {"fov_x": 70.0, "distortion": (0.05, -0.02, 0.002, -0.001, 0.01, 0.003, 0.002, 0.001)},
            marks=pytest.mark.extended,
        ),
    ],
    ids=["fisheye", "distorted"],
)
def test_every_lens_passes_and_swapped_coefficients_are_violations(tmp_path: Path, lens: dict[str, Any]) -> None:
    """Correct writers pass for every lens. Coefficients in the wrong order are a violation."""
    scene = small_scene(tmp_path, large_boxes(), BOTH, layouts=2, views=2)
    seen = scene.spec.camera.model_copy(update={"intrinsics": Intrinsics(**lens)})
    scene = replace(scene, spec=scene.spec.model_copy(update={"camera": seen}))
    out = write(scene, tmp_path / "out", ["colmap", "depth", "exr", "flow", "poses"])
    assert audit_dataset(out).violations == ()
    path = out / "colmap/cameras.txt"
    words = path.read_text().split()
    words[8], words[9] = words[9], words[8]
    path.write_text(" ".join(words) + "\n")
    assert {file for file, _ in audit_dataset(out).violations} == {"colmap/images.txt"}
