"""Frames of scenes in USD and MJCF: contents, cameras, and rest in Newton and MuJoCo."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import newton
import numpy as np
import pytest
from newton.solvers import SolverMuJoCo
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.geometry.camera import Camera
from mitsplat.physics.bodies import make_body
from mitsplat.physics.settle import settle_layout, warp_settings
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.scene.scene import Scene
from mitsplat.usd.mjcf import export_scene_mjcf
from mitsplat.usd.simulator_poses import layout_from_newton
from mitsplat.usd.usd_export import export_scene_usd
from tests.cli.typed import run
from tests.conftest import box_asset
from tests.usd.test_usd_assets import faults

pxr = pytest.importorskip("pxr", reason="needs OpenUSD: pip install 'mitsplat[usd]'")
from pxr import Usd, UsdGeom, UsdLux, UsdPhysics, UsdRender  # noqa: E402

MOVED, TURNED = 1e-3, 1.0
"""Permitted motion of an object at rest in 2 s [m, degrees]."""
INDEX = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a scene of boxes on a table in a bin, exported as USD and MJCF."""
    folder = tmp_path_factory.mktemp("frame")
    for asset in (box_asset("nut"), box_asset("bolt", (0.01, 0.01, 0.05))):
        asset.save(folder / "assets" / asset.name)
    table = {"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}, "colour": [0.5, 0.2, 0.8]}
    data: dict[str, Any] = {
        "name": "small",
        "shapes": [table | {"visible": True, "friction": 0.4}, {"name": "bin", "bin": {"size": [0.3, 0.3, 0.05]}}],
        "objects": [{"asset": "assets/nut", "count": 2, "label": False}, {"asset": "assets/bolt"}],
        "region": {"min": [-0.1, -0.1, 0.02], "max": [0.1, 0.1, 0.1]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
        "lights": [
            {"kind": "area", "position": [0.5, 0, 1], "radiance": 3, "size": [0.2, 0.4], "temperature": 4000},
            {"kind": "point", "position": [0, 0.1, 1], "intensity": 2},
            {"kind": "spot", "position": [0, 0.5, 1], "cone": 25, "intensity": 2},
            {"kind": "environment", "radiance": 0.5},
        ],
        "output": {"width": 64, "height": 48, "layouts": 3, "views": 4},
        "seed": 7,
    }
    data["camera"]["intrinsics"] = {"fx": 70.0, "fy": 80.0, "cx": 20.0, "cy": 31.0}
    YAML(typ="safe", pure=True).dump(data, folder / "scene.yaml")
    assert run("export", folder / "scene.yaml", "--frame", INDEX, "-o", folder / "frame.usda") == 0
    assert run("export", folder / "scene.yaml", "--frame", INDEX, "-o", folder / "frame.xml", "--mjcf") == 0
    return folder


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return load_scene(folder / "scene.yaml")


@pytest.fixture(scope="module")
def stage(folder: Path) -> Iterator[Usd.Stage]:
    yield Usd.Stage.Open(str(folder / "frame.usda"))


def poses_at_rest(scene: Scene) -> list[Float64Array]:
    return [one.world_from_object for one in settle_layout(scene, 1).instances]


def test_the_stage_passes_the_validators_of_openusd(stage: Usd.Stage) -> None:
    assert faults(stage) == []


def test_objects_of_the_stage_lie_at_rest_with_their_classes(stage: Usd.Stage, scene: Scene) -> None:
    objects = stage.GetPrimAtPath("/World/objects").GetChildren()
    assert [prim.GetName() for prim in objects] == ["nut_1", "nut_2", "bolt_3"]
    for prim, pose in zip(objects, poses_at_rest(scene), strict=True):
        matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0)).T
        np.testing.assert_allclose(matrix, pose, atol=1e-6)
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI) and prim.GetChild("splats") and prim.GetChild("colliders")
    assert list(objects[2].GetAttribute("semantics:labels:class").Get()) == ["bolt"]
    assert [bool(prim.GetAttribute("mitsplat:unlabelled").Get()) for prim in objects] == [True, True, False]


def project(camera: UsdGeom.Camera, point: Float64Array, size: tuple[int, int]) -> Float64Array:
    """Project a point with the frustum of USD's camera; pixels count from the top left."""
    frustum = camera.GetCamera(0.0).frustum
    x, y, _ = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(point.tolist())
    return np.array([0.5 * (1 + x) * size[0], 0.5 * (1 - y) * size[1]])


def test_points_have_the_same_pixels_in_the_camera_of_the_stage(stage: Usd.Stage, scene: Scene) -> None:
    camera = plan_frame(scene, INDEX, settle_layout(scene, 1)).camera
    resolution = UsdRender.Settings.GetStageRenderSettings(stage).GetResolutionAttr().Get()
    assert tuple(resolution) == (64, 48)
    found = UsdGeom.Camera.Get(stage, "/World/camera")
    for point in np.random.default_rng(1).uniform(-0.1, 0.1, (5, 3)):
        np.testing.assert_allclose(project(found, point, (64, 48)), pixel_of(camera, point), atol=1e-3)


def pixel_of(camera: Camera, point: Float64Array) -> Float64Array:
    x, y, z = (np.linalg.inv(camera.world_from_camera) @ [*point, 1.0])[:3]
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def test_lights_of_the_stage_have_the_radiometry_of_usdlux(stage: Usd.Stage) -> None:
    area, point, spot, dome = (stage.GetPrimAtPath(f"/World/light_{number}") for number in range(4))
    rect = UsdLux.RectLight(area)
    assert (rect.GetIntensityAttr().Get(), rect.GetHeightAttr().Get()) == pytest.approx((3, 0.4))
    forward = np.array(UsdGeom.Xformable(area).ComputeLocalToWorldTransform(0.0))[2, :3]
    np.testing.assert_allclose(-forward, np.array([-0.5, 0, -1]) / np.sqrt(1.25), atol=1e-6)  # emits along -z
    # Radiant intensity of a sphere of radius r: pi r^2 times its radiance, the intensity over the area 4 pi r^2.
    assert UsdLux.SphereLight(point).GetIntensityAttr().Get() / 4 == pytest.approx(2)
    assert UsdLux.SphereLight(point).GetNormalizeAttr().Get() and UsdLux.SphereLight(point).GetTreatAsPointAttr().Get()
    assert UsdLux.ShapingAPI(spot).GetShapingConeAngleAttr().Get() == 25
    assert UsdLux.DomeLight(dome).GetIntensityAttr().Get() == 0.5


def assert_still(first: Float64Array, last: Float64Array) -> None:
    """Check that positions (N, 3) and xyzw quaternions (N, 4) in the columns of poses (N, 7) have hardly changed."""
    assert np.linalg.norm(first[:, :3] - last[:, :3], axis=1).max() < MOVED
    turns = Rotation.from_quat(first[:, 3:]).inv() * Rotation.from_quat(last[:, 3:])
    assert np.degrees(turns.magnitude()).max() < TURNED


def test_objects_stay_at_rest_in_mujoco(folder: Path, scene: Scene) -> None:
    model = mujoco.MjModel.from_xml_path(str(folder / "frame.xml"))
    data = mujoco.MjData(model)
    first = data.qpos.reshape(-1, 7)[:, [0, 1, 2, 4, 5, 6, 3]].copy()
    for pose, row in zip(poses_at_rest(scene), first, strict=True):
        np.testing.assert_allclose(pose[:3, 3], row[:3], atol=1e-9)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert data.time == pytest.approx(2.0)
    assert_still(first, data.qpos.reshape(-1, 7)[:, [0, 1, 2, 4, 5, 6, 3]])


def test_the_model_has_masses_inertias_and_friction(folder: Path, scene: Scene) -> None:
    model = mujoco.MjModel.from_xml_path(str(folder / "frame.xml"))
    with warp_settings():
        expected = make_body(scene.assets[1], lambda text: None).mass
    body = model.body("bolt_3").id
    assert model.body_mass[body] == pytest.approx(expected.mass, rel=1e-6)
    np.testing.assert_allclose(np.sort(model.body_inertia[body]), np.sort(np.diag(expected.inertia)), rtol=1e-5)
    geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == body and model.geom_contype[geom]]
    assert len(geoms) == 1 and model.geom_friction[geoms[0], 0] == 0.5
    assert model.geom_friction[model.geom("table_0").id, 0] == 0.4
    assert model.nbody == 4
    assert [model.text_data[0:4], model.ntext] == [b"bolt", 1]


def test_the_frustum_of_mujoco_is_that_of_the_camera(folder: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(folder / "frame.xml"))
    data, drawn = mujoco.MjData(model), mujoco.MjvScene(model, 10)
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    mujoco.mjv_updateCamera(model, data, camera, drawn)
    view = drawn.camera[0]
    left, right = view.frustum_center - view.frustum_width, view.frustum_center + view.frustum_width
    borders = np.array([left, right, view.frustum_bottom, view.frustum_top]) / view.frustum_near
    np.testing.assert_allclose(borders, [-20 / 70, 44 / 70, -17 / 80, 31 / 80], rtol=1e-5)


def test_objects_stay_at_rest_in_newton(folder: Path, scene: Scene) -> None:
    pytest.importorskip("newton_usd_schemas", reason="Newton's importer of USD needs newton-usd-schemas")
    with warp_settings():
        builder = newton.ModelBuilder()
        SolverMuJoCo.register_custom_attributes(builder)
        builder.add_usd(str(folder / "frame.usda"))
        model = builder.finalize(device="cpu")
        options = {"integrator": "implicitfast", "cone": "elliptic", "impratio": 100.0, "enable_multiccd": True}
        solver = SolverMuJoCo(model, use_mujoco_cpu=True, **options)
        states, control = [model.state(), model.state()], model.control()
        first = states[0].body_q.numpy().astype(np.float64)
        for pose, row in zip(poses_at_rest(scene), first, strict=True):
            np.testing.assert_allclose(pose[:3, 3], row[:3], atol=1e-6)
        live = layout_from_newton(scene, model, states[0]).instances
        assert [(one.id, scene.assets[one.asset].name) for one in live] == [(1, "nut"), (2, "nut"), (3, "bolt")]
        np.testing.assert_allclose([one.world_from_object for one in live], poses_at_rest(scene), atol=1e-6)
        for _ in range(1000):
            solver.step(states[0], states[1], control, None, 0.002)
            states.reverse()
        assert_still(first, states[0].body_q.numpy().astype(np.float64))
    assert not (solver.mj_model.geom_margin.any() or solver.mj_model.geom_gap.any())  # would lift objects at rest
    frictions = set(np.round(np.array(builder.shape_material_mu)[np.array(builder.shape_flags) == 6], 6).tolist())
    assert frictions == {0.4, 0.5, 0.6}


def test_losses_of_a_frame_are_listed(folder: Path, tmp_path: Path) -> None:
    data = YAML(typ="safe", pure=True).load(folder / "scene.yaml")
    data["camera"]["intrinsics"] |= {"distortion": [-0.1, 0.02, 0, 0], "size": [64, 48]}
    data["shapes"][0]["materials"] = [{"kind": "wood"}]
    data["objects"][1]["appearance"] = {"hue": [-6, 6]}
    data["enclosure"] = {}
    path = folder / "losses.yaml"
    YAML(typ="safe", pure=True).dump(data, path)
    losses = export_scene_usd(load_scene(path), 0, tmp_path / "a.usda")
    assert [loss.partition(";")[0] for loss in losses] == [
        "the lens distortion of the camera",
        "the invisible walls of enclosures",
        "the drawn appearance of objects (hue, wear)",
        "patterns of shapes",
    ]
    more = export_scene_mjcf(load_scene(path), 0, tmp_path / "a.xml")
    assert set(losses) < set(more) and any(loss.startswith("splats") for loss in more)
