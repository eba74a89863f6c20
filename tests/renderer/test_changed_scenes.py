"""Scenes whose parameters a Mitsuba script changes between images, and uses of the plugins that are refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.renderer.layers import make_integrator, make_splats_shape
from mitsplat.renderer.meshes.mirrored_splats import SplatMirror
from mitsplat.runtime.variant import ensure_variant
from tests.renderer.test_light import WHITE_SKY, floor, nothing, slab


def perspective(target: list[float], width: int, height: int) -> dict[str, Any]:
    """Describe a camera before and above a target."""
    return {
        "type": "perspective",
        "fov": 50,
        "to_world": mi.ScalarTransform4f().look_at(origin=[0, -1.2, 1], target=target, up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": width, "height": height},
    }


def make_scene() -> Any:
    """Build a captured floor with an object, a table, a block, and a visible lamp."""
    ensure_variant()
    at = mi.ScalarTransform4f()
    lamp = at.look_at(origin=[0.4, 0.5, 1], target=[0, 0, 0], up=[0, 0, 1]).scale(0.2)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": perspective([0, 0, 0], 32, 24),
            "floor": make_splats_shape(floor(), proxy=slab()),
            "part": make_splats_shape(floor(0.1, 0.8, 0.2), proxy=slab(0.1, 0.2), instance=1),
            "table": {
                "type": "rectangle",
                "to_world": at.translate([-0.4, 0, 0.1]).scale(0.2),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}},
            },
            "block": {"type": "cube", "to_world": at.translate([0.4, 0, 0.1]).scale(0.1)},
            "lamp": {
                "type": "rectangle",
                "to_world": lamp,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}},
            },
            "sky": WHITE_SKY,
        }
    )


def moved(value: Any) -> Any:
    return mi.AffineTransform4f(mi.Transform4f().translate([0.05, -0.1, 0.05])) @ value


def shifted(value: Any) -> Any:
    points = dr.unravel(mi.Point3f, value)
    points.y -= 0.2
    return dr.ravel(points)


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("table.to_world", moved),
        ("table.bsdf.reflectance.value", lambda colour: colour * 0.3),
        ("block.vertex_positions", shifted),
        ("lamp.to_world", moved),
        ("sensor.to_world", moved),
    ],
)
def test_a_changed_parameter_changes_the_image_as_in_a_new_integrator(key: str, change: Callable[[Any], Any]) -> None:
    """The data of the shapes, and the tiles of the captured floor, are reused only while their parameters stay."""
    scene, integrator = make_scene(), make_integrator(shadow_samples=16, shadow_error=0)

    def render(renderer: Any) -> np.ndarray:
        return np.array(renderer.render(scene, seed=3))

    before = [render(integrator) for _ in range(3)][-1]
    parameters = mi.traverse(scene)
    old = type(parameters[key])(parameters[key])
    parameters[key] = change(old)
    parameters.update()
    after = render(integrator)
    assert np.abs(after - before).max() > 0.05
    np.testing.assert_allclose(after, render(make_integrator(shadow_samples=16, shadow_error=0)), atol=1e-5)
    parameters[key] = old
    parameters.update()
    np.testing.assert_allclose(render(integrator), before, atol=1e-5)


def textured_box(degree: int = 1) -> Splats:
    """Return Gaussians on a box whose colours depend on the direction."""
    random = np.random.default_rng(4)
    points = random.uniform(-1, 1, (600, 3)) * [0.2, 0.12, 0.08]
    scales = np.full((600, 3), 0.02) * random.uniform(0.5, 1, (600, 3))
    sh = random.normal(0, 0.2, (600, (degree + 1) ** 2, 3))
    return Splats(points, np.tile([0, 0, 0, 1], (600, 1)), scales, np.full(600, 0.9), sh)


def turned(angle: float, x: float, scale: float = 1.0) -> Any:
    return mi.ScalarTransform4f().translate([x, 0.1, 0.2]).rotate([0.6, 0, 0.8], angle).scale(scale)


@pytest.mark.parametrize("instance", [0, 2])
@pytest.mark.parametrize("scale", [1.0, 1.6])
def test_splats_that_are_moved_equal_splats_that_are_loaded_there(instance: int, scale: float) -> None:
    """Splats, their colours, proxy, shadow and ids move, for surroundings and for one of two equal objects."""
    ensure_variant()
    splats, proxy = textured_box(), trimesh.creation.box((0.4, 0.24, 0.16))

    def scene_of(pose: Any) -> Any:
        return mi.load_dict(
            {
                "type": "scene",
                "sensor": perspective([0, 0, 0.1], 48, 36),
                "table": {"type": "rectangle"},
                "other": make_splats_shape(splats, np.array(turned(20, 0.3).matrix), proxy, instance=1),
                "part": make_splats_shape(splats, np.array(pose.matrix), proxy, instance=instance),
                "lamp": {"type": "point", "position": [0.3, 0.2, 1.5], "intensity": 4.0},
            }
        )

    integrator = make_integrator(shadow_samples=16, shadow_error=0)
    scene = scene_of(turned(0, -0.2))
    before = [np.array(integrator.render(scene)) for _ in range(3)][-1]
    parameters = mi.traverse(scene)
    target = turned(130, -0.35, scale)
    parameters["part.to_world"] = mi.Transform4f(target)
    parameters.update()
    after = np.array(integrator.render(scene))
    truth = np.array(make_integrator(shadow_samples=16, shadow_error=0).render(scene_of(target)))
    assert np.abs(after - before).max() > 0.3
    np.testing.assert_allclose(after, truth, atol=1e-5)
    np.testing.assert_allclose(np.array(mi.traverse(scene)["part.to_world"].matrix)[..., 0], np.array(target.matrix))


def test_the_camera_plugin_can_be_moved() -> None:
    ensure_variant()
    at = mi.ScalarTransform4f()
    start, end = (at.look_at(origin=eye, target=[0, 0, 0], up=[0, 0, 1]) for eye in ([0, -1.2, 1], [0.5, -1, 0.8]))

    def sensor_at(pose: Any) -> Any:
        film = {"type": "hdrfilm", "width": 24, "height": 16}
        return mi.load_dict({"type": "opencv_camera", "fx": 25.0, "fy": 25.0, "to_world": pose, "film": film})

    scene, integrator, sensor = make_scene(), make_integrator(shadow_samples=4), sensor_at(start)
    integrator.render(scene, sensor)
    parameters = mi.traverse(sensor)
    parameters["to_world"] = mi.Transform4f(end)
    parameters.update()
    truth = np.array(make_integrator(shadow_samples=4).render(scene, sensor_at(end)))
    np.testing.assert_allclose(np.array(integrator.render(scene, sensor)), truth, atol=1e-5)
    parameters["to_world"] = mi.Transform4f(end) @ mi.Transform4f().scale(2)
    with pytest.raises(InputError, match=r"^sensor 'opencv_camera': 'to_world' must be a rotation and a translation, "):
        parameters.update()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "must be a rotation and a translation, without scale or mirror"),
        (np.full((4, 4), np.nan), "must be a finite 4x4 matrix to_world"),
    ],
)
def test_a_camera_with_an_impossible_pose_is_refused(change: np.ndarray, sentence: str) -> None:
    ensure_variant()
    film = {"type": "hdrfilm", "width": 24, "height": 16}
    camera = {"type": "opencv_camera", "fx": 25.0, "fy": 25.0, "to_world": mi.ScalarTransform4f(change), "film": film}
    with pytest.raises((InputError, RuntimeError), match=f"sensor 'opencv_camera': 'to_world' {sentence}"):
        mi.load_dict(camera)


def test_a_transform_that_deforms_moved_splats_is_refused() -> None:
    ensure_variant()
    shape = make_splats_shape(nothing(), np.array(turned(10, 0.1).matrix))
    parameters = mi.traverse(shape)
    assert list(parameters.keys()) == ["to_world"]
    parameters["to_world"] = mi.Transform4f().scale([1, 1, 2])
    with pytest.raises(InputError, match=r"^shape 'splats': 'to_world': a transform must scale uniformly"):
        parameters.update()


def test_a_rotation_about_an_axis_of_another_length_is_refused_with_its_cause() -> None:
    """Mitsuba's `rotate` does not normalise the axis: the result is no rotation."""
    ensure_variant()
    pose = np.array(mi.ScalarTransform4f().rotate([1, 1, 0], 40).matrix)
    with pytest.raises(InputError, match=r"about an axis of a length other than 1\?$"):
        make_splats_shape(nothing(), pose)


def test_the_seed_may_be_a_device_value() -> None:
    """Mitsuba's interface states `mi.UInt32`."""
    scene, integrator = make_scene(), make_integrator(shadow_samples=4)
    assert dr.all(integrator.render(scene, seed=mi.UInt32(5)) == integrator.render(scene, seed=5), axis=None)


@pytest.mark.parametrize("seed", [-1, 2**32 - 1, 2**40])
def test_the_seed_may_be_any_number(seed: int) -> None:
    scene, integrator = make_scene(), make_integrator(shadow_samples=4)
    assert dr.all(integrator.render(scene, seed=seed) == integrator.render(scene, seed=seed % 2**32), axis=None)


def test_an_integrator_around_the_plugin_is_refused_in_one_sentence() -> None:
    scene = make_scene()
    around = mi.load_dict({"type": "aov", "aovs": "d:depth", "splats": make_integrator(shadow_samples=4)})
    with pytest.raises(InputError, match=r"^integrator 'splat_proxy': must not be nested in another integrator"):
        around.render(scene, spp=1)


def fog(**material: Any) -> dict[str, Any]:
    return {"type": "cube", "interior": {"type": "homogeneous"}, **material}


@pytest.mark.parametrize(
    ("shape", "sentence"),
    [
        (
            {"type": "instance", "group": {"type": "ref", "id": "group"}},
            "shapes of type 'instance' are not supported: add the shape at each place",
        ),
        (
            {"type": "ellipsoids", "centers": [0, 0, 0], "scales": [1, 1, 1], "quaternions": [0, 0, 0, 1]},
            "shapes of type 'ellipsoids' are not supported: load the file with a shape of type 'splats'",
        ),
        (
            {"type": "ellipsoidsmesh", "centers": [0, 0, 0], "scales": [1, 1, 1], "quaternions": [0, 0, 0, 1]},
            "shapes of type 'ellipsoidsmesh' are not supported: load the file with a shape of type 'splats'",
        ),
        (
            fog(bsdf={"type": "null"}),
            "participating media are not supported: remove 'interior' and 'exterior' of the shape 'one'",
        ),
        (
            fog(bsdf={"type": "dielectric"}),
            "participating media are not supported: remove 'interior' and 'exterior' of the shape 'one'",
        ),
    ],
    ids=["instance", "ellipsoids", "ellipsoidsmesh", "fog", "milk"],
)
def test_shapes_that_would_be_rendered_wrongly_are_refused_in_one_sentence(
    shape: dict[str, Any], sentence: str
) -> None:
    ensure_variant()
    shape |= {key: mi.TensorXf(value, (1, len(value))) for key, value in shape.items() if isinstance(value, list)}
    scene = {"type": "scene", "group": {"type": "shapegroup", "cube": {"type": "cube"}}, "one": shape}
    sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
    loaded = mi.load_dict(scene | {"sensor": sensor, "part": make_splats_shape(floor())})
    with pytest.raises(InputError) as error:
        make_integrator().render(loaded)
    assert str(error.value) == f"integrator 'splat_proxy': {sentence}"


@pytest.mark.parametrize("sky", [False, True])
def test_surfaces_without_material_are_invisible(sky: bool) -> None:
    """The material `null` changes no light: there is no shadow and no depth, and lamps and the sky behind it shine."""
    ensure_variant()
    at = mi.ScalarTransform4f()
    box = {"type": "cube", "to_world": at.scale(0.6), "bsdf": {"type": "null"}}
    lamp_pose = at.look_at(origin=[0.1, 1, 0.9], target=[0, 0, 0], up=[0, 0, 1]).scale(0.1)
    shared = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "to_world": at.look_at(origin=[0, -1.2, 1], target=[0, 0, 0.3], up=[0, 0, 1]),
            "fov": 60,
            "film": {"type": "hdrfilm", "width": 24, "height": 16},
        },
        "floor": make_splats_shape(floor(), proxy=slab()),
        "table": {"type": "rectangle", "to_world": at.translate([0, 0, 0.1]).scale(0.1)},
        "ball": {"type": "sphere", "center": [0.3, 0, 0.3], "radius": 0.2, "bsdf": {"type": "roughplastic"}},
        "lamp": {"type": "point", "position": [0.4, 0.5, 1], "intensity": 1.0},
    }
    if sky:
        shared |= {"panel": {"type": "rectangle", "to_world": lamp_pose, "emitter": {"type": "area"}}, "sky": WHITE_SKY}
    with_box, without = (
        np.array(make_integrator(shadow_error=0, shadow_samples=16).render(mi.load_dict(shared | more, parallel=False)))
        for more in ({"box": box}, {})
    )
    # Shapes have another order without the box, so that sums of up to 16 terms may be rounded differently.
    np.testing.assert_allclose(with_box, without, rtol=16 * 2.0**-24, atol=16 * 2.0**-24)


def make_scene_in_a_box() -> Any:
    """Build a scene inside a box of the material `null`, with lamps of three kinds."""
    ensure_variant()
    at = mi.ScalarTransform4f()
    pose = at.look_at(origin=[0.1, 1, 0.9], target=[0, 0, 0], up=[0, 0, 1]).scale(0.1)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": perspective([0, 0, 0.1], 24, 16),
            "box": {"type": "cube", "to_world": at.scale(0.6), "bsdf": {"type": "null"}},
            "floor": make_splats_shape(floor(), proxy=slab()),
            "ball": {
                "type": "sphere",
                "to_world": at.translate([0.3, 0, 0.3]).scale(0.2),
                "bsdf": {"type": "roughplastic"},
            },
            "lamp": {"type": "point", "position": [0.4, 0.5, 1], "intensity": 1.0},
            "panel": {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": 10.0}},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
        },
        parallel=False,
    )


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("ball.to_world", moved),
        ("floor.to_world", moved),
        ("lamp.position", lambda point: point + mi.Point3f(-0.6, 0, 0.2)),
        ("lamp.intensity.value", lambda intensity: intensity * 4),
        ("panel.to_world", moved),
        ("panel.emitter.radiance.value", lambda radiance: radiance * 4),
        ("sky.radiance.value", lambda radiance: radiance * 4),
    ],
)
def test_parameters_of_a_scene_with_invisible_shapes_change_the_image(key: str, change: Callable[[Any], Any]) -> None:
    scene, integrator = make_scene_in_a_box(), make_integrator(shadow_samples=16, shadow_error=0)
    before = [np.array(integrator.render(scene)) for _ in range(2)][-1]
    parameters = mi.traverse(scene)
    parameters[key] = change(type(parameters[key])(parameters[key]))
    parameters.update()
    after = np.array(integrator.render(scene))
    assert np.abs(after - before).max() > 0.01
    truth = make_integrator(shadow_samples=16, shadow_error=0).render(scene)
    np.testing.assert_array_equal(after, np.array(truth))


def test_the_scene_without_invisible_shapes_is_built_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, integrator = make_scene_in_a_box(), make_integrator(shadow_samples=4)
    integrator.render(scene)
    loaded = []
    load = mi.load_dict
    monkeypatch.setattr(mi, "load_dict", lambda *args, **options: loaded.append(args) or load(*args, **options))
    integrator.render(scene)
    assert not loaded


def test_reflected_splats_are_built_again_only_if_splats_move(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, integrator = make_scene_in_a_box(), make_integrator(shadow_samples=4, mesh_samples=4)
    built = []
    build = SplatMirror.build
    monkeypatch.setattr(SplatMirror, "build", lambda *arguments: built.append(1) or build(*arguments))
    parameters = mi.traverse(scene)
    counts = []
    for key in ("ball.bsdf.alpha", "ball.to_world", "lamp.position", "floor.to_world"):
        before = np.array(integrator.render(scene))
        parameters[key] = moved(parameters[key]) if key.endswith("to_world") else parameters[key] * 0.5
        parameters.update()
        after = np.array(integrator.render(scene))
        assert np.abs(after - before).max() > 0.01
        counts.append(len(built))
        truth = make_integrator(shadow_samples=4, mesh_samples=4).render(scene)
        built.pop()
        np.testing.assert_array_equal(after, np.array(truth))
    assert counts == [1, 1, 1, 2]


@pytest.mark.parametrize("name", ["bsdf", "interior"])
def test_splats_with_a_material_or_medium_are_refused(name: str) -> None:
    """They would have no effect."""
    ensure_variant()
    child = mi.load_dict({"type": "conductor" if name == "bsdf" else "homogeneous"})
    with pytest.raises(InputError, match=rf"^shape 'splats': must not have materials, .* \(got '{name}'\)$"):
        make_splats_shape(nothing(), **{name: child})


def test_splats_with_an_emitter_are_refused() -> None:
    """They would be treated as a lamp and not be visible."""
    ensure_variant()
    emitter = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": 1.0}})
    with pytest.raises(InputError, match=r"^shape 'splats': must not have an emitter"):
        make_splats_shape(nothing(), emitter=emitter)
