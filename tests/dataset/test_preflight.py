"""Preflight checks: runs that would produce no labels or exceed this machine are refused with the cause."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.checks import scene_warnings as warnings_module
from mitsplat.checks.path_checks import check_scene
from mitsplat.checks.scene_warnings import scene_warnings
from mitsplat.dataset import preflight as prospects
from mitsplat.dataset import write as dataset
from mitsplat.dataset.preflight import disk_faults, image_faults, refuse, run_faults, sees
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.frames.accuracy import speed_accuracy as chart
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_points import points_inside
from mitsplat.scene.layout import NO_PHYSICS, Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.frame_plan import plan_frame
from tests.bodies import pose_at
from tests.cli.typed import run
from tests.dataset.test_write import render, settle


def path_of(*eyes, target=(0, 0, 0.02), **intrinsics):
    """Describe a camera path with views from each eye to the target."""
    lens = {"intrinsics": intrinsics} if intrinsics else {}
    return {"kind": "path", "keys": [{"eye": list(eye), "target": list(target)} for eye in eyes], **lens}


ABOVE, INSIDE = (0.3, 0.3, 0.4), (0.1, 0.1, -0.05)
TABLE = {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}
BIN, NARROW = ({"name": "bin", "bin": {"size": [0.012, depth, 0.03]}} for depth in (0.03, 0.015))
HOPELESS = {
    "inside": ({"camera": path_of(INSIDE, (0.2, 0, -0.05))}, "camera: every view is from inside of shape 'table'"),
    "away": ({"camera": path_of(ABOVE, target=(3, 3, 4))}, "camera: no view shows any place that objects can reach"),
    "narrow": ({"camera": path_of(ABOVE, fx=1e9)}, r"camera.intrinsics: an image shows at most .*e-08 m"),
    "far": ({"camera": path_of((200, 0, 200), fov_x=60)}, r"no object covers more than .* \(labels.min_pixels is 16\)"),
    "tiny": ({"output": {"width": 1, "height": 1}}, "an image of 1 px cannot show labels.min_pixels = 16"),
    "huge": ({"output": {"width": 16000, "height": 16000}}, r"16000x16000 px takes at least 119.7 GiB of memory \(8.0"),
    "room": (
        {"objects": [{"asset": "assets/nut", "count": 9000}]},
        r"9000 objects of 54 l .* \(its free volume is 28.8 l\)",
    ),
    "scale": (
        {"objects": [{"asset": "assets/nut", "scale": 0.001}, {"asset": "assets/bolt"}]},
        r"objects\[0\]: nut: the mesh must be 0.0005 m to 20.0 m across, .*; correct objects\[0\].scale",
    ),
    "frames": ({"output": {"layouts": 10**9, "views": 10**9}}, "layouts x views must be at most 2147483647"),
    "disk": ({"output": {"layouts": 10**5, "views": 10**4}}, r"1000000000 images take at least 7629.4 GiB \(10.0 GiB"),
    "buried": ({"region": {"min": [-0.1, -0.1, -0.09], "max": [0.1, 0.1, -0.01]}}, "inside of .*, 'table'"),
    "nothing below": ({"region": {"min": [1, 1, 0.1], "max": [1.2, 1.2, 0.2]}}, "no collider is below it"),
    "below": ({"region": {"min": [0, 0, -0.5], "max": [0.2, 0.2, -0.3]}}, "no collider is below it"),
    "time": ({"settle": {"max_time": 1e9}}, r"max_time must be at most 2000 s \(got 1e\+09 s\)"),
}


@pytest.fixture
def machine(monkeypatch):
    """Mock a machine with 8 GiB of memory and 10 GiB of free disk space."""
    for module in (prospects, warnings_module):
        monkeypatch.setattr(module, "unused_memory", lambda: 8.0)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(2**40, 0, 10 * 2**30))


def scene_with(scene_data, write_scene, change):
    return load_scene(write_scene({**scene_data, **change}))


@pytest.mark.parametrize("name", HOPELESS)
@pytest.mark.usefixtures("machine")
def test_each_hopeless_scene_is_refused_with_its_cause(name, scene_data, write_scene):
    assert list(run_faults(load_scene(write_scene(scene_data)))) == []
    change, cause = HOPELESS[name]
    scene = scene_with(scene_data, write_scene, change)
    kind = MissingResourceError if name in ("huge", "disk") else InputError
    with pytest.raises(kind, match=f"^{scene.path}: .*{cause}"):
        refuse(scene, run_faults(scene))


@pytest.mark.usefixtures("machine")
def test_finished_images_need_no_disk_space(tmp_path):
    (text,) = [fault.text for fault in disk_faults(2_000_000, tmp_path)]
    assert text == f"output: 2000000 images take at least 15.3 GiB (10.0 GiB are free at {tmp_path})"
    (tmp_path / "manifest.jsonl").write_text("{}\n" * 1_000_000)
    assert list(disk_faults(2_000_000, tmp_path)) == []


@pytest.mark.usefixtures("machine")
def test_check_and_render_report_the_same_fault(scene_data, write_scene, tmp_path, capsys):
    path = write_scene({**scene_data, "camera": path_of(INSIDE)})
    message = "camera: every view is from inside of shape 'table', which hides all objects"
    assert run("check", path) == 1
    assert f"look  visibility: {message}\n      to do: move camera out of it\n" in capsys.readouterr().out
    for command in (("render", path, "-o", tmp_path / "out"), ("render", path, "--tolerance", "0.1")):
        assert run(*command) == 2
        assert f"{path}: {message}; move camera out of it" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    buried = write_scene({**scene_data, **HOPELESS["buried"][0]})
    for command in (("preview", buried, "-o", tmp_path / "one.png"), ("settle", buried)):
        assert run(*command) == 2
        assert "region: lies inside of colliders" in capsys.readouterr().err
    scene_data["camera"]["intrinsics"] = {"fx": 60, "distortion": [0.1, 0, 0, 0]}
    scene_data["output"]["formats"] = ["bop"]
    assert run("check", write_scene(scene_data)) == 1
    assert "look  formats: " in capsys.readouterr().out
    assert run("render", path, "--workers", 1000, "-o", tmp_path / "out") == 2


@pytest.mark.usefixtures("machine")
def test_scenes_that_may_work_are_not_refused(scene_data, write_scene):
    """Accepted: closed rooms around camera and objects, close-ups, and background without objects."""
    room = {"name": "room", "box": {"size": [3, 3, 3], "position": [0, 0, 1.39]}, "visible": True, "collider": False}
    fine = [
        {"shapes": [*scene_data["shapes"], room]},
        {"camera": path_of((0.3, 0.3, 0.4), INSIDE)},
        {"camera": path_of((0.03, 0.0, 0.03), fov_x=20)},
        {"camera": path_of((0.0, 0.0, 9.0), fov_x=3)},
        {"objects": [], "camera": path_of(ABOVE, target=(3, 3, 4))},
        {"shapes": [*scene_data["shapes"], BIN]},
        {"region": {"min": [-0.2, -0.2, -0.05], "max": [0.2, 0.2, 0.1]}},
        {"objects": [{"asset": "assets/nut", "poses": [{"position": [0, 0, 0.1]}]}]},
    ]
    for change in fine:
        assert list(run_faults(scene_with(scene_data, write_scene, change))) == [], change


TOLD = "views", "lights", "bin"


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"camera": path_of(ABOVE, ABOVE, INSIDE, INSIDE)}, "of 12 views, [2-6] lie inside a shape"),
        ({"lights": [{"kind": "point", "position": [0, 0, -0.05]}]}, r"lights\[0\] is inside of shape 'table'"),
        (
            {"shapes": [{"name": "table", "box": TABLE, "visible": True}, NARROW]},
            r"shapes\[1\]: 'nut' does not fit into 'bin'",
        ),
    ],
)
def test_each_doubtful_scene_gets_its_warning(change, found, scene_data, write_scene, machine):
    assert all(finding.ok for finding in scene_warnings(load_scene(write_scene(scene_data))))
    scene_data["output"] = {**scene_data["output"], "layouts": 1, "views": 12}
    scene = scene_with(scene_data, write_scene, change)
    (finding,) = (finding for finding in check_scene(scene) if finding.name in TOLD and not finding.ok)
    assert re.match(found, finding.text)


@pytest.mark.parametrize(
    ("position", "region", "text"),
    [
        ([0, 0, 0], None, None),
        ([2, 0, 0], None, "shapes[2]: the region is beside the bin 'bin', so no object falls into it"),
        ([0, 0, 5], None, "shapes[2]: the region is beside the bin 'bin', so no object falls into it"),
        ([0, 0, 0], {"min": [-1, -1, 0.1], "max": [1, 1, 0.3]}, "region: only 4% of it is above the bin 'bin'"),
    ],
)
def test_a_region_outside_of_the_bin_is_reported(position, region, text, scene_data, write_scene):
    scene_data["shapes"] = [
        *scene_data["shapes"], *[{"name": f"pad {i}", "box": {"size": [9, 9, 0.1], "position": [0, 0, -1]}}
                                 for i in range(2 - len(scene_data["shapes"]))],
        {"name": "bin", "bin": {"size": [0.4, 0.4, 0.1], "position": position}},
    ]  # fmt: skip
    scene = scene_with(scene_data, write_scene, {} if region is None else {"region": region})
    found = [finding.text for finding in scene_warnings(scene) if finding.name == "bin"]
    assert found == ([] if text is None else [text])


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (("housing", "Housing"), "classes 'Housing' and 'housing' differ only in case, separators or"),
        (("hex-nut", "hex_nut "), "classes 'hex-nut' and 'hex_nut ' differ only in case, separators or"),
        (("Geh\u00e4use", "Geha\u0308use"), "classes 'Geha\u0308use' and 'Geh\u00e4use' differ only in case, "),
        (("M8x1.5", "M8x15"), None),
        (("housing", "housing"), None),
    ],
)
def test_classes_that_differ_only_in_spelling_are_reported(names, text, scene_data, write_scene):
    entries = [entry | {"class_name": name} for entry, name in zip(scene_data["objects"], names, strict=True)]
    scene = load_scene(write_scene(scene_data | {"objects": entries}))
    found = [finding.text for finding in scene_warnings(scene) if finding.name == "classes" and not finding.ok]
    assert (not found) if text is None else (len(found) == 1 and text in found[0]), found


def test_check_warns_of_slow_settling_and_of_large_images(scene_data, write_scene, monkeypatch):
    scene_data["objects"][0]["count"] = [100, 200]
    scene_data["output"] |= {"width": 3000, "height": 3000}
    monkeypatch.setattr(warnings_module, "unused_memory", lambda: 5.0)
    found = {
        finding.name: finding.text for finding in scene_warnings(load_scene(write_scene(scene_data))) if not finding.ok
    }
    assert found["settling"] == "a layout of up to 201 objects takes minutes to settle"
    assert re.match(r"an image of 3000x3000 px may take \d+\.\d GiB of memory \(5\.0 GiB are unused\)", found["memory"])


def test_an_image_larger_than_the_memory_is_refused_before_rendering(scene_data, write_scene, monkeypatch):
    monkeypatch.setattr(prospects, "unused_memory", lambda: 22.5)
    scene = load_scene(write_scene(scene_data), overrides={"output.width": 8000, "output.height": 6000})
    (fault,) = image_faults(scene)
    assert fault.text == "output: an image of 8000x6000 px takes at least 22.9 GiB of memory (22.5 GiB are unused)"


@pytest.mark.usefixtures("machine")
def test_more_workers_than_the_memory_holds_are_refused_with_their_bound(scene_data, write_scene, tmp_path, capsys):
    scene_data["output"] |= {"layouts": 20, "views": 1, "width": 640, "height": 360}
    path = write_scene(scene_data)
    assert run("render", path, "-o", tmp_path / "out", "--workers", 100_000) == 3
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"mitsplat: {path}: workers must be at most 13, because each takes at least 0.6 GiB of memory for an image of "
        "640x360 px (8.0 GiB are unused; got 100000); without a number, cores and memory determine it"
    )
    assert not (tmp_path / "out").exists()
    scene = load_scene(path)
    assert list(run_faults(scene, workers=13)) == []
    assert [fault.name for fault in run_faults(scene, workers=14)] == ["memory"]


@pytest.mark.usefixtures("machine")
def test_more_workers_than_the_memory_holds_settle_nothing(scene_data, write_scene, capsys):
    path = write_scene({**scene_data, "output": {**scene_data["output"], "layouts": 20}})
    assert run("settle", path, "--workers", 100_000) == 3
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"mitsplat: {path}: workers must be at most 16, because each takes at least 0.5 GiB of memory (8.0 GiB are "
        "unused; got 100000); use fewer workers"
    )


@pytest.mark.usefixtures("machine")
def test_at_most_one_worker_per_image_needs_memory(scene_data, write_scene):
    scene_data["output"] |= {"layouts": 20, "views": 1, "width": 640, "height": 360}
    assert list(run_faults(load_scene(write_scene(scene_data)), range(12), workers=100_000)) == []


def test_the_cost_of_checks_does_not_grow_with_layouts(scene_data, write_scene, monkeypatch):
    planned = []
    for module in (prospects, warnings_module):
        monkeypatch.setattr(
            module, "plan_frame", lambda scene, index: planned.append(index) or plan_frame(scene, index)
        )
    scene_data["output"]["layouts"] = 100_000
    scene = load_scene(write_scene(scene_data))
    assert list(run_faults(scene)) == []
    assert all(finding.ok for finding in scene_warnings(scene))
    assert len(planned) <= 2 * prospects.VIEWS + 1  # and the second frame, which is compared with the first


def test_points_inside_agrees_with_rings_and_open_boxes():
    """Points in the ring are inside and points in its hole are outside, for both face windings.

    For an open box, most of its volume is inside.
    """
    ring = trimesh.creation.annulus(r_min=0.5, r_max=1.0, height=0.4)
    points = np.array([[0, 0, 0], [0.75, 0, 0], [0, -0.75, 0.1], [0.75, 0, 0.3], [0.4, 0, 0.0], [5, 0, 0]])
    expected = [False, True, True, False, False, False]
    turn = pose_at((1, 2, 3), Rotation.from_rotvec((0.3, 1, -2)))
    for mesh in (ring, trimesh.Trimesh(ring.vertices, ring.faces[:, ::-1])):
        assert points_inside(mesh, points).tolist() == expected
        moved = points @ turn[:3, :3].T + turn[:3, 3]
        assert points_inside(mesh.copy().apply_transform(turn), moved).tolist() == expected


def test_visibility_of_boxes_agrees_with_many_points():
    """Visibility equals that of many points sampled in randomly placed boxes, for lenses of all fields of view."""
    rng, cases = np.random.default_rng(4), []
    for _ in range(200):
        eye, target = rng.normal(size=(2, 3))
        size = 10 ** rng.uniform(-1, 0.5, 3)
        low = rng.normal(size=3) - size / 2
        near = rng.uniform(0.01, 1)
        camera = Camera.look_at(eye, target, width=200, height=150, fov_x=rng.uniform(5, 120), near=near)
        pixels, depth = camera.project(low + rng.uniform(size=(20000, 3)) * size)
        with np.errstate(invalid="ignore"):
            in_image, nearby = (
                ((pixels > -margin) & (pixels < np.add((200, 150), margin))).all(axis=1) & (depth > near)
                for margin in (0, 20)
            )
        if in_image.mean() > 0.002 or not nearby.any():
            cases.append(bool(in_image.any()))
            assert sees(camera, low, low + size) == cases[-1]
    assert 40 < sum(cases) < len(cases) - 40


@pytest.mark.parametrize("tolerance", ["-1", "nan"])
def test_a_tolerance_is_refused_before_anything_is_rendered(
    tolerance, scene_data, write_scene, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(chart, "_run_job", lambda *args: pytest.fail("rendered"))
    path = write_scene(scene_data)
    assert run("render", path, f"--tolerance={tolerance}", "-o", tmp_path / "out") == 2
    assert run("chart", path, f"--tolerance={tolerance}", "-o", tmp_path / "chart.png") == 2
    assert capsys.readouterr().err.count(f"tolerance must be at least 0 (got {float(tolerance)})") == 2


def test_a_dataset_without_labels_ends_with_status_4(scene_data, write_scene, tmp_path, monkeypatch, capsys):
    """The message states the cause. Scenes without objects to label end with status 0.

    Single shards end with status 0 too, because the other shards may have labels.
    """
    laid_out = settle

    def away(scene, index, *, layout):
        frame = render(scene, index, layout=layout)
        nothing = np.zeros_like(frame.instance)
        dropped = {**frame.labels.dropped, "outside": len(layout.instances)}
        layers = replace(frame.layers, instance=nothing, proxy_instance=nothing)
        return replace(frame, layers=layers, labels=replace(frame.labels, instances=(), dropped=dropped))

    def write(scene, out, **options):
        return write_dataset(scene, out, **options, render=away, settle=laid_out)

    monkeypatch.setattr(dataset, "write_dataset", write)
    path = write_scene(scene_data)
    assert run("render", path, "-o", tmp_path / "out", "--workers", 1) == 4
    told = capsys.readouterr()
    assert "0 labelled instances" in told.out
    assert "no image has a label (not labelled: " in told.err
    assert "outside)" in told.err
    assert run("render", path, "-o", tmp_path / "part", "--workers", 1, "--shard", "1/2") == 0
    laid_out = lambda scene, index, **_: Layout(index, (), NO_PHYSICS)  # noqa: E731
    assert run("render", path, "-o", tmp_path / "empty", "--workers", 1) == 0


@pytest.mark.parametrize(("changes", "is_repeated"), [({}, True), ({"jitter": 0.001}, False)])
def test_equal_views_of_a_layout_are_reported(scene_data, write_scene, changes: dict, is_repeated: bool) -> None:
    camera = {"kind": "fixed", "eye": [0, -0.3, 0.6], "target": [0, 0, 0], **changes}
    scene_data["output"] |= {"views": 2}
    found = [one.text for one in scene_warnings(load_scene(write_scene(scene_data | {"camera": camera})))]
    assert any("differ in noise alone" in text for text in found) is is_repeated
