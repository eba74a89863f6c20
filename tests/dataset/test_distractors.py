"""Datasets with pools, distractors and empty layouts: label files without distractors, and their manifest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mitsplat.audit.audit import audit_dataset
from mitsplat.dataset import frame_job
from mitsplat.dataset.shard_file import Shard
from mitsplat.dataset.shards import merge_shards
from mitsplat.dataset.write import write_dataset
from mitsplat.formats.registry import write_frame
from mitsplat.scene.layout import Instance, Layout
from mitsplat.scene.planning.contents import draw_objects
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.scene_spec import FORMATS
from mitsplat.scene.streams import random_stream
from tests.conftest import box_asset, small_scene
from tests.drawn import large_boxes, render_boxes
from tests.manifests import records_of
from tests.synthetic import CERTIFICATE

OBJECTS = [
    {"pool": ["assets/nut", "assets/bolt"], "count": [2, 4], "balance": True, "scale": [0.7, 1.2]},
    {"asset": "assets/crate", "count": 2, "label": False},
]


def scatter_drawn(scene: Scene, index: int, *, progress: Any) -> Layout:
    """Return a layout of the drawn objects at random poses, without physics."""
    rng = random_stream(scene.spec.seed, "drawn layout", index)
    instances = []
    for number, asset in enumerate(draw_objects(scene, index)[0]):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-0.17, 0.17, 3)
        instances.append(Instance(number + 1, asset, scene.class_index(asset), pose))
    return Layout(index, tuple(instances), CERTIFICATE)


def write(scene: Scene, out: Path, **options: Any) -> Path:
    return write_dataset(scene, out, **({"render": render_boxes, "settle": scatter_drawn} | options)).path


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("distractors")
    assets = [*large_boxes(), box_asset("crate", (0.1, 0.1, 0.1))]
    small = small_scene(
        folder, assets, OBJECTS, layouts=8, views=2, formats=[name for name in FORMATS if name != "colmap"]
    )
    return replace(small, spec=small.spec.model_copy(update={"empty": 0.25}))


@pytest.fixture(scope="module")
def made(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(scene, tmp_path_factory.mktemp("made") / "out")


def test_a_dataset_with_distractors_has_no_violations(made: Path) -> None:
    found = audit_dataset(made)
    assert found.violations == ()
    assert found.frames == 16 and found.instances > 16


def test_a_dataset_without_labelled_objects_has_no_violations(tmp_path: Path) -> None:
    formats = [name for name in FORMATS if name not in ("colmap", "yolo-pose")]
    scene = small_scene(tmp_path, [*large_boxes(), box_asset("crate", (0.1, 0.1, 0.1))], OBJECTS[1:], formats=formats)
    out = write(scene, tmp_path / "out")
    assert "names: {}\n" in (out / "data.yaml").read_text()
    assert audit_dataset(out).violations == ()


def test_a_dataset_with_a_test_split_only_has_no_violations(tmp_path: Path) -> None:
    scene = small_scene(tmp_path, large_boxes(), OBJECTS[:1], layouts=2, formats=["yolo", "yolo-pose"])
    output = scene.spec.output.model_copy(update={"validation": 0.0, "test": 0.5})
    out = write(replace(scene, spec=scene.spec.model_copy(update={"output": output})), tmp_path / "out")
    assert {record["split"] for record in records_of(out)} == {"train", "test"}
    assert audit_dataset(out).violations == ()


def test_the_manifest_records_every_draw(made: Path, scene: Scene) -> None:
    empty = set()
    for record in records_of(made):
        assets = draw_objects(scene, record["layout"])[0]
        assert [drawn["asset"] for drawn in record["objects"]] == list(assets)
        for drawn in record["objects"]:
            asset = scene.assets[drawn["asset"]]
            assert asset.mesh is not None
            assert drawn["name"] == asset.name
            assert drawn["label"] == (asset.name != "crate") == (drawn["entry"] == 0)
            edge = {"nut": 0.16, "bolt": 0.25, "crate": 0.1}[asset.name]
            assert asset.mesh.extents.max() == pytest.approx(edge * drawn["scale"])
        if record["empty"]:
            empty.add(record["layout"])
            assert {drawn["label"] for drawn in record["objects"]} == {False}
        assert record["empty"] != any(drawn["label"] for drawn in record["objects"])
    assert 0 < len(empty) < 4  # a quarter of each split


def test_distractors_are_in_no_label_file(made: Path) -> None:
    """Label maps omit distractors too: their pixels are the environment's, also where they occlude an object."""
    seen = 0
    for path in made.rglob("*"):
        if path.suffix in (".txt", ".json", ".xml", ".yaml", ".ply") and path.parent.name not in ("scene", "layouts"):
            stated = path.read_text()
            assert "crate" not in stated or path.name in ("dataset.json", "poses.json"), path
    assert {path.name for path in (made / "bop/models").glob("*.ply")} == {f"obj_{n:06d}.ply" for n in range(1, 11)}
    for record in records_of(made):
        distractors = [drawn["id"] for drawn in record["objects"] if not drawn["label"]]
        assert not {label["id"] for label in record["labels"]["instances"]} & set(distractors)
        name = f"{record['split']}/{record['index']:06d}"
        semantic = cv2.imread(str(made / f"semantic/{name}.png"), cv2.IMREAD_UNCHANGED)
        labelled = cv2.imread(str(made / f"instances/{name}.png"), cv2.IMREAD_UNCHANGED)
        panoptic = cv2.imread(str(made / f"panoptic/{name}.png"))[..., ::-1].astype(int) @ (1, 256, 65536)
        assert ((semantic == 0) == (labelled == 0))[semantic < 255].all()
        assert (panoptic[semantic == 0] == record["environment"]["id"]).all()
        seen += len(record["labels"]["instances"])
        if record["empty"]:
            assert (made / f"labels/{name}.txt").read_text() == ""
            assert not semantic.any()
    assert seen > 16


@pytest.mark.parametrize("part", [pytest.param("workers", marks=pytest.mark.extended), "shards"])
def test_workers_and_merged_shards_make_the_same_bytes(made: Path, scene: Scene, tmp_path: Path, part: str) -> None:
    if part == "workers":
        out = write(scene, tmp_path / "out", workers=3)
    else:
        parts = [write(scene, tmp_path / f"part{n}", shard=Shard(n, 2)) for n in (1, 2)]
        out = merge_shards(parts, tmp_path / "out").path
    whole = {path.relative_to(made): path for path in made.rglob("*") if path.is_file() and path.name != ".lock"}
    other = {path.relative_to(out) for path in out.rglob("*") if path.is_file() and path.name != ".lock"}
    assert other == set(whole)
    for name in other - {Path("timings.jsonl"), Path("runs.jsonl")}:
        assert (out / name).read_bytes() == whole[name].read_bytes(), name


@pytest.fixture(scope="module")
def yolo_scene(scene: Scene) -> Scene:
    """Return the scene with the YOLO format only, for faults that the manifest and the layouts show."""
    output = scene.spec.output.model_copy(update={"formats": ("yolo",)})
    return replace(scene, spec=scene.spec.model_copy(update={"output": output}))


def labelling_distractors(scene: Scene, index: int, *, layout: Layout) -> Any:
    """Render as :func:`render_boxes`, but label all objects as the first class."""
    return render_boxes(
        scene, index, layout=replace(layout, instances=tuple(replace(one, class_index=0) for one in layout.instances))
    )


def test_a_labelled_distractor_is_a_violation(yolo_scene: Scene, tmp_path: Path) -> None:
    out = write(yolo_scene, tmp_path / "out", render=labelling_distractors)
    texts = [text for _, text in audit_dataset(out).violations]
    assert any("is labelled, although its asset is a distractor" in text for text in texts)
    assert any("although its layout is empty" in text for text in texts)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda drawn: drawn.pop(), "its objects differ from those of layouts/"),
        (lambda drawn: drawn[0].update(asset=drawn[0]["asset"] + 1), "its objects differ from those of layouts/"),
        (lambda drawn: drawn[0].update(label=False), "instance 1 is not among the drawn objects"),
    ],
)
def test_wrongly_recorded_draws_are_violations(
    yolo_scene: Scene, tmp_path: Path, change: Callable[[Any], object], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrongly(*given: Any) -> Any:
        record = write_frame(*given)
        change(record["objects"])
        return record

    monkeypatch.setattr(frame_job, "write_frame", wrongly)
    out = write(yolo_scene, tmp_path / "out")
    assert any(text in found for _, found in audit_dataset(out).violations)
