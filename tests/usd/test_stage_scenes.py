"""Labelled images of OpenUSD stages."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsplat.capture.lighting.panorama import write_radiance
from mitsplat.errors import InputError
from mitsplat.geometry.rigid import Z_UP_FROM_Y_UP
from mitsplat.physics.settle import settle_layout
from mitsplat.renderer.scene_emitters import emitter_dict
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from mitsplat.usd.stage_meshes import triangles_of
from mitsplat.usd.stage_scene import read_stage_scene
from tests.cli.typed import run
from tests.manifests import records_of
from tests.usd.test_simulated_frames import INDEX, folder  # noqa: F401 - a fixture
from tests.usd.test_usd_assets import new_stage

pxr = pytest.importorskip("pxr", reason="needs OpenUSD: pip install 'mitsplat[usd]'")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdRender, UsdSemantics, UsdShade, UsdVol, Vt  # noqa: E402

RADIUS = 0.04


def add_ball(stage: Usd.Stage, path: str, label: str, rng: np.random.Generator) -> UsdVol.ParticleField3DGaussianSplat:
    """Add a ball of splats with a class."""
    points = rng.normal(size=(400, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    field.CreatePositionsAttr(Vt.Vec3fArray(points.tolist()))
    field.CreateScalesAttr([(0.004, 0.004, 0.004)] * 400)
    field.CreateOpacitiesAttr([0.95] * 400)
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr([tuple(rng.normal(0, 1, 3).tolist())] * 400)
    UsdSemantics.LabelsAPI.Apply(field.GetPrim(), "class").CreateLabelsAttr([label])
    return field


def add_camera(stage: Usd.Stage) -> UsdGeom.Camera:
    """Add a camera whose focal length is the width of its image."""
    camera = UsdGeom.Camera.Define(stage, "/World/camera")
    camera.CreateFocalLengthAttr(24.0)
    camera.CreateHorizontalApertureAttr(24.0)
    camera.CreateVerticalApertureAttr(18.0)
    return camera


def looking_down(x: float) -> Gf.Matrix4d:
    """Return the pose of a camera that looks down from (x, 0, 0.8), with y up in the image."""
    return Gf.Matrix4d().SetLookAt(Gf.Vec3d(x, 0, 0.8), Gf.Vec3d(x, 0, 0), Gf.Vec3d(0, 1, 0)).GetInverse()


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
        field = add_ball(stage, f"/World/ball_{number}", "even" if number % 2 == 0 else "odd", rng)
        UsdGeom.Xformable(field).AddTranslateOp().Set(centre)
    camera = add_camera(stage)
    camera.AddTransformOp().Set(looking_down(0.0))
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
    assert "not imported: 1 meshes of rigid bodies, of which only splats are rendered (/World/body)" in printed
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


def write_moving_balls(path: Path) -> None:
    """Write two balls, of which one moves under a moving camera, and time samples that are not read."""
    stage, rng = new_stage(path), np.random.default_rng(0)
    for name in ("still", "moving"):
        UsdPhysics.RigidBodyAPI.Apply(UsdGeom.Xform.Define(stage, f"/World/{name}").GetPrim())
        add_ball(stage, f"/World/{name}/splats", name, rng)
    UsdGeom.Xformable(stage.GetPrimAtPath("/World/still")).AddTranslateOp().Set((0.0, 0.15, RADIUS))
    moving = UsdGeom.Xformable(stage.GetPrimAtPath("/World/moving"))
    place, turn, size = moving.AddTranslateOp(), moving.AddRotateZOp(), moving.AddScaleOp()
    camera = add_camera(stage)
    view = camera.AddTransformOp()
    light = UsdLux.RectLight.Define(stage, "/World/light")
    height = light.AddTranslateOp()
    for time, x in ((2.0, -0.1), (6.0, 0.1)):
        place.Set((x, 0.0, RADIUS), time)
        turn.Set(450 * x, time)
        size.Set((1 + 0.01 * time,) * 3, time)
        view.Set(looking_down(x / 2), time)
        light.CreateIntensityAttr().Set(time, time)
        height.Set((0, 0, time), time)
        light.CreateVisibilityAttr().Set("inherited", time)
    stage.SetStartTimeCode(2)
    stage.SetEndTimeCode(6)
    stage.SetTimeCodesPerSecond(48)
    stage.SetFramesPerSecond(24)
    stage.Save()


def test_time_samples_of_poses_become_a_sequence_with_stable_ids(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_moving_balls(tmp_path / "balls.usda")
    assert (
        run("render", tmp_path / "balls.usda", "-o", tmp_path / "out", "--size", "80x60", "--format", "bop,exr,flow")
        == 0
    )
    printed = capsys.readouterr().out
    assert "not imported: 1 sets of time samples of inputs:intensity (/World/light)" in printed
    assert "not imported: the motion of /World/light; it stays as at the first time code" in printed
    assert "not imported: the change of the scale of /World/moving" in printed
    assert "(3 images of 3 time codes)" in printed
    assert run("audit", tmp_path / "out") == 0
    records = records_of(tmp_path / "out")
    # The ball moves by 0.1 m and the camera by 0.05 m: 80 px 0.05 / depth, in the mean around the axis of its turn,
    # which is at (34.7, 30).
    (file,) = (name for name in records[0]["files"] if name.startswith("flow/"))
    flow = cv2.readOpticalFlow(str(tmp_path / "out" / file))
    np.testing.assert_allclose(flow[29:31, 34:36].mean(axis=(0, 1)), (80 * 0.05 / 0.72, 0.0), atol=0.4)
    assert [any(name.startswith("flow/") for name in record["files"]) for record in records] == [True, True, False]
    # Time codes 2, 4 and 6; a focal length of 80 px, and centres of balls 0.76 m below the camera.
    for record, x in zip(records, (-0.1, 0.0, 0.1), strict=True):
        found = {one["class"]: one for one in record["labels"]["instances"]}
        assert {name: one["id"] for name, one in found.items()} == {"still": 1, "moving": 2}
        for name, place in (("still", (0.0, 0.15)), ("moving", (x, 0.0))):
            box = np.array(found[name]["box"])
            expected = 40 + 80 * (place[0] - x / 2) / 0.76, 30 - 80 * place[1] / 0.76
            np.testing.assert_allclose(0.5 * (box[:2] + box[2:]), expected, atol=1.0)
        pose = np.array(found["moving"]["world_from_object"])
        turned = np.radians(450 * x)
        np.testing.assert_allclose(pose[:3, 3], (x, 0, RADIUS), atol=1e-6)
        np.testing.assert_allclose(pose[:2, 0], (np.cos(turned), np.sin(turned)), atol=1e-6)


def test_an_object_leaves_the_images_in_which_the_stage_hides_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_moving_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    for path, states in (
        ("/World/still", ("invisible", "inherited", "inherited")),
        ("/World/moving/splats", ("inherited", "invisible", "inherited")),
        ("/World/light", ("inherited", "invisible", "invisible")),
    ):
        attribute = UsdGeom.Imageable(stage.GetPrimAtPath(path)).CreateVisibilityAttr()
        for time, state in zip((2.0, 4.0, 6.0), states, strict=True):
            attribute.Set(state, time)
    UsdGeom.Imageable(stage.GetPrimAtPath("/World/camera")).MakeInvisible()  # it takes pictures all the same
    stage.Save()
    command = "render", tmp_path / "balls.usda", "-o", tmp_path / "out", "--size", "80x60", "--format", "bop,flow"
    assert run(*command) == 0
    assert (
        "not imported: 1 changes of the visibility of prims that are no objects (/World/light)"
        in capsys.readouterr().out
    )
    assert run("audit", tmp_path / "out") == 0
    records = records_of(tmp_path / "out")
    found = [{one["class"]: one["id"] for one in record["labels"]["instances"]} for record in records]
    assert found == [{"moving": 2}, {"still": 1}, {"still": 1, "moving": 2}]


def test_a_stage_in_which_only_the_visibility_changes_is_a_sequence(tmp_path: Path) -> None:
    write_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    attribute = UsdGeom.Imageable(stage.GetPrimAtPath("/World/ball_1")).CreateVisibilityAttr()
    attribute.Set("inherited", 1.0)
    attribute.Set("invisible", 2.0)
    stage.Save()
    found = read_stage_scene(tmp_path / "balls.usda", tmp_path / "scene")
    absent = [[pose is None for asset in sorted(poses) for pose in poses[asset]] for poses in found.poses]
    assert absent == [[False] * 5, [False, True, False, False, False]]


def test_invisible_colliders_collide_and_other_invisible_prims_are_named(tmp_path: Path) -> None:
    stage, rng = new_stage(tmp_path / "ball.usda"), np.random.default_rng(0)
    UsdPhysics.RigidBodyAPI.Apply(UsdGeom.Xform.Define(stage, "/World/ball").GetPrim())
    add_ball(stage, "/World/ball/splats", "ball", rng)
    collider = UsdGeom.Sphere.Define(stage, "/World/ball/collider")
    collider.CreateRadiusAttr(RADIUS)
    UsdPhysics.CollisionAPI.Apply(collider.GetPrim())
    add_camera(stage).AddTransformOp().Set(looking_down(0.0))
    dome, cover = UsdLux.DomeLight.Define(stage, "/World/dome"), UsdGeom.Cube.Define(stage, "/World/cover")
    for prim in (collider, dome, cover):
        prim.MakeInvisible()
    stage.Save()
    found = read_stage_scene(tmp_path / "ball.usda", tmp_path / "scene")
    (asset,) = found.scene.assets
    assert asset.mesh is not None
    assert asset.mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    assert not any("convex hull" in note for note in found.notes)
    assert "not imported: 2 invisible prims (/World/dome, ...)" in found.notes
    assert not found.scene.spec.shapes


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        ("", (90.0, 90.0)),  # expandAperture: the height of 18 fills 90 px, f = 18
        ("cropAperture", (120.0, 120.0)),  # the width of 18 fills 120 px
        ("adjustApertureWidth", (90.0, 90.0)),
        ("adjustApertureHeight", (120.0, 120.0)),
        ("adjustPixelAspectRatio", (120.0, 90.0)),
    ],
)
def test_a_render_product_states_size_and_fit_of_the_image_of_its_camera(
    tmp_path: Path, policy: str, expected: tuple[float, float]
) -> None:
    write_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    camera = UsdGeom.Camera.Get(stage, "/World/camera")
    for attribute in (camera.GetFocalLengthAttr(), camera.GetHorizontalApertureAttr()):
        attribute.Set(18.0)
    stage.GetPrimAtPath("/Render/settings").GetAttribute("resolution").Set(Gf.Vec2i(64, 64))
    product = UsdRender.Product.Define(stage, "/Render/product")
    product.CreateCameraRel().SetTargets(["/World/camera"])
    product.CreateResolutionAttr(Gf.Vec2i(120, 90))
    product.CreateDataWindowNDCAttr((0, 0, 1, 0.5))
    if policy:
        product.CreateAspectRatioConformPolicyAttr(policy)
    UsdRender.Settings.Define(stage, "/Render/other").CreateResolutionAttr(Gf.Vec2i(8, 8))
    stage.Save()
    found = read_stage_scene(tmp_path / "balls.usda", tmp_path / "scene")
    ((camera_found,),) = found.cameras
    assert (camera_found.width, camera_found.height) == (120, 90)
    assert (camera_found.fx, camera_found.fy) == pytest.approx(expected)
    for note in (
        "not imported: 1 values of dataWindowNDC (/Render/product)",
        "not imported: 1 render settings that renderSettingsPrimPath does not name (/Render/other)",
        "the aperture of /World/camera has the aspect ratio 1.000 and its image 1.333: "
        f"fitted by the policy {policy or 'expandAperture'}",
    ):
        assert note in found.notes


def test_cameras_with_images_of_another_size_are_named(tmp_path: Path) -> None:
    write_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    for name in ("camera_2", "camera_3"):
        UsdGeom.Camera.Define(stage, f"/World/{name}")
        product = UsdRender.Product.Define(stage, f"/Render/{name}")
        product.CreateCameraRel().SetTargets([f"/World/{name}"])
        product.CreateResolutionAttr(Gf.Vec2i(64, 64))
    stage.Save()
    found = read_stage_scene(tmp_path / "balls.usda", tmp_path / "scene")
    assert len(found.cameras) == 1
    note = "cameras whose images have another size than those of the first one (/World/camera_2, ...)"
    assert f"not imported: 2 {note}" in found.notes


def test_prototypes_of_a_point_instancer_are_not_drawn_by_themselves(tmp_path: Path) -> None:
    write_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/trees")
    UsdGeom.Cube.Define(stage, "/World/trees/prototypes/tree")
    add_ball(stage, "/World/trees/prototypes/ball", "tree", np.random.default_rng(1))
    instancer.CreatePrototypesRel().SetTargets(["/World/trees/prototypes/tree", "/World/trees/prototypes/ball"])
    stage.Save()
    found = read_stage_scene(tmp_path / "balls.usda", tmp_path / "scene")
    assert "not imported: 1 prims of type PointInstancer (/World/trees)" in found.notes
    assert found.scene.class_names == ("even", "odd")
    assert [shape.name for shape in found.scene.spec.shapes] == ["/World/table"]


def test_the_hull_of_a_single_gaussian_is_that_of_its_axes(tmp_path: Path) -> None:
    write_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/World/blob")
    field.CreatePositionsAttr([(0.0, 0.0, 0.2)])
    field.CreateScalesAttr([(0.03, 0.02, 0.01)])
    field.CreateOrientationsAttr([Gf.Quatf(0.5**0.5, 0.5**0.5, 0, 0)])  # turns y to z
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    UsdSemantics.LabelsAPI.Apply(field.GetPrim(), "class").CreateLabelsAttr(["blob"])
    stage.Save()
    found = read_stage_scene(tmp_path / "balls.usda", tmp_path / "scene")
    (asset,) = (one for one in found.scene.assets if one.class_name == "blob")
    assert asset.mesh is not None
    np.testing.assert_allclose(asset.mesh.bounds, [(-0.03, -0.01, 0.18), (0.03, 0.01, 0.22)], atol=1e-6)


def test_values_of_lights_and_appearances_of_shapes_that_are_not_read_are_named(tmp_path: Path) -> None:
    write_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    before = read_stage_scene(tmp_path / "balls.usda", tmp_path / "before").notes
    light = UsdLux.LightAPI(stage.GetPrimAtPath("/World/light"))
    light.CreateDiffuseAttr(0.5)
    light.CreateSpecularAttr(1.0)  # the default
    UsdLux.RectLight(light.GetPrim()).CreateTextureFileAttr("./window.png")
    table = UsdGeom.Mesh.Get(stage, "/World/table")
    table.CreateDisplayColorAttr([(0.3, 0.2, 0.1), (0.1, 0.2, 0.3)])
    table.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.catmullClark)
    material = UsdShade.Material.Define(stage, "/World/wood")
    UsdShade.MaterialBindingAPI.Apply(table.GetPrim()).Bind(material)
    stage.Save()
    added = set(read_stage_scene(tmp_path / "balls.usda", tmp_path / "after").notes) - set(before)
    assert added == {
        "not imported: 1 values of inputs:diffuse (/World/light)",
        "not imported: 1 values of inputs:texture:file (/World/light)",
        "not imported: 1 colours after the first of a prim (/World/table)",
        "not imported: 1 subdivisions (/World/table)",
        "not imported: 1 materials of visible prims (/World/table)",
    }


def test_the_first_of_several_classes_counts_and_the_others_are_named(tmp_path: Path) -> None:
    write_balls(tmp_path / "balls.usda")
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    labels = UsdSemantics.LabelsAPI(stage.GetPrimAtPath("/World/ball_1"), "class").GetLabelsAttr()
    labels.Set(["odd", "ball"])
    old = stage.GetPrimAtPath("/World/ball_2")
    old.RemoveAPI(UsdSemantics.LabelsAPI, "class")
    for number, (kind, data) in enumerate((("shape", "round"), ("class", "even"), ("class", "thing"))):
        old.CreateAttribute(f"semantic:s{number}:params:semanticType", Sdf.ValueTypeNames.String).Set(kind)
        old.CreateAttribute(f"semantic:s{number}:params:semanticData", Sdf.ValueTypeNames.String).Set(data)
    stage.Save()
    found = read_stage_scene(tmp_path / "balls.usda", tmp_path / "scene")
    assert found.scene.class_names == ("even", "odd")
    assert "not imported: 1 sets of classes besides odd (/World/ball_1)" in found.notes
    assert "not imported: 1 sets of classes besides even (/World/ball_2)" in found.notes


def test_frames_limits_the_time_codes_of_a_stage(tmp_path: Path) -> None:
    write_moving_balls(tmp_path / "balls.usda")
    found = read_stage_scene(tmp_path / "balls.usda", tmp_path / "scene", images=2)
    assert (len(found.poses), len(found.cameras), len(found.cameras[0])) == (2, 1, 2)
    stage = Usd.Stage.Open(str(tmp_path / "balls.usda"))
    stage.SetEndTimeCode(1e6)  # nothing moves after the last sample, at 6
    stage.Save()
    assert len(read_stage_scene(tmp_path / "balls.usda", tmp_path / "longer").poses) == 3
    stage.SetFramesPerSecond(1e6)
    stage.Save()
    with pytest.raises(InputError, match=r"at most 10000 time codes \(got 83334\): limit them with --frames"):
        read_stage_scene(tmp_path / "balls.usda", tmp_path / "again")


@pytest.mark.parametrize(
    ("up", "pole", "suffix", "turns"),
    [
        ("Y", "", ".exr", (20.0, -50.0, 70.0)),
        ("Z", "", ".exr", (0.0, 0.0, 0.0)),
        ("Z", "", ".exr", (90.0, 0.0, 70.0)),
        ("Z", "scene", ".png", (0.0, 0.0, 70.0)),
        ("Y", "Z", ".png", (20.0, -50.0, 70.0)),
    ],
)
def test_an_image_of_the_sky_has_the_orientation_that_usdlux_defines(
    tmp_path: Path, up: str, pole: str, suffix: str, turns: tuple[float, float, float]
) -> None:
    ensure_variant()
    path = tmp_path / "balls.usda"
    write_balls(path)
    image = np.zeros((32, 64, 3), dtype=np.float32)
    image[:16, :32] = 1.0  # directions with y > 0 (the pole) and x > 0 (left of the middle, +z)
    if suffix == ".exr":
        write_radiance(tmp_path / "sky.exr", image)
    else:
        Image.fromarray((255 * image).astype(np.uint8)).save(tmp_path / "sky.png")
    stage = Usd.Stage.Open(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    stage.RemovePrim("/World/dome")
    dome = (UsdLux.DomeLight_1 if pole else UsdLux.DomeLight).Define(stage, "/World/dome")
    dome.CreateTextureFileAttr(f"./sky{suffix}")
    dome.CreateColorAttr((1.0, 0.5, 0.0))
    dome.CreateIntensityAttr(3.0)
    UsdGeom.Xformable(dome).AddRotateXYZOp().Set(turns)
    if pole:
        dome.CreatePoleAxisAttr(pole)
    stage.Save()
    found = read_stage_scene(path, tmp_path / "scene")
    assert not [note for note in found.notes if "image" in note]
    (light,) = (light for light in found.scene.spec.lights if light.kind == "environment")
    emitter = mi.load_dict(emitter_dict(light, tmp_path / "scene"))
    towards = np.random.default_rng(0).normal(size=(3, 2000))
    towards /= np.linalg.norm(towards, axis=0)
    ray = dr.zeros(mi.SurfaceInteraction3f, 2000)
    ray.wi = -mi.Vector3f(towards)
    radiance = np.array(emitter.eval(ray))
    world_from_stage = Z_UP_FROM_Y_UP[:3, :3] if up == "Y" else np.eye(3)
    rotation = world_from_stage @ Rotation.from_euler("xyz", turns, degrees=True).as_matrix()
    is_up = pole == "Z" or (pole == "scene" and up == "Z")
    x, y, _ = (rotation @ (Z_UP_FROM_Y_UP[:3, :3] if is_up else np.eye(3))).T @ towards
    clear = (np.abs(x) > 0.2) & (np.abs(y) > 0.2)  # farther than a pixel from a border
    expected = np.outer((3.0, 1.5, 0.0), (x > 0) & (y > 0))
    np.testing.assert_allclose(radiance[:, clear], expected[:, clear], atol=1e-3)


@pytest.mark.usefixtures("files_tried")
def test_images_of_the_sky_that_are_not_read_are_named(tmp_path: Path) -> None:
    write_balls(tmp_path / "in/balls.usda")
    (tmp_path / "sky.exr").write_bytes(b"outside")
    (tmp_path / "in/broken.exr").write_bytes(b"broken")
    stage = Usd.Stage.Open(str(tmp_path / "in/balls.usda"))
    dome = UsdLux.DomeLight.Get(stage, "/World/dome")
    for name, note in (
        ("../sky.exr", "not imported: 1 images that are missing or outside of the stage's folder (/World/dome)"),
        ("./none.exr", "not imported: 1 images that are missing or outside of the stage's folder (/World/dome)"),
    ):
        dome.CreateTextureFileAttr(name)
        stage.Save()
        notes = read_stage_scene(tmp_path / "in/balls.usda", tmp_path / "scene").notes
        assert note in notes
        assert f"not imported: the image {name} of /World/dome (format automatic); the light is uniform" in notes
    dome.CreateTextureFileAttr("./broken.exr")
    stage.Save()
    with pytest.raises(InputError, match=r"balls\.usda: the image \./broken\.exr of /World/dome: .* not a readable"):
        read_stage_scene(tmp_path / "in/balls.usda", tmp_path / "scene")


def test_the_triangles_of_a_concave_polygon_cover_it_once(tmp_path: Path) -> None:
    """The stage has an L, whose fan overlaps itself, and a square."""
    stage = new_stage(tmp_path / "shapes.usda")
    mesh = UsdGeom.Mesh.Define(stage, "/World/shapes")
    corners = [(2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (3, 0), (4, 0), (4, 1), (3, 1)]
    mesh.CreatePointsAttr([(x, y, 0) for x, y in corners])
    mesh.CreateFaceVertexCountsAttr([6, 4])
    mesh.CreateFaceVertexIndicesAttr(range(10))
    found = triangles_of(mesh.GetPrim(), Usd.TimeCode.Default())
    assert found is not None
    a, b, c = np.moveaxis(found[0][found[1]], 1, 0)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert areas.min() > 0 and areas.sum() == pytest.approx(3 + 1)


def test_an_exported_frame_is_read_as_the_same_scene(folder: Path, tmp_path: Path) -> None:  # noqa: F811
    scene = load_scene(folder / "scene.yaml")
    layout = settle_layout(scene, 1)
    plan = plan_frame(scene, INDEX, layout)
    found = read_stage_scene(folder / "frame.usda", tmp_path)
    assert found.scene.class_names == ("bolt",)
    (at_rest,) = found.poses
    poses = [pose for number in sorted(at_rest, key=int) for pose in at_rest[number]]
    for pose, one in zip(poses, layout.instances, strict=True):
        np.testing.assert_allclose(pose, one.world_from_object, atol=1e-6)
    ((camera,),) = found.cameras
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
