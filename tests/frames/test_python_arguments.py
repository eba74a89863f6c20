"""Arguments of the wrong type or number in the Python API are refused in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsplat as ms
from mitsplat.scene.planning.frame_plan import plan_frame
from tests.conftest import WriteScene

PATH = {"kind": "path", "keys": [{"eye": [0, -0.4, 0.3], "target": [0, 0, 0]}]}


@pytest.fixture
def scene(write_scene: WriteScene, scene_data: dict[str, Any]) -> ms.Scene:
    """Return a scene whose camera has a field named like a method of mappings."""
    scene_data["objects"][0]["count"] = 3
    return ms.load_scene(write_scene(scene_data | {"camera": PATH}))


def film(scene: Any, **arguments: Any) -> list[ms.Frame]:
    return list(ms.render_frames(scene, progress=False, **arguments))


@pytest.mark.parametrize(
    ("lights", "sentence"),
    [
        ([{"kind": "area", "position": [0, 0, 1], "powr": 3}], "SceneSpec: lights[0].powr: is not a known key"),
        ([{"kind": "area"}], "SceneSpec: lights[0].position: is required"),
        (["area"], "SceneSpec: lights[0]: must be"),
        ({"kind": "area", "position": [0, 0, 1]}, "lights must be a list of lights (got a dict)"),
        ("area", "lights must be a list of lights (got a str)"),
    ],
)
def test_invalid_lights_are_refused_beside_a_camera_on_a_path(scene: ms.Scene, lights: Any, sentence: str) -> None:
    with pytest.raises(ms.InputError) as caught:
        plan_frame(scene, 0, lights=lights)
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


def test_an_invalid_part_of_a_specification_with_a_path_is_named(scene_data: dict[str, Any]) -> None:
    from mitsplat.scene.spec.camera_spec import CameraPath

    camera = CameraPath(**PATH)
    with pytest.raises(ms.InputError, match=r"^SceneSpec: seed: must be >= 0 \(got -1\)$"):
        ms.SceneSpec(**scene_data | {"camera": camera, "seed": -1})


POSE = np.eye(4)
CAMERA = ms.Camera(64, 48, 60.0, 60.0, 32.0, 24.0, POSE)
SPLATS = ms.Splats(np.zeros((1, 3)), np.ones((1, 4)), np.ones((1, 3)), np.ones(1), np.zeros((1, 1, 3)))
CALLS: list[tuple[Callable[[ms.Scene, Path], object], str]] = [
    (lambda scene, out: ms.render_frame(scene, 0, layout={"nut": [POSE]}), "layout must be a Layout (got dict"),
    (lambda scene, out: film(scene, layouts={"nut": [POSE]}), "layout must be a Layout (got str 'nut')"),
    (lambda scene, out: ms.render_frame(scene, 0, camera=POSE), "camera must be a Camera (got ndarray)"),
    (lambda scene, out: ms.render_frame("scene.yaml", 0), "scene must be a Scene (got str 'scene.yaml')"),
    (lambda scene, out: film("scene.yaml"), "scene must be a Scene"),
    (lambda scene, out: ms.Renderer(Path("scene.yaml")), "scene must be a Scene"),
    (lambda scene, out: ms.settle_layout("scene.yaml", 0), "scene must be a Scene"),
    (lambda scene, out: ms.write_dataset("scene.yaml", out), "scene must be a Scene"),
    (lambda scene, out: ms.rerender_frame("scene.yaml", 0, out), "scene must be a Scene"),
    (lambda scene, out: ms.write_frames("scene.yaml", out, []), "scene must be a Scene"),
    (lambda scene, out: ms.write_frames(scene, out, 3), "frames must be a list or an iterator of frames (got int)"),
    (lambda scene, out: ms.write_frames(scene, out, [POSE]), "frame 0 must be a Frame (got ndarray)"),
    (lambda scene, out: ms.make_scene({"name": "x"}), "spec must be a SceneSpec (got dict {'name': 'x'})"),
    (lambda scene, out: ms.Layout.from_poses("scene.yaml", {}), "scene must be a Scene"),
    (lambda scene, out: ms.Layout.from_poses(scene, [POSE]), "poses must map names of assets to lists of matrices"),
    (lambda scene, out: ms.Layout.from_poses(scene, {"nut": None}), "poses['nut']: must be a list of matrices"),
    (lambda scene, out: ms.Layout.from_poses(scene, {"nut": 5}), "poses['nut']: must be a list of matrices"),
    (
        lambda scene, out: ms.Layout.from_poses(scene, {"nut": [POSE, POSE]}),
        "poses: must have at least objects[0].count = 3 matrices of nut (got 2)",
    ),
    (
        lambda scene, out: film(scene, frames=3, layouts=[ms.Layout.from_poses(scene, {"bolt": [POSE]})] * 2),
        "layouts must have one item for each of the 3 frames (got 2)",
    ),
    (lambda scene, out: film(scene, frames=[0, 1], cameras=[]), "cameras must have one item for each of the 2 frames"),
    (lambda scene, out: film(scene, frames=CAMERA), "frames must be a whole number (got Camera)"),
    (lambda scene, out: ms.load_scene({"name": "x"}), "path must be a path (got dict {'name': 'x'})"),
    (lambda scene, out: ms.Asset.load(None), "folder must be a path (got NoneType None)"),
    (lambda scene, out: ms.Splats.load(5), "path must be a path (got int 5)"),
    (lambda scene, out: ms.write_frames(scene, [], "out"), "out must be a path (got list [])"),
    (lambda scene, out: ms.write_dataset(scene, 3), "out must be a path (got int 3)"),
    (lambda scene, out: ms.capture_photos(5, str(out)), "photos must be a path (got int 5)"),
    (lambda scene, out: ms.render_splats("a.ply", CAMERA), "splats must be a Splats (got str 'a.ply')"),
    (lambda scene, out: ms.render_splats(SPLATS, POSE), "camera must be a Camera (got ndarray)"),
    (lambda scene, out: ms.use_device(None), "device must be cpu, cuda, cuda:N, cuda:all or auto (got None)"),
    (lambda scene, out: CAMERA.project([[0, 0]]), "points must have shape (N, 3) (got (1, 2))"),
    (lambda scene, out: ms.Layout.from_poses(scene, {None: [POSE]}), "poses[None]: must be an asset of the scene"),
    (lambda scene, out: ms.Layout.from_poses(scene, {"nut": [POSE] * 3}, index=-1), "index must be a whole number"),
    (lambda scene, out: ms.write_dataset(scene, out, frames=[0]), "frames must be a whole number (got list [0])"),
    (lambda scene, out: ms.write_dataset(scene, out, workers="2"), "workers must be a whole number (got str '2')"),
    (lambda scene, out: ms.load_scene(scene.path, overrides=["seed"]), "overrides must map dotted keys to values"),
    (lambda scene, out: ms.load_scene(scene.path, overrides={5: 3}), "overrides must map dotted keys to values"),
    (
        lambda scene, out: ms.load_scene(scene.path, overrides={"seed": {1}}),
        "overrides['seed']: must be a value of a YAML file (got set {1})",
    ),
    (lambda scene, out: ms.bake_asset("a.stl", name=5), "name must be text that is not empty (got int 5)"),
    (lambda scene, out: ms.bake_asset("a.stl", name="a", settings={}), "settings must be a BakeSettings (got dict {})"),
    (lambda scene, out: ms.bake_asset("a.stl", name="a", density="x"), "density must be a number (got str 'x')"),
    (lambda scene, out: ms.bake_asset("a.stl", name="a", cameras=[1]), "cameras[0] must be a Camera (got int 1)"),
    (lambda scene, out: ms.bake_asset("a.stl", name="a", lights="area"), "lights must be a list of DrawnLight objects"),
    (lambda scene, out: ms.BakeSettings(gaussians=1.5), "gaussians must be a whole number (got float 1.5)"),
    (lambda scene, out: ms.ImportSettings(up=5), "up must be x, -x, y, -y, z, -z or None (got int 5)"),
    (lambda scene, out: ms.ImportSettings(crop=(0, 1)), "crop must be a list of 6 or None (got tuple (0, 1))"),
    (lambda scene, out: ms.CaptureSettings(kind="thing"), "kind must be object or environment (got str 'thing')"),
    (lambda scene, out: ms.CaptureSettings(poses=5), "poses must be a path or None (got int 5)"),
    (lambda scene, out: ms.FitSettings(iterations="9"), "iterations must be a whole number (got str '9')"),
    (lambda scene, out: ms.AssetJob(name=5), "name must be text that is not empty (got int 5)"),
    (lambda scene, out: ms.AssetJob(name="a", kind="x"), "kind must be object or environment (got str 'x')"),
    (lambda scene, out: ms.asset_from_photos(out, out, "a"), "job must be a AssetJob (got str 'a')"),
    (lambda scene, out: ms.capture_photos(out, out, {}), "settings must be a CaptureSettings (got dict {})"),
    (lambda scene, out: ms.import_splats("a.ply", name="a", settings={}), "settings must be a ImportSettings"),
    (lambda scene, out: ms.import_splats("a.ply", name="a", mass="x"), "mass must be a number (got str 'x')"),
    (lambda scene, out: ms.fit_capture(None, out), "capture must be a Capture (got NoneType None)"),
    (lambda scene, out: ms.audit_dataset(None), "root must be a path (got NoneType None)"),
    (lambda scene, out: ms.write_report(None), "root must be a path (got NoneType None)"),
    (lambda scene, out: ms.Splats("a", [[0, 0, 0, 1]], [[1, 1, 1]], [1], [[[0, 0, 0]]]), "means must be an array of"),
    (lambda scene, out: ms.Camera.look_at((0, 0, 1), (0, 0, 0), width=8, height=6, fov_x="50"), "fov_x must be a"),
    (lambda scene, out: ms.Camera.look_at(np.eye(3), (0, 0, 0), width=8, height=6, fov_x=50), "eye must be one point"),
    (lambda scene, out: CAMERA.project("nut"), "points must be an array of numbers (got str 'nut')"),
]


@pytest.mark.parametrize(("call", "sentence"), CALLS, ids=[sentence for _, sentence in CALLS])
def test_arguments_of_another_type_are_refused(
    scene: ms.Scene, tmp_path: Path, call: Callable[[ms.Scene, Path], object], sentence: str
) -> None:
    with pytest.raises(ms.InputError) as caught:
        call(scene, tmp_path / "out")
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


@pytest.mark.parametrize("change", [{"label": False}, {"class_name": "other"}, None])
def test_a_layout_of_another_scene_is_refused(
    scene: ms.Scene, scene_data: dict[str, Any], write_scene: WriteScene, change: dict[str, Any] | None
) -> None:
    """Without this check, its indices select assets of the scene: other objects are rendered under other classes."""
    layout = ms.Layout.from_poses(scene, {"nut": [POSE] * 3, "bolt": [POSE]})
    entries = scene_data["objects"]
    entries[1] |= change or {}
    other = ms.load_scene(write_scene(scene_data | {"objects": entries if change else entries[:1]}))
    with pytest.raises(
        ms.InputError, match=r"^layout must be of a scene with the same objects \(got an object of asset"
    ):
        ms.render_frame(other, 0, layout=layout)


def test_a_stream_of_a_scene_file_is_refused() -> None:
    pytest.importorskip("torch")
    from mitsplat.frames.torch_dataset import FrameStream

    with pytest.raises(ms.InputError, match=r"^scene must be a Scene \(got str 'scene.yaml'\): read a file with"):
        FrameStream("scene.yaml")  # type: ignore[arg-type]


def test_absent_objects_count_as_given_poses(scene: ms.Scene) -> None:
    layout = ms.Layout.from_poses(scene, {"nut": [POSE, None, POSE]})
    assert [one.id for one in layout.instances] == [1, 3]


def test_paths_may_be_text_and_numbers_may_be_scalars_of_numpy(scene: ms.Scene, tmp_path: Path) -> None:
    settings = ms.CaptureSettings(poses="model", max_size=np.int64(640))  # type: ignore[arg-type]
    assert settings.poses == Path("model")
    assert ms.FitSettings(iterations=np.int32(5), target_psnr=np.float32(20)).iterations == 5  # type: ignore[arg-type]
    assert ms.load_scene(scene.path, overrides={"name": Path("x"), "seed": np.int64(3)}).spec.seed == 3


def test_the_upper_direction_of_a_camera_must_not_be_zero() -> None:
    for up in ((0, 0, 0), (0, 0, np.nan)):
        with pytest.raises(ValueError, match="up must be finite and not zero"):
            ms.Camera.look_at((0, 0, 1), (0, 0, 0), up=up, width=8, height=6, fov_x=50)
