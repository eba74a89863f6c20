"""Shapes from mesh files: units and vertical axis that the file states, and the keys that replace them."""

from __future__ import annotations

import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from mitsplat.errors import InputError
from mitsplat.scene.loading.references import shape_mesh
from mitsplat.scene.spec.shape_spec import Shape

SIZE = (0.1, 0.5, 0.04)
"""Extents of a post along x, y and z of its file [units]."""
UP_Y = (0.1, 0.04, 0.5)
UP_X = (0.04, 0.5, 0.1)


def write_post(path: Path, scale: float = 1.0) -> None:
    """Write a post that stands on its lower side: its lowest point along y is at 0."""
    post = trimesh.creation.box(np.multiply(SIZE, scale))
    post.apply_translation((0, scale * SIZE[1] / 2, 0))
    if path.suffix == ".3mf":
        write_3mf(path, post)
    elif path.suffix == ".dae":
        write_dae(path, post)
    else:
        post.export(path)


def write_3mf(path: Path, mesh: trimesh.Trimesh) -> None:
    core = "http://schemas.microsoft.com/3dmanufacturing"
    corners = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in mesh.vertices)
    faces = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in mesh.faces)
    model = (
        f'<model unit="millimeter" xmlns="{core}/core/2015/02"><resources><object id="1" type="model"><mesh><vertices>'
        f"{corners}</vertices><triangles>{faces}</triangles></mesh></object></resources>"
        '<build><item objectid="1"/></build></model>'
    )
    relations = "http://schemas.openxmlformats.org/package/2006/relationships"
    part = f'<Relationship Target="/3D/3dmodel.model" Id="r" Type="{core}/2013/01/3dmodel"/>'
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("_rels/.rels", f'<Relationships xmlns="{relations}">{part}</Relationships>')
        archive.writestr("3D/3dmodel.model", model)


def write_dae(path: Path, mesh: trimesh.Trimesh) -> None:
    values = " ".join(f"{value:.9g}" for value in mesh.vertices.ravel())
    corners = " ".join(map(str, mesh.faces.ravel()))
    path.write_text(
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>'
        "<created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>"
        '<unit name="centimeter" meter="0.01"/><up_axis>X_UP</up_axis></asset><library_geometries><geometry id="g">'
        f'<mesh><source id="p"><float_array id="pa" count="{mesh.vertices.size}">{values}</float_array>'
        f'<technique_common><accessor source="#pa" count="{len(mesh.vertices)}" stride="3">'
        '<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor>'
        '</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
        f'<triangles count="{len(mesh.faces)}"><input semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p>'
        '</triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">'
        '<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


@pytest.mark.parametrize(
    ("name", "scale", "keys", "expected"),
    [
        ("a.glb", 1, {}, UP_Y),
        ("a.glb", 1, {"up": "z"}, SIZE),
        ("a.glb", 1000, {"units": 0.001}, UP_Y),
        ("a.glb", 100, {"units": 0.01, "up": "x"}, UP_X),
        ("a.3mf", 1000, {}, SIZE),
        ("a.3mf", 1, {"units": 1.0, "up": "y"}, UP_Y),
        pytest.param(
            *("a.dae", 100, {}, UP_X),
            marks=pytest.mark.skipif(find_spec("collada") is None, reason="needs pycollada"),
        ),
        ("a.stl", 1, {}, SIZE),
        ("a.stl", 1000, {"units": 0.001, "up": "y"}, UP_Y),
        ("a.ply", 1, {"up": "y"}, UP_Y),
        ("a.obj", 1, {}, SIZE),
    ],
)
def test_shapes_have_the_units_and_the_axis_of_their_file(
    tmp_path: Path, name: str, scale: float, keys: dict[str, Any], expected: tuple[float, ...]
) -> None:
    """A post of a glTF file, whose y points up, lay on its side, and 3MF files in millimetres became metres."""
    write_post(tmp_path / name, scale)
    mesh = shape_mesh(Shape(name="post", mesh=name, **keys), tmp_path)
    np.testing.assert_allclose(mesh.extents, expected, rtol=1e-6)
    assert mesh.volume == pytest.approx(np.prod(SIZE), rel=1e-6)
    if expected == UP_Y:
        assert mesh.bounds[0][2] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("keys", [{"units": 0.001}, {"up": "y"}])
def test_units_and_axis_belong_to_meshes(scene_data: Any, write_scene: Any, keys: dict[str, Any]) -> None:
    from mitsplat.scene.loading.scene_loading import load_scene

    scene_data["shapes"] = [{"name": "a", "box": {"size": [1, 1, 1], "position": [0, 0, -1]}, **keys}]
    with pytest.raises(InputError, match=rf"shapes\[0\]\.{next(iter(keys))}: belongs to a mesh, which shape 'a' has"):
        load_scene(write_scene(scene_data))


def test_check_lists_the_sizes_of_meshes(scene_data: Any, write_scene: Any, tmp_path: Path) -> None:
    from mitsplat.checks.path_checks import _list_mesh_sizes
    from mitsplat.scene.loading.scene_loading import load_scene

    scene_data["shapes"].append({"name": "post", "mesh": "post.glb"})
    path = write_scene(scene_data)
    write_post(path.parent / "post.glb")
    (finding,) = _list_mesh_sizes(load_scene(path))
    assert finding.ok and finding.text == "post is 0.1 x 0.04 x 0.5 m"
