"""Labelled images of OpenUSD stages."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.physics.settle import settle_layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.usd.stage_scene import read_stage_scene
from tests.cli.typed import run
from tests.usd.test_simulated_frames import INDEX, folder  # noqa: F401 - a fixture
from tests.usd.test_usd_assets import new_stage

pxr = pytest.importorskip("pxr", reason="needs OpenUSD: pip install 'mitsplat[usd]'")
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdRender, UsdSemantics, UsdVol, Vt  # noqa: E402

RADIUS = 0.04


def write_balls(path: Path) -> list[tuple[float, float, float]]:
    """Write five balls of splats on a table, with usd-core alone; return their centres."""
    stage, rng = new_stage(path), np.random.default_rng(0)
    table = UsdGeom.Mesh.Define(stage, "/World/table")
    table.CreatePointsAttr([(-0.4, -0.4, 0), (0.4, -0.4, 0), (0.4, 0.4, 0), (-0.4, 0.4, 0)])
    table.CreateFaceVertexCountsAttr([4])
    table.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    table.CreateDisplayColorAttr([(0.3, 0.2, 0.1)])
    centres = [(0.15 * np.cos(turn), 0.15 * np.sin(turn), RADIUS) for turn in np.arange(5) * 0.4 * np.pi]
    for number, centre in enumerate(centres):
        points = rng.normal(size=(400, 3))
        points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
        field = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/World/ball_{number}")
        field.CreatePositionsAttr(Vt.Vec3fArray(points.tolist()))
        field.CreateScalesAttr([(0.004, 0.004, 0.004)] * 400)
        field.CreateOpacitiesAttr([0.95] * 400)
        field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
        field.CreateRadianceSphericalHarmonicsCoefficientsAttr([tuple(rng.normal(0, 1, 3).tolist())] * 400)
        UsdGeom.Xformable(field).AddTranslateOp().Set(centre)
        labels = UsdSemantics.LabelsAPI.Apply(field.GetPrim(), "class")
        labels.CreateLabelsAttr(["even" if number % 2 == 0 else "odd"])
    camera = UsdGeom.Camera.Define(stage, "/World/camera")
    view = Gf.Matrix4d().SetLookAt(Gf.Vec3d(0, 0, 0.8), Gf.Vec3d(0, 0, 0), Gf.Vec3d(0, 1, 0))
    camera.AddTransformOp().Set(view.GetInverse())
    camera.CreateFocalLengthAttr(24.0)
    camera.CreateHorizontalApertureAttr(24.0)
    camera.CreateVerticalApertureAttr(18.0)
    light = UsdLux.RectLight.Define(stage, "/World/light")
    light.CreateIntensityAttr(20.0)
    light.AddTranslateOp().Set((0, 0, 1.5))
    UsdLux.DomeLight.Define(stage, "/World/dome").CreateIntensityAttr(0.3)
    UsdLux.CylinderLight.Define(stage, "/World/tube")
    UsdPhysics.RigidBodyAPI.Apply(UsdGeom.Cube.Define(stage, "/World/body").GetPrim())
    settings = UsdRender.Settings.Define(stage, "/Render/settings")
    settings.CreateResolutionAttr(Gf.Vec2i(120, 90))
    stage.SetMetadata("renderSettingsPrimPath", "/Render/settings")
    stage.Save()
    return centres


def test_a_stage_of_usd_core_renders_with_labels_that_pass_the_audit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    centres = write_balls(tmp_path / "balls.usda")
    assert run("render", tmp_path / "balls.usda", "-o", tmp_path / "out", "--format", "yolo,bop") == 0
    printed = capsys.readouterr().out
    assert "not imported: the light /World/tube of type CylinderLight" in printed
    assert "not rendered: meshes of rigid bodies; only their splats are: /World/body" in printed
    assert printed.count("has no colliders; the convex hull of its splats casts its shadows") == 5
    assert run("audit", tmp_path / "out") == 0
    (line,) = (tmp_path / "out/manifest.jsonl").read_text().splitlines()
    instances = json.loads(line)["labels"]["instances"]
    assert sorted(one["class"] for one in instances) == ["even"] * 3 + ["odd"] * 2
    # A ball at (x, y) below a camera that looks down, with y up in the image and a focal length of 120 px.
    depth = 0.8 - RADIUS
    expected = sorted((60 + 120 * x / depth, 45 - 120 * y / depth) for x, y, _ in centres)
    boxes = np.array([one["box"] for one in instances])
    middles = sorted(map(tuple, (0.5 * (boxes[:, :2] + boxes[:, 2:])).tolist()))
    np.testing.assert_allclose(middles, expected, atol=1.5)


def test_an_exported_frame_is_read_as_the_same_scene(folder: Path, tmp_path: Path) -> None:  # noqa: F811
    scene = load_scene(folder / "scene.yaml")
    layout = settle_layout(scene, 1)
    plan = plan_frame(scene, INDEX, layout)
    found = read_stage_scene(folder / "frame.usda", tmp_path)
    assert found.scene.class_names == ("bolt",)
    poses = [pose for number in sorted(found.poses, key=int) for pose in found.poses[number]]
    for pose, one in zip(poses, layout.instances, strict=True):
        np.testing.assert_allclose(pose, one.world_from_object, atol=1e-6)
    (camera,) = found.cameras
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(camera, name) == pytest.approx(getattr(plan.camera, name), rel=1e-5)
    np.testing.assert_allclose(camera.world_from_camera, plan.camera.world_from_camera, atol=1e-6)
    for light, before in zip(found.scene.spec.lights, plan.lights, strict=True):
        assert light.kind == before.kind
        strength = "intensity" if light.kind in ("point", "spot") else "radiance"
        scale = max(before.colour) / max(light.colour)
        if before.kind != "area":  # its colour temperature is part of its colour
            assert getattr(light, strength) == pytest.approx(getattr(before, strength) * scale, rel=1e-5)
    assert [shape.name for shape in found.scene.spec.shapes] == ["/World/shapes/table_0/mesh"]


def test_a_sheared_camera_is_refused_in_one_sentence(tmp_path: Path) -> None:
    write_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/camera")).AddScaleOp().Set((1, 2, 1))
    stage.Save()
    with pytest.raises(InputError, match=r"balls\.usda: /World/camera: a transform must scale uniformly"):
        read_stage_scene(tmp_path / "balls.usda", tmp_path / "scene")


def test_a_stage_without_classes_or_cameras_is_refused(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "bare.usda")
    stage.Save()
    with pytest.raises(InputError, match=r"bare\.usda: must have a camera"):
        read_stage_scene(tmp_path / "bare.usda", tmp_path / "scene")
    UsdGeom.Camera.Define(stage, "/camera")
    stage.Save()
    with pytest.raises(InputError, match=r"bare\.usda: must have particle fields with a semantic class"):
        read_stage_scene(tmp_path / "bare.usda", tmp_path / "scene")
