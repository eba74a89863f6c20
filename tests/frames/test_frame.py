"""Frames of a small scene, from the plan to image, labels and XML."""

from __future__ import annotations

import itertools
import json
import pickle
from dataclasses import fields, replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from pydantic import TypeAdapter

import mitsplat as ms
from mitsplat.errors import InputError
from mitsplat.formats.registry import Catalogue, write_frame
from mitsplat.frames.camera_response import develop, lit_picture
from mitsplat.frames.mitsuba_xml import export_xml, render_xml
from mitsplat.frames.scene_builder import NO_SPLATS
from mitsplat.geometry.camera import Camera
from mitsplat.quality import PRESETS
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.scene.planning.frame_plan import FramePlan
from mitsplat.scene.spec.light_spec import LightSpec
from tests.conftest import WriteScene
from tests.renderer.test_render import make_splats


@pytest.fixture(scope="module")
def settled() -> dict[str, Any]:
    """Settle the layout of the small scene once for all tests of this module."""
    return {}


@pytest.fixture
def scene(write_scene: WriteScene, scene_data: dict[str, Any]) -> ms.Scene:
    scene_data["output"] |= {"width": 192, "height": 144}
    scene_data["camera"] |= {"radius": 0.25, "height": 0.25}
    return ms.load_scene(write_scene(scene_data))


def layout_of_small_scene(scene: ms.Scene, settled: dict[str, Any]) -> ms.Layout:
    if "layout" not in settled:
        settled["layout"] = ms.settle_layout(scene, 0)
    return settled["layout"]


def test_a_frame_shows_and_labels_its_objects(scene: ms.Scene, settled: dict[str, Any]) -> None:
    layout = layout_of_small_scene(scene, settled)
    frame = ms.render_frame(scene, 1, layout=layout)
    assert frame.image.shape == (144, 192, 3) and frame.image.dtype == np.uint8
    known = {instance.id for instance in layout.instances}
    assert set(np.unique(frame.instance)) <= known | {0}
    assert frame.labels.instances
    for label in frame.labels.instances:
        assert label.class_name in scene.class_names
        instance = next(i for i in layout.instances if i.id == label.id)
        centre, _ = frame.camera.project(instance.world_from_object[:3, 3])
        x0, y0, x1, y1 = label.box
        assert x0 - 8 <= centre[0, 0] <= x1 + 8 and y0 - 8 <= centre[0, 1] <= y1 + 8
    assert set(frame.seconds) >= {"render", "composite", "label"}
    assert frame._repr_png_().startswith(b"\x89PNG")
    assert frame.normal is frame.layers.normal


def test_values_print_on_one_line_without_arrays(scene: ms.Scene, settled: dict[str, Any]) -> None:
    layout = layout_of_small_scene(scene, settled)
    frame = ms.render_frame(scene, 1, layout=layout)
    asset = scene.assets[0]
    for value in (scene, layout, frame, frame.labels, frame.layers, asset, asset.splats):
        assert "\n" not in repr(value) and "array" not in repr(value)
    assert repr(frame) == f"Frame(1: 192 x 144 px, {len(frame.labels.instances)} labels)"
    assert f"{len(layout.instances)} objects" in repr(layout) and f"{len(asset.splats)} Gaussians" in repr(asset)
    assert all(label.class_name in repr(frame.labels) for label in frame.labels.instances)


def test_the_same_frame_has_the_same_bytes(scene: ms.Scene, settled: dict[str, Any]) -> None:
    layout = layout_of_small_scene(scene, settled)
    first = ms.render_frame(scene, 2, layout=layout)
    ms.render_frame(scene, 3, layout=layout)
    again = ms.render_frame(ms.load_scene(scene.path), 2, layout=layout)
    assert first.image.tobytes() == again.image.tobytes()
    assert first.instance.tobytes() == again.instance.tobytes()


@pytest.mark.parametrize("source", ["splats", "proxies"])
def test_silhouettes_equal_renderings_of_single_instances(
    write_scene: WriteScene, scene_data: dict[str, Any], settled: dict[str, Any], scene: ms.Scene, source: str
) -> None:
    """The mask of an instance rendered alone equals its covered pixels among the other instances."""
    layout = layout_of_small_scene(scene, settled)
    # Surroundings may hide an instance; rendered alone, it is unoccluded.
    table = {**scene_data["shapes"][0], "visible": False}
    data = {**scene_data, "shapes": [table], "labels": {"source": source}}
    chosen = ms.load_scene(write_scene(data, f"{source}.yaml"))
    frame = ms.render_frame(chosen, 1, layout=layout)
    ids = frame.instance if source == "splats" else frame.layers.proxy_instance
    assert len(frame.labels.instances) >= 2
    for label in frame.labels.instances:
        x0, y0, x1, y1 = label.box
        assert not (label.mask & (ids[y0:y1, x0:x1] != label.id)).any()
        assert 0 < label.agreement <= 1 and 0 < label.boundary_f1 <= 1
        alone = replace(layout, instances=tuple(i for i in layout.instances if i.id == label.id))
        (only,) = ms.render_frame(chosen, 1, layout=alone).labels.instances
        np.testing.assert_array_equal(only.mask, label.amodal.mask)
        assert (only.box, only.visible_fraction) == (label.amodal.box, 1)
        assert label.visible_fraction == label.area / only.area


def test_a_frame_rendered_from_its_record_is_the_same(
    scene_data: dict[str, Any],
    write_scene: WriteScene,
    scene: ms.Scene,
    settled: dict[str, Any],
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A scene with another seed renders the same image from the manifest record of a frame."""
    layout = layout_of_small_scene(scene, settled)
    path = [{"position": [0.1, 0, 0.4], "temperature": 3000}, {"position": [-0.1, 0, 0.5], "temperature": 8000}]
    scene_data["lights"] = [
        {"kind": "point", "position": [0, 0, 0.5], "intensity": 0.3, "temperature": 5000, "path": path},
        {"kind": "environment", "radiance": 0.5},
    ]
    scene_data["randomise"] = {
        "exposure": [-1, 1], "hue": [-5, 5], "saturation": [0.8, 1.2], "white_balance": [5000, 7000], "iso": [100, 800],
        "vignetting": [0, 1], "motion_blur": [0, 3], "jpeg": [40, 95],
    }  # fmt: skip
    first = ms.load_scene(write_scene(scene_data))
    frame = ms.render_frame(first, 2, layout=layout)
    (tmp_path / "images" / frame.plan.split).mkdir(parents=True)
    (tmp_path / "labels" / frame.plan.split).mkdir(parents=True)
    record = json.loads(json.dumps(write_frame(frame, tmp_path, first.spec, Catalogue.of(first))))

    plan = FramePlan(
        **{name: record[name] for name in ("index", "layout", "view", "split", "draws", "seed")},
        camera=Camera.from_json(record["camera"]),
        next_camera=None,
        lights=tuple(TypeAdapter(LightSpec).validate_python(light) for light in record["lights"]),
    )
    scene_data["seed"] = 999
    other = ms.load_scene(write_scene(scene_data))
    assert ms.render_frame(other, 2, layout=layout).image.tobytes() != frame.image.tobytes()
    monkeypatch.setattr("mitsplat.frames.frame.plan_frame", lambda *_, **__: plan)
    assert ms.render_frame(other, 2, layout=layout).image.tobytes() == frame.image.tobytes()


@pytest.mark.parametrize("shadow", ["none", "image"])
def test_shadow_modes_differ_from_traced(
    write_scene: WriteScene, scene_data: dict[str, Any], settled: dict[str, Any], scene: ms.Scene, shadow: str
) -> None:
    layout = layout_of_small_scene(scene, settled)
    other = ms.load_scene(write_scene({**scene_data, "composite": {"shadow": shadow}}, f"{shadow}.yaml"))
    traced, changed = ms.render_frame(scene, 0, layout=layout), ms.render_frame(other, 0, layout=layout)
    assert not np.array_equal(traced.image, changed.image)
    np.testing.assert_array_equal(traced.instance, changed.instance)


@pytest.fixture
def refined(write_scene: WriteScene, scene_data: dict[str, Any]) -> ms.Scene:
    changes = {"quality": "balanced", "rendering": {"kernel": "mip", "samples": 2}}
    return ms.load_scene(write_scene({**scene_data, **changes}, "refined.yaml"))


def test_rendering_refines_the_preset(scene: ms.Scene, refined: ms.Scene, settled: dict[str, Any]) -> None:
    layout = layout_of_small_scene(scene, settled)
    whole = replace(PRESETS["balanced"], kernel="mip", samples=2)
    frames = [ms.render_frame(refined, 0, layout=layout, quality=quality) for quality in (None, "balanced", whole)]
    images = [frame.image for frame in frames]
    assert frames[0].order_error is not None and frames[0].order_error["largest"] <= whole.tolerance
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[0], images[2])
    assert not np.array_equal(images[0], ms.render_frame(scene, 0, layout=layout, quality="balanced").image)


@pytest.mark.parametrize("name", ["scene", "refined"])
def test_exported_xml_renders_the_same_picture(
    name: str,
    request: pytest.FixtureRequest,
    settled: dict[str, Any],
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = request.getfixturevalue(name)
    layout = layout_of_small_scene(scene, settled)
    monkeypatch.setattr("mitsplat.frames.mitsuba_xml.settle_layout", lambda *_: layout)
    export_xml(scene, 1, tmp_path / "one.xml")
    picture = render_xml(tmp_path / "one.xml", tmp_path / "out")
    frame = ms.render_frame(scene, 1, layout=layout)
    ours = np.asarray(Image.open(picture), dtype=np.float64)
    covered = frame.layers.alpha > 0.99
    assert covered.any()
    assert np.abs(ours - develop(frame.rgb, {}))[covered].mean() < 1.0


def test_exported_xml_has_the_proxies_of_invisible_shapes(
    write_scene: WriteScene,
    scene_data: dict[str, Any],
    settled: dict[str, Any],
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A wall beside the region, which only casts shadows, hides the lamp from the middle of the table."""
    wall = {"name": "wall", "box": {"size": [0.02, 1, 0.6], "position": [0.3, 0, 0.3]}, "proxy": True}
    scene = ms.load_scene(write_scene({**scene_data, "shapes": [*scene_data["shapes"], wall]}))
    layout = layout_of_small_scene(scene, settled)
    monkeypatch.setattr("mitsplat.frames.mitsuba_xml.settle_layout", lambda *_: layout)
    export_xml(scene, 1, tmp_path / "one.xml")
    exported, frame = mi.load_file(str(tmp_path / "one.xml")), ms.render_frame(scene, 1, layout=layout)
    image = np.array(exported.integrator().render(exported, exported.sensors()[0]))
    depth, light = (
        image[..., 4 + exported.integrator().aov_names().index(name)] for name in ("proxy.depth", "light.R")
    )
    np.testing.assert_allclose(depth, frame.layers.proxy_depth, atol=1e-4)
    assert np.mean(np.abs(light - frame.layers.light[..., 0])) < 0.01  # another seed


def test_invalid_xml_is_refused_in_one_sentence(tmp_path: Any) -> None:
    (tmp_path / "bad.xml").write_text('<scene version="3.0.0"><shape type="splats"/></scene>')
    with pytest.raises(InputError, match="filename"):
        render_xml(tmp_path / "bad.xml", tmp_path)
    with pytest.raises(InputError, match="no such file"):
        render_xml(tmp_path / "absent.xml", tmp_path)


def test_a_frame_has_its_plan_and_layers(scene: ms.Scene, settled: dict[str, Any]) -> None:
    layout = layout_of_small_scene(scene, settled)
    frame = ms.render_frame(scene, 1, layout=layout)
    assert (frame.index, frame.camera) == (1, frame.plan.camera)
    for name in ("depth", "instance"):
        assert getattr(frame, name) is getattr(frame.layers, name)
    again = pickle.loads(pickle.dumps(frame))
    np.testing.assert_array_equal(again.image, frame.image)
    np.testing.assert_array_equal(again.layers.highlight, frame.layers.highlight)


@pytest.mark.parametrize("source", ["splats", "proxies"])
def test_labels_transfer_only_ids_and_one_depth_to_the_host(
    scene_data: dict[str, Any],
    write_scene: WriteScene,
    scene: ms.Scene,
    settled: dict[str, Any],
    source: str,
) -> None:
    chosen = ms.load_scene(write_scene(scene_data | {"labels": {"source": source}}, f"{source}.yaml"))
    frame = ms.render_frame(chosen, 1, layout=layout_of_small_scene(scene, settled))
    names = {field.name for field in fields(frame.layers)}
    assert names & vars(frame.layers).keys() == {"instance", "proxy_instance", "depth"}
    assert "rgb" not in vars(frame)
    np.testing.assert_array_equal(frame.rgb, lit_picture(frame.layers, chosen.spec.composite))
    again = develop(frame.rgb, frame.plan.draws, chosen.spec.composite, seed=frame.plan.seed)
    np.testing.assert_array_equal(again, frame.image)


def test_the_depth_area_of_a_proxy_is_that_of_the_picture(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    """The depth files are those of the splats, which leave the corners of the box empty."""
    scene_data["shapes"][0]["visible"] = False
    scene_data |= {"objects": [{"asset": "assets/nut", "scale": 4}], "labels": {"source": "proxies"}}
    scene = ms.load_scene(write_scene(scene_data))
    frame = ms.render_frame(scene, 0, layout=ms.Layout.from_poses(scene, {"nut": [np.eye(4)]}))
    (label,) = frame.labels.instances
    silhouette = label.amodal.image_mask(64, 48)
    assert 0 < label.depth_area < label.amodal.area
    assert label.depth_area == np.count_nonzero(silhouette & (frame.depth > 0))


def test_a_closed_renderer_is_refused(
    scene: ms.Scene, settled: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = layout_of_small_scene(scene, settled)
    with ms.Renderer(scene) as renderer, monkeypatch.context() as patch:
        variant = mi.variant()
        patch.setattr("mitsplat.frames.frame.mi.variant", lambda: "scalar_rgb")
        with pytest.raises(InputError, match=f"Mitsuba's variant must stay {variant}"):
            renderer.render(0, layout=layout)
    with pytest.raises(InputError, match="closed"):
        renderer.render(0, layout=layout)


def test_frame_out_of_range_is_refused(scene: ms.Scene) -> None:
    with pytest.raises(InputError):
        ms.render_frame(scene, 12)


QUICK = (("fast", 1, False), ("balanced", 2, True), ("fast", "edges", True))


@pytest.mark.parametrize(
    ("quality", "samples", "close"),
    [
        pytest.param(*case, marks=() if case in QUICK else pytest.mark.extended)
        for case in itertools.product(("fast", "balanced"), (1, 2, "edges"), (False, True))
    ],
)
def test_a_still_camera_renders_the_same_bytes_as_a_new_renderer(quality: str, samples: Any, close: bool) -> None:
    """From the third image on, only tiles with objects are rendered, also where static splats occlude them."""
    ms.render_splats(make_splats(1), Camera.look_at((0, 0, -2), (0, 0, 0), width=8, height=8, fov_x=50))
    static = make_splats_shape(make_splats(300, 1, scales=(0.02, 0.1)))
    things = [make_splats(40, seed, spread=0.15, scales=(0.01, 0.05)) for seed in (2, 3, 4)]
    camera = Camera.look_at((0, 0, -0.3 if close else -2), (0, 0, 0), up=(0, -1, 0), width=50, height=37, fov_x=50)

    def scene(number: int) -> Any:
        pose = np.eye(4)
        pose[0, 3] = 0.2 * number - 0.3
        thing = make_splats_shape(things[number], pose, instance=number + 1)
        return mi.load_dict({"type": "scene", "static": static, "thing": thing})

    def layers(integrator: Any, number: int) -> ms.Layers:
        return render_layers(integrator, scene(number), camera)

    chosen = replace(PRESETS[quality], samples=samples)
    still = make_integrator(quality=chosen, shadow="none")
    for number in (0, 1, 2, 0):
        got, fresh = layers(still, number), layers(make_integrator(quality=chosen, shadow="none"), number)
        for field in fields(got):
            assert np.array_equal(getattr(got, field.name), getattr(fresh, field.name)), (number, field.name)
    assert still.renderer._static_tiles is not None and still.renderer._static_tiles[1] is not None
    elsewhere = replace(camera, cx=camera.cx + 1)
    render_layers(still, scene(0), elsewhere)
    assert still.renderer._static_tiles[1] is None


def test_a_still_camera_renders_surroundings_without_splats() -> None:
    """The wall has a proxy but no splats."""
    integrator = make_integrator(shadow="none")
    wall = make_splats_shape(NO_SPLATS, proxy=trimesh.creation.box((1, 1, 0.1)))
    seen = make_splats_shape(make_splats(20, 3), instance=1)
    camera = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=32, height=24, fov_x=40)
    pictures = [
        render_layers(integrator, mi.load_dict({"type": "scene", "wall": wall, "seen": seen}), camera).rgb.tobytes()
        for _ in range(3)
    ]
    assert pictures[0] == pictures[1] == pictures[2]


def test_a_still_camera_renders_an_object_without_splats() -> None:
    """The object has only a proxy; a new renderer gives the same image."""
    around = make_splats_shape(make_splats(20, 3))
    bare = make_splats_shape(NO_SPLATS, instance=1, proxy=trimesh.creation.box((0.2, 0.2, 0.1)))
    camera = Camera.look_at((0, 0, -2), (0, 0, 0), up=(0, -1, 0), width=32, height=24, fov_x=40)
    scene, still = mi.load_dict({"type": "scene", "around": around, "bare": bare}), make_integrator(shadow="none")
    pictures = [render_layers(still, scene, camera).rgb.tobytes() for _ in range(3)]
    assert still.renderer._static_tiles is not None and still.renderer._static_tiles[1] is not None
    assert set(pictures) == {render_layers(make_integrator(shadow="none"), scene, camera).rgb.tobytes()}


def test_views_of_a_layout_share_uploaded_arrays(
    write_scene: WriteScene,
    scene_data: dict[str, Any],
    settled: dict[str, Any],
    scene: ms.Scene,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Area lights are rebuilt for every frame; the renderer must not treat them as changed splats."""
    from mitsplat.renderer.composition import scene_contents

    uploads = []
    merge = scene_contents.merge_clouds
    monkeypatch.setattr(scene_contents, "merge_clouds", lambda clouds: uploads.append(1) or merge(clouds))
    layout = layout_of_small_scene(scene, settled)
    lit = scene_data | {"lights": [{"kind": "area", "position": [0, 0, 1], "target": [0, 0, 0]}]}
    chosen = ms.load_scene(write_scene(lit, "lit.yaml"))
    for index in (0, 1):
        ms.render_frame(chosen, index, layout=layout)
    assert len(uploads) == 1
