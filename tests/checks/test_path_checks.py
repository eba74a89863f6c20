"""Preflight checks: a valid asset and scene pass; each inserted fault is found and comes with a remedy."""

import json
import re
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from ruamel.yaml import YAML

from mitsplat.asset import Asset
from mitsplat.checks.path_checks import _SCENE_KEYS, SIZE_LIMITS, _located, _mass, check_asset, check_path, check_scene
from mitsplat.checks.scene_warnings import scene_warnings
from mitsplat.errors import InputError
from mitsplat.findings import Finding
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.physics.settle import settle_layout
from mitsplat.scene.loading.scene_loading import load_scene
from tests.cli.typed import run
from tests.conftest import box_asset


def solid(count=2000, size=(0.06, 0.04, 0.05)):
    """Build a box with Gaussians all over its surface."""
    mesh = trimesh.creation.box(size)
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=1)
    splats = Splats(
        means=points,
        quats=np.tile([0.0, 0, 0, 1], (count, 1)),
        scales=np.full((count, 3), 0.035 * max(size)),
        opacities=np.full(count, 0.9),
        sh=np.zeros((count, 1, 3)),
    )
    return Asset("box", "box", splats, mesh, (mesh,))


def wrong(findings):
    return {finding.name: finding for finding in findings if not finding.ok}


def test_a_sound_asset_passes_every_check():
    assert wrong(check_asset(solid())) == {}
    surroundings = replace(
        solid(size=(2, 3, 0.5)), kind="environment", splats=solid(size=(2, 3, 0.5)).splats, pieces=()
    )
    assert wrong(check_asset(surroundings)) == {}


def test_named_points_on_in_and_near_an_object_are_no_problem():
    points = {"tip": (0, 0, 0.025), "grip": (0, 0, 0), "hand": (0, 0, 0.07)}
    assert wrong(check_asset(replace(solid(), keypoints=points))) == {}
    assert wrong(check_asset(replace(solid(), keypoints={"middle": (0, 0, 0)}))) == {}
    approach = {"grip": (0, 0, 0.02), "before": (0, 0, 0.4)}
    assert wrong(check_asset(replace(solid(), keypoints=approach))) == {}
    for shift in (0.0, 0.025):  # pins of a plug, at the origin of its files or not
        pins = {"left": (shift, -0.0002, 0), "right": (shift, 0.0002, 0)}
        assert wrong(check_asset(replace(solid(), keypoints=pins))) == {}


def test_named_points_in_another_unit_are_named_with_the_line_to_change(tmp_path):
    replace(solid(), keypoints={"tip": (0.0, 0.0, 0.02), "grip": (0.0, 0.01, 0.0)}).save(
        tmp_path / "box", splats="a.spz"
    )
    described = tmp_path / "box/asset.yaml"
    assert wrong(check_path(tmp_path / "box")) == {}
    described.write_text(re.sub(r"\b(10|20)\.0", lambda found: str(float(found[0]) / 1000), described.read_text()))
    (problem,) = wrong(check_path(tmp_path / "box")).values()
    assert problem.text == "all 2 lie within 0.02 mm of the origin, but the object measures 0.06 m"
    assert re.fullmatch(r".*asset\.yaml:\d+: keypoints", str(problem.place))


def changed(splats, rows, **values):
    arrays = {name: np.array(getattr(splats, name)) for name in ("means", "quats", "scales", "opacities", "sh")}
    for name, value in values.items():
        arrays[name][:rows] = value
    return Splats(**arrays)


GOOD = solid()
OPEN = trimesh.Trimesh(GOOD.mesh.vertices, GOOD.mesh.faces[1:], process=False)
FAULTS = {
    "units": (
        GOOD.transformed(np.diag([1000, 1000, 1000, 1])),
        "are units (1 by default) or size in asset.yaml 1000 times too large?",
    ),
    " units": (GOOD.transformed(np.diag([0.001, 0.001, 0.001, 1])), "or size in asset.yaml 1000 times too small?"),
    "units ": (replace(GOOD, units="unknown"), "give it as size"),
    "up axis": (replace(solid(size=(2, 0.3, 3)), kind="environment"), "set up: y"),
    "needles": (replace(GOOD, splats=changed(GOOD.splats, 60, scales=(0.02, 0.001, 0.001))), "mitsplat mesh"),
    "floaters": (replace(GOOD, splats=changed(GOOD.splats, 30, means=GOOD.splats.means[:30] * 9)), "mitsplat mesh"),
    "opacity": (replace(GOOD, splats=changed(GOOD.splats, 900, opacities=1e-3)), "prune"),
    "spherical harmonics": (
        replace(GOOD, splats=replace(GOOD.splats, sh=np.zeros((2000, 4, 3)))),
        "store degree 0",
    ),
    "splats": (replace(GOOD, splats=changed(GOOD.splats, 2000, opacities=0.1)), "again"),
    "overlap": (replace(GOOD, mesh=GOOD.mesh.copy().apply_translation((0.03, 0, 0))), "register"),
    "offset": (replace(GOOD, mesh=GOOD.mesh.copy().apply_translation((0.005, 0, 0))), "register"),
    "watertightness": (replace(GOOD, mesh=OPEN), "close it"),
    "mass": (replace(GOOD, mass=50.0), "density"),
    "keypoints": (replace(GOOD, keypoints={"tip": (0, 0, 2e-5), "grip": (0, 0, -2e-5)}), "units of the asset's files"),
    "keypoints ": (replace(GOOD, keypoints={"tip": (0, 0, 25.0)}), "units of the asset's files"),
    "colliders": (replace(GOOD, pieces=(GOOD.mesh.slice_plane((0, 0, 0), (1, 0, 0), cap=True),)), "remove pieces"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_planted_fault_of_an_asset_is_found_with_its_remedy(name):
    asset, remedy = FAULTS[name]
    found = wrong(check_asset(asset))
    assert remedy in found[name.strip()].remedy
    assert set(found) <= {name.strip(), "offset", "overlap", "colliders"}  # a displaced mesh causes all three


def test_a_mesh_without_a_volume_has_no_mass() -> None:
    """The density of a mesh whose vertices have collapsed to one point would be infinite."""
    mesh = trimesh.Trimesh(np.tile(GOOD.mesh.vertices[:1], (8, 1)), trimesh.creation.box().faces, process=False)
    (finding,) = _mass(replace(GOOD, mesh=mesh, pieces=(mesh,)), mesh)
    assert not finding.ok
    assert finding.text == "its mesh spans no volume"


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("room", lambda data: data["objects"][0].update(count=[900, 9000])),
        ("support", lambda data: data.update(shapes=[], enclosure={"floor": -0.1})),
        ("visibility", lambda data: data["camera"].update(target=[0, 0, 5], height=0.1, radius=0.2)),
        ("light", lambda data: data.update(lights=[])),
        ("exposure", lambda data: data.update(composite={"exposure": {"ev": 18}})),
        pytest.param(
            "exposure",
            lambda data: data.update(composite={"exposure": {"ev": -8}}),
            marks=pytest.mark.extended,
        ),
    ],
)
def test_each_planted_fault_of_a_scene_is_found_with_its_remedy(scene_data, write_scene, name, change):
    good = wrong(check_scene(load_scene(write_scene(scene_data))))
    assert name not in good
    change(scene_data)
    found = wrong(check_scene(load_scene(write_scene(scene_data))))
    assert set(found) - set(good) == {name}
    assert found[name].remedy


def test_assets_of_the_same_name_are_checked_separately(tmp_path):
    bad = replace(GOOD, splats=changed(GOOD.splats, 900, opacities=1e-3))
    bad.save(tmp_path / "bad")
    GOOD.save(tmp_path / "good")
    data = {
        "name": "both",
        "objects": [{"asset": "bad"}, {"asset": "good"}],
        "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, 0.2]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
    }
    YAML(typ="safe", pure=True).dump(data, tmp_path / "scene.yaml")
    assert "box: opacity" in wrong(check_scene(load_scene(tmp_path / "scene.yaml")))


def test_an_asset_of_several_sizes_is_listed_once(scene_data, write_scene, monkeypatch):
    """A fault of one size is reported. The asset is then not also listed with "no problems"."""
    monkeypatch.setitem(SIZE_LIMITS, "object", (0.016, 2.0))
    scene_data["objects"] = [{"asset": f"assets/{name}", "scale": [0.5, 1]} for name in ("nut", "bolt")]
    findings = [(finding.name, finding.text) for finding in check_scene(load_scene(write_scene(scene_data)))]
    assert [(name, text) for name, text in findings if name.startswith(("nut", "bolt"))] == [
        ("nut: units", "the longest extent is 0.015 m"),
        ("bolt", "12 Gaussians, no problems"),
    ]


NARROW = {"min": [-0.2, -0.02, 0.02], "max": [0.2, 0.02, 0.3]}


@pytest.mark.parametrize(
    ("change", "crowded"),
    [
        # A row of 0.4 m has no room for 20 nuts of at least 20 mm at distances of at least 2 mm.
        ({"region": NARROW, "settle": {"arrangement": "packed"}}, "20 objects in main, packed"),
        ({"region": NARROW, "settle": {"arrangement": "pile"}}, ""),
        ({"region": NARROW, "settle": {"arrangement": "packed", "incomplete": 1}}, ""),  # the run leaves some out
        (  # it never leaves out more than half
            {
                "region": NARROW,
                "settle": {"arrangement": "packed", "incomplete": 1},
                "objects": [{"asset": "assets/nut", "count": 40}],
            },
            "40 objects in main, packed",
        ),
        (
            {
                "regions": [{"name": "shelf", **NARROW, "arrangement": "packed"}],
                "objects": [{"asset": "assets/nut", "count": 20, "region": "shelf"}, {"asset": "assets/bolt"}],
            },
            "20 objects in shelf, packed",
        ),
        (  # a post, whose place is drawn for each layout, stands in the row
            {
                "region": NARROW,
                "settle": {"arrangement": "packed"},
                "objects": [{"asset": "assets/nut", "count": 10}],
                "shapes": [
                    {"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}},
                    {"name": "post", "box": {"size": [0.04, 0.04, 0.8]}, "jitter": 0.001},
                ],
            },
            "10 objects in main, packed",
        ),
    ],
)
def test_a_region_that_is_too_small_for_an_arrangement_is_named(scene_data, write_scene, change, crowded):
    """Objects that stand side by side need floor area, which the volume of the region does not show."""
    scene_data |= {"objects": [{"asset": "assets/nut", "count": 20}], **change}
    scene = load_scene(write_scene(scene_data))
    (room,) = (finding for finding in check_scene(scene) if finding.name == "room")
    assert room.ok == (not crowded)
    if crowded:
        key = "regions[0]" if "shelf" in crowded else "region"
        assert room.text == f"{key} has no room for all objects of layout 0 at the start: {crowded}"
        line = _located(room, scene.path, _SCENE_KEYS).place
        assert line.endswith(f": {key}") and int(line.split(":")[-2]) > 1
        with suppress(InputError):  # more than half of them have no room
            reasons = {one.reason for one in settle_layout(scene, 0, cached=False).left_out}
            assert reasons == {"no room for all in 1 of 1 draws"}


def test_an_object_that_cannot_fit_is_refused(scene_data, write_scene, capsys):
    scene_data["region"] = {"min": [-0.005, -0.005, 0], "max": [0.005, 0.005, 0.2]}
    assert run("check", write_scene(scene_data)) == 2
    assert "must fit into the region" in capsys.readouterr().err


def test_the_check_command_prints_findings_and_sets_its_status(tmp_path, capsys):
    GOOD.save(tmp_path / "good")
    assert run("check", tmp_path / "good") == 0
    assert "ok    mass: 0.12 kg, of 1000 kg/m^3" in capsys.readouterr().out
    replace(GOOD, mesh=OPEN).save(tmp_path / "open")
    assert run("check", tmp_path / "open") == 1
    lines = capsys.readouterr().out.splitlines()
    assert "      to do: close it" in lines[lines.index("look  watertightness: open") + 1]


def test_problems_have_the_file_and_line_of_the_key_to_change(scene_data, write_scene, capsys):
    scene_data["shapes"].append({"name": "tray", "bin": {"size": [0.2, 0.2, 0.05], "position": [3, 0, 0]}})
    path = write_scene(scene_data)

    def place_of(file, text, key):
        line = next(i for i, line in enumerate(file.read_text().splitlines(), 1) if text in line)
        return f"{file}:{line}: {key}"

    (found,) = (_located(finding, path, _SCENE_KEYS) for finding in scene_warnings(load_scene(path)) if not finding.ok)
    assert found.place == place_of(path, "bin:", "shapes[1]")
    by_name = _located(Finding("exposure", False, "surfaces are black", "more light"), path, _SCENE_KEYS)
    assert by_name.place == place_of(path, "lights:", "lights")
    asset = path.parent / "assets/nut/asset.yaml"
    asset.write_text(asset.read_text().replace("density: 1000.0", "mass: 900"))
    assert run("check", asset.parent) == 1
    out = capsys.readouterr().out.splitlines()
    wrong = next(i for i, line in enumerate(out) if line.startswith("look  mass"))
    assert out[wrong + 2] == f"      in {place_of(asset, 'mass: 900', 'mass')}"


def test_an_open_mesh_has_the_mass_of_its_pieces():
    half = GOOD.mesh.copy().apply_transform(np.diag([0.5, 1, 1, 1]))
    for pieces, text in (
        ((half,), "0.06 kg, of 1000 kg/m^3"),
        ((), "0.12 kg, of 1000 kg/m^3 if it fills its convex hull; its convex pieces are not computed yet"),
    ):
        found = {finding.name: finding for finding in check_asset(replace(GOOD, mesh=OPEN, pieces=pieces))}
        assert found["mass"].text == text


def test_an_unreadable_asset_is_refused_in_one_sentence(tmp_path, capsys):
    box_asset("nut").save(tmp_path / "nut")
    splats = tmp_path / "nut/splats.ply"
    splats.write_bytes(splats.read_bytes()[:-4] + np.float32(np.nan).tobytes())
    assert run("check", tmp_path / "nut") == 2
    assert "quats must be finite (got nan at row 11)" in capsys.readouterr().err


MAT = {"name": "mat", "box": {"size": [0.3, 0.2, 0.02], "position": [0.1, 0, -0.01]}, "visible": True}


@pytest.mark.parametrize(
    ("change", "is_found"),
    [
        ({"colour": [0.9, 0.1, 0.1]}, True),
        ({"materials": [{"kind": "noise"}]}, True),
        ({}, False),  # of the colour of the table
        ({"colour": [0.9, 0.1, 0.1], "visible": False}, False),
        ({"colour": [0.9, 0.1, 0.1], "box": {"size": [0.3, 0.2, 0.02], "position": [0.1, 0, -0.009]}}, False),
    ],
)
def test_visible_shapes_in_one_plane_are_named(scene_data, write_scene, change, is_found):
    scene_data["shapes"].append(MAT | change)
    found = [one.text for one in check_scene(load_scene(write_scene(scene_data))) if one.name == "surfaces"]
    assert bool(found) == is_found
    if is_found:
        assert found[0].startswith("shapes 'table' and 'mat' have faces in one plane, for example at [")
        x, y, z = json.loads(found[0].partition(" at ")[2])
        assert -0.05 <= x <= 0.25 and -0.1 <= y <= 0.1 and abs(z) < 1e-5


def test_walls_of_a_backdrop_share_planes_without_a_warning(scene_data, write_scene):
    scene_data["backdrop"] = {"size": [3, 3, 2], "position": [0, 0, -0.1]}
    assert not [one for one in check_scene(load_scene(write_scene(scene_data))) if one.name == "surfaces"]
