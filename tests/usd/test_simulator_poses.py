"""Layouts and cameras from MuJoCo and Newton: masks, depth, equal pictures, reused kernels, and errors."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr
import mujoco
import newton
import numpy as np
import pytest
import warp as wp

import mitsplat as ms
from mitsplat.arrays import Float64Array, Int64Array
from mitsplat.physics.settle import settle_layout, warp_settings
from mitsplat.usd.mjcf import export_scene_mjcf
from tests.conftest import box_asset

SIZE = (64, 48)
WRIST = '<camera name="wrist" pos="0.02 -0.01 0.3" euler="0.05 0.02 0.6" fovy="40"/>'


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> ms.Scene:
    """Return a scene of boxes on a table."""
    folder = tmp_path_factory.mktemp("live")
    for asset in (box_asset("nut", (0.04, 0.03, 0.02)), box_asset("bolt", (0.02, 0.02, 0.06))):
        asset.save(folder / "assets" / asset.name)
    table = {"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}, "visible": True}
    spec: dict[str, Any] = {
        "name": "live",
        "shapes": [table],
        "objects": [{"asset": "assets/nut", "count": 2}, {"asset": "assets/bolt"}],
        "region": {"min": [-0.06, -0.06, 0.02], "max": [0.06, 0.06, 0.1]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.3, "height": 0.25},
        "lights": [{"kind": "area", "position": [0.5, 0, 1], "radiance": 3, "size": [0.2, 0.4]}],
        "output": {"width": SIZE[0], "height": SIZE[1], "layouts": 1, "views": 4},
        "quality": "fast",
    }
    spec["camera"]["intrinsics"] = {"fx": 70.0, "fy": 80.0, "cx": 20.0, "cy": 31.0}
    return ms.make_scene(ms.SceneSpec(**spec), folder=folder)


@pytest.fixture(scope="module")
def model(scene: ms.Scene, tmp_path_factory: pytest.TempPathFactory) -> mujoco.MjModel:
    """Return the exported model, with a camera on a hand that moves."""
    path = tmp_path_factory.mktemp("model") / "cell.xml"
    export_scene_mjcf(scene, 0, path)
    hand = f'<body name="hand"><joint type="slide" axis="1 0 0"/><geom size="0.001" mass="1"/>{WRIST}</body>'
    path.write_text(path.read_text().replace("</worldbody>", f"{hand}</worldbody>"))
    return mujoco.MjModel.from_xml_path(str(path))


@pytest.fixture
def data(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def cast_rays(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> tuple[Float64Array, Int64Array]:
    """Return depth and index of the body (H, W) where rays of MuJoCo's frustum hit the visible meshes of objects."""
    view, drawn = mujoco.MjvCamera(), mujoco.MjvScene(model, 20)
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(name).id
    mujoco.mjv_updateCamera(model, data, view, drawn)
    seen = drawn.camera[0]
    left_right = seen.frustum_width or SIZE[0] / SIZE[1] * 0.5 * (seen.frustum_top - seen.frustum_bottom)
    columns, rows = (np.arange(length) + 0.5 for length in SIZE)
    x = seen.frustum_center + left_right * (2 * columns / SIZE[0] - 1)
    y = seen.frustum_top - (seen.frustum_top - seen.frustum_bottom) * rows / SIZE[1]
    slopes = np.stack([*np.meshgrid(x, y), np.full(SIZE[::-1], -seen.frustum_near)], axis=2) / seen.frustum_near
    rays = slopes.reshape(-1, 3) @ data.cam_xmat[view.fixedcamid].reshape(3, 3).T
    geoms, depths, visual = np.zeros(len(rays), np.int32), np.zeros(len(rays)), np.array([0, 0, 1, 0, 0, 0], np.uint8)
    origin = data.cam_xpos[view.fixedcamid]
    mujoco.mj_multiRay(model, data, origin, rays.ravel(), visual, True, -1, geoms, depths, None, len(rays), 10.0)
    bodies = np.where(geoms < 0, 0, model.geom_bodyid[geoms])
    return depths.reshape(SIZE[::-1]), bodies.reshape(SIZE[::-1])


def view(model: mujoco.MjModel, data: mujoco.MjData, name: str = "wrist") -> ms.Camera:
    return ms.camera_from_mujoco(model, data, name, width=SIZE[0], height=SIZE[1])


@pytest.mark.parametrize("name", ["camera", "wrist"])
def test_masks_and_depth_agree_with_rays_that_mujoco_casts(
    scene: ms.Scene, model: mujoco.MjModel, data: mujoco.MjData, name: str
) -> None:
    """One camera has a principal point and two focal lengths; the other one has an angle, and moves."""
    data.qpos[-1] = 0.03  # the hand
    mujoco.mj_step(model, data, 20)
    mujoco.mj_forward(model, data)
    frame = ms.render_frame(scene, 0, layout=ms.layout_from_mujoco(scene, model, data), camera=view(model, data, name))
    depths, bodies = cast_rays(model, data, name)
    ids = [0, *(int(model.body(body).name[-1]) for body in (1, 2, 3)), 0]
    np.testing.assert_array_equal(frame.layers.proxy_instance, np.take(ids, bodies))
    hit = bodies > 0
    assert hit.sum() > 100
    np.testing.assert_allclose(frame.layers.proxy_depth[hit], depths[hit], atol=1e-6)
    assert (frame.instance != frame.layers.proxy_instance).mean() < 0.03  # the splats end at the mesh
    for label in frame.labels.instances:
        body = ids.index(label.id)
        np.testing.assert_allclose(label.world_from_object[:3, :3], data.xmat[body].reshape(3, 3), atol=1e-12)
        np.testing.assert_allclose(label.world_from_object[:3, 3], data.xpos[body], atol=1e-12)


def test_the_exported_frame_gives_the_same_picture_as_the_scene(
    scene: ms.Scene, model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    settled = settle_layout(scene, 0)
    layout = ms.layout_from_mujoco(scene, model, data)
    camera = view(model, data, "camera")
    live, usual = (ms.render_frame(scene, 0, layout=one, camera=camera) for one in (layout, settled))
    assert [(one.id, one.asset) for one in layout.instances] == [(one.id, one.asset) for one in settled.instances]
    assert live.image.tobytes() == usual.image.tobytes() and live.instance.tobytes() == usual.instance.tobytes()


def test_steps_of_a_simulation_compile_no_kernels(scene: ms.Scene, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """The first three frames compile: kernels depend on the emitters and shapes that exist, and at first their number
    changes, because those of the previous frame are freed during the next one.
    """
    gc.collect()  # those of earlier tests
    with ms.Renderer(scene) as renderer, dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for step in range(6):
            dr.kernel_history_clear()
            layout = ms.layout_from_mujoco(scene, model, data)
            frame = renderer.render(0, layout=layout, camera=view(model, data))
            run = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
            new = sum(not entry["cache_hit"] or entry["cache_disk"] for entry in run)
            assert len(frame.labels.instances) == 3 and len(run) > 20
            assert step < 3 or new == 0, f"step {step}: {new} of {len(run)} kernels"
            data.qpos[[0, 7, 14, -1]] += 0.004
            mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)


def test_poses_of_newton_give_the_layout_of_mujoco(scene: ms.Scene, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    expected = ms.layout_from_mujoco(scene, model, data)
    with warp_settings():
        builder = newton.ModelBuilder()
        for body in (1, 2, 3):
            pose = wp.transform(data.xpos[body], np.roll(data.xquat[body], -1))
            builder.add_body(xform=pose, label=f"/World/objects/{model.body(body).name}")
        simulated = builder.finalize(device="cpu")
        layout = ms.layout_from_newton(scene, simulated, simulated.state())
        chosen = ms.layout_from_newton(scene, simulated, simulated.state(), {2: 1, "nut_1": "assets/nut"}, index=3)
        builder.add_body(label="/World/second/nut_1")
        doubled = builder.finalize(device="cpu")
        with pytest.raises(ms.InputError, match=r"body 'nut_1': must have an instance id of its own"):
            ms.layout_from_newton(scene, doubled, doubled.state())
        with pytest.raises(ms.InputError, match=r"bodies\['nut_1'\]: must name one body \(it names 2: .* 0, 3\)"):
            ms.layout_from_newton(scene, doubled, doubled.state(), {"nut_1": "nut"})
        with pytest.raises(ms.InputError, match=r"must be those of the model's 4 bodies \(got 3 poses\)"):
            ms.layout_from_newton(scene, doubled, simulated.state(), {0: "nut"})
    for one, other in zip(layout.instances, expected.instances, strict=True):
        assert (one.id, one.asset, one.class_index) == (other.id, other.asset, other.class_index)
        np.testing.assert_allclose(one.world_from_object, other.world_from_object, atol=1e-6)
    assert [(one.id, one.asset) for one in chosen.instances] == [(1, 1), (2, 0)] and chosen.index == 3
    np.testing.assert_array_equal(chosen.instances[0].world_from_object, layout.instances[2].world_from_object)


def set_quaternion(value: float) -> Callable[[mujoco.MjData], None]:
    def change(data: mujoco.MjData) -> None:
        data.xquat[1] *= value

    return change


@pytest.mark.parametrize(
    ("bodies", "change", "message"),
    [
        ({"nut_9": "nut"}, None, r"bodies\['nut_9'\]: must be a body of the model .* nut_1, nut_2, bolt_3, hand\)"),
        ({"nut_1": "mug"}, None, r"bodies\['nut_1'\]: must be an asset of the scene \(bolt, nut\)"),
        ({5: "nut"}, None, r"bodies\[5\]: must be a body of the model"),
        ("nut_1", None, r"bodies must map bodies to assets"),
        (None, set_quaternion(0.0), r"'nut_1': must have a quaternion of length 1 \(got 0\); call mujoco.mj_forward"),
        (None, set_quaternion(1.01), r"'nut_1': must have a quaternion of length 1 \(got 1.01\)"),
        (None, set_quaternion(np.nan), r"'nut_1': must have a finite pose .*; has the simulation diverged\?"),
    ],
)
def test_wrong_bodies_and_poses_are_refused(
    scene: ms.Scene, model: mujoco.MjModel, data: mujoco.MjData, bodies: Any, change: Any, message: str
) -> None:
    if change is not None:
        change(data)
    with pytest.raises(ms.InputError, match=message):
        ms.layout_from_mujoco(scene, model, data, bodies)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("nut_1", "bolt_1"), r"'bolt_1': must have an instance id of its own \(body 'nut_1' has 1, too\)"),
        (("nut_1", "bolt"), r"'bolt': must be named ASSET_ID, .* because it has a free joint"),
        (("nut_1", "mug_2"), r"'mug_2': must be named ASSET_ID"),
        (("nut_1", ""), r"^body 2: must be named ASSET_ID, .* by their names or indices: bodies="),
        ((), r"the model must have bodies named ASSET_ID, .* \(got world\)"),
    ],
)
def test_wrong_names_of_bodies_are_refused(scene: ms.Scene, names: tuple[str, ...], message: str) -> None:
    bodies = "".join(f'<body name="{name}"><freejoint/><geom size="0.1"/></body>' for name in names)
    bodies = bodies.replace(' name=""', "")
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    with pytest.raises(ms.InputError, match=message):
        ms.layout_from_mujoco(scene, model, mujoco.MjData(model))


def test_wrong_cameras_are_refused(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    camera = ms.camera_from_mujoco(model, data, "camera")
    assert (camera.width, camera.height) == SIZE and camera.fx == pytest.approx(70.0)
    with pytest.raises(ms.InputError, match=r"camera 'arm': must be a camera of the model \(camera, wrist\)"):
        view(model, data, "arm")
    with pytest.raises(ms.InputError, match=r"camera 'wrist': needs width and height"):
        ms.camera_from_mujoco(model, data, "wrist", width=64)
    with pytest.raises(ms.InputError, match=r"camera 'wrist': has no pose yet; call mujoco.mj_forward"):
        view(model, mujoco.MjData(model))
    with pytest.raises(ms.InputError, match=r"camera 'wrist': camera size must be whole numbers"):
        ms.camera_from_mujoco(model, data, "wrist", width=0, height=48)
    flat = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><camera name="flat" projection="orthographic"/></worldbody></mujoco>'
    )
    with pytest.raises(ms.InputError, match=r"camera 'flat': must have a perspective projection"):
        view(flat, mujoco.MjData(flat), "flat")
    with pytest.raises(ms.InputError, match=r"data must be a MjData .*create it by mujoco.MjData"):
        ms.camera_from_mujoco(model, model, "wrist")
