"""OBJ, STL, PLY and COLLADA: named files, units, distant positions and inverted bodies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from mitsplat.bake.mesh_parts import read_model
from mitsplat.errors import InputError
from mitsplat.images.colour import decode_srgb
from mitsplat.mesh_files.mesh_reading import read_mesh_file
from tests.mesh_files.glb import sheet

COLOUR = (200, 120, 40)
UTM = np.array([512345.0, 5401234.0, 310.0])


pytestmark = pytest.mark.usefixtures("without_trial")


def write_obj(path: Path, mtl: str, *, centre: np.ndarray | float = 0.0) -> Path:
    """Write a box of 60 mm that names a material file."""
    box = trimesh.creation.box((0.06, 0.06, 0.06))
    rows = [f"mtllib {mtl}", *("v {:.6f} {:.6f} {:.6f}".format(*corner) for corner in box.vertices + centre)]
    rows += ["vt 0.1 0.1", "vt 0.9 0.1", "vt 0.5 0.9", "usemtl paint"]
    path.write_text("\n".join([*rows, *(f"f {a + 1}/1 {b + 1}/2 {c + 1}/3" for a, b, c in box.faces)]))
    return path


@pytest.mark.parametrize(
    ("library", "texture", "stored"),
    [
        ("box.mtl", "textures\\wood.png", "textures/wood.png"),
        ("box.mtl", "my textures\\light wood.png", "my textures/light wood.png"),
        ("box.mtl", "Textures\\WOOD.PNG", "textures/wood.png"),
        ("box.mtl", '"light wood.png"', "light wood.png"),
        ("box.mtl", "C:\\Users\\me\\wood.png", "wood.png"),
        ("BOX.MTL", "./wood.png", "wood.png"),
        ("mats\\my box.mtl", "..\\wood.png", "wood.png"),
        ("mats\\box.mtl", "wood.png", "mats/wood.png"),
    ],
)
def test_paths_of_windows_are_found(tmp_path: Path, library: str, texture: str, stored: str) -> None:
    for folder in ("textures", "my textures", "mats"):
        (tmp_path / folder).mkdir()
    Image.new("RGB", (8, 8), COLOUR).save(tmp_path / stored)
    (tmp_path / library.replace("\\", "/").replace("BOX.MTL", "box.mtl")).write_text(
        f"newmtl paint\nmap_Kd {texture}\n"
    )
    (part,) = read_model(write_obj(tmp_path / "box.obj", library)).parts
    shown = part.colours_at(np.arange(12), np.full((12, 3), 1 / 3))
    np.testing.assert_allclose(shown, [decode_srgb(np.array(COLOUR) / 255)] * 12, atol=1e-6)


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_textures_are_read_up_to_the_limit_of_pixels(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow warns above its limit, which is an error in tests, and refuses twice as many pixels."""
    path = tmp_path / f"box.{kind}"
    if kind == "glb":
        glb = sheet()
        glb.document["images"] = [{"uri": "wood.png"}]
        glb.save(path)
    else:
        (tmp_path / "box.mtl").write_text("newmtl paint\nmap_Kd wood.png\n")
        write_obj(path, "box.mtl")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 48)
    Image.new("RGB", (8, 8)).save(tmp_path / "wood.png")
    texture = read_mesh_file(path).parts[0].material.texture
    assert texture is not None and texture.pixels.shape == (8, 8, 3)
    Image.new("RGB", (10, 10)).save(tmp_path / "wood.png")
    with pytest.raises(InputError, match=r"wood\.png cannot be read \(it must have at most 96 pixels, got 100\);"):
        read_mesh_file(path)


@pytest.mark.parametrize("texture", ["..\\secret.png", "..\\IN\\..\\SECRET.PNG", "none\\wood.png"])
def test_paths_of_windows_stay_in_the_folder(tmp_path: Path, texture: str) -> None:
    (tmp_path / "in").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "secret.png")
    (tmp_path / "in/box.mtl").write_text(f"newmtl paint\nmap_Kd {texture}\n")
    with pytest.raises(InputError, match=r"box\.mtl: its texture .* is (outside of its folder|missing); put it there"):
        read_model(write_obj(tmp_path / "in/box.obj", "box.mtl"))


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_a_mesh_far_from_its_origin_is_moved_there_exactly(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"box.{kind}"
    if kind == "obj":
        (tmp_path / "box.mtl").write_text("newmtl paint\nKd 1 1 1\n")
        write_obj(path, "box.mtl", centre=UTM)
    else:
        write_double_ply(path, UTM)
    model = read_model(path)
    np.testing.assert_allclose(model.parts[0].mesh.bounds, [[-0.03] * 3, [0.03] * 3], atol=1e-7)
    (warning,) = model.warnings
    assert "5.401e+06 m from the origin of its file: its centre (512345, 5401234, 310) m becomes the origin" in warning


def write_double_ply(path: Path, centre: np.ndarray) -> None:
    box = trimesh.creation.box((0.06, 0.06, 0.06))
    header = ["ply", "format ascii 1.0", "element vertex 8", *(f"property double {axis}" for axis in "xyz")]
    header += ["element face 12", "property list uchar int vertex_indices", "end_header"]
    rows = ["{:.6f} {:.6f} {:.6f}".format(*corner) for corner in box.vertices + centre]
    path.write_text("\n".join([*header, *rows, *("3 {} {} {}".format(*face) for face in box.faces), ""]))


def test_positions_that_are_stored_too_coarsely_are_refused(tmp_path: Path) -> None:
    """A binary STL holds 32-bit numbers, whose steps at 5,400 km are 0.5 m."""
    box = trimesh.creation.box((3.0, 3.0, 3.0)).apply_translation(UTM)
    box.export(tmp_path / "box.stl")
    with pytest.raises(InputError, match=r"box\.stl: positions must be within 8389 times .* 32-bit numbers .got steps"):
        read_model(tmp_path / "box.stl")


def test_a_mesh_near_its_origin_stays_in_its_place(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.06, 0.06, 0.06)).apply_translation((5.0, 0, 0))
    model = read_model(box)
    assert model.parts[0].mesh.bounds[0, 0] == pytest.approx(4.97)
    assert model.warnings == ()


def test_one_inverted_body_among_several_is_reported(tmp_path: Path) -> None:
    """A cavity is inverted by right, and lies in the solid around it."""
    first, second = (trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation((0.05 * k, 0, 0)) for k in range(2))
    hole = trimesh.creation.box((0.01, 0.01, 0.01))
    hole.invert()
    assert read_model(trimesh.util.concatenate([first, hole, second])).warnings == ()
    second.invert()
    for mesh in (trimesh.util.concatenate([first, hole, second]), trimesh.Scene({"a": first, "b": second})):
        (warning,) = read_model(mesh).warnings
        assert "a closed body of 20 x 20 x 20 mm" in warning
        assert "is inside out" in warning


def collada(asset: str) -> str:
    """Build a COLLADA file of a tetrahedron with a height of 1 unit along z and mirrored colours."""
    floats = "0 0 0 1 0 0 0 2 0 0 0 3"
    return (
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        f"<asset><contributor/>{asset}</asset>"
        '<library_geometries><geometry id="g"><asset><unit meter="77"/></asset><mesh><source id="p">'
        f'<float_array id="pa" count="12">{floats}</float_array><technique_common>'
        '<accessor source="#pa" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>'
        '<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v">'
        '<input semantic="POSITION" source="#p"/></vertices><triangles count="4"><input semantic="VERTEX" source="#v" '
        'offset="0"/><p>0 2 1 0 1 3 1 2 3 0 3 2</p></triangles></mesh></geometry></library_geometries>'
        '<library_visual_scenes><visual_scene id="s"><node><scale>-1 1 1</scale><instance_geometry url="#g"/></node>'
        '</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


@pytest.mark.parametrize(
    ("instance", "lost"),
    [
        ('<instance_geometry url="#other"/>', "Geometry #other not found"),
        (
            '<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="a" '
            'target="#paint"/></technique_common></bind_material></instance_geometry>',
            "Material #paint not found",
        ),
        ('<instance_camera url="#eye"/>', ""),
    ],
)
def test_collada_nodes_that_are_lost_are_refused(tmp_path: Path, instance: str, lost: str) -> None:
    """pycollada leaves out a node of a missing geometry or material, and the rest would be baked without it."""
    pytest.importorskip("collada", reason="needs pycollada, which reads COLLADA")
    text = collada("").replace("</visual_scene>", f"<node>{instance}</node></visual_scene>")
    (tmp_path / "a.dae").write_text(text)
    if not lost:
        assert len(read_model(tmp_path / "a.dae").parts) == 1
        return
    with pytest.raises(InputError, match=f"one of its nodes cannot be read .*{lost}"):
        read_model(tmp_path / "a.dae")


@pytest.mark.parametrize(
    ("element", "sentence"),
    [
        ("element chunk 1\nproperty float min_x\n", "mitsplat import"),
        ("element tristrips 1\nproperty list int int vertex_indices\n", "strips of triangles"),
        ("", "points only"),
    ],
)
def test_ply_files_without_faces_are_named(tmp_path: Path, element: str, sentence: str) -> None:
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\n{element}element vertex 1\nend_header\n0\n")
    with pytest.raises(InputError, match=sentence):
        read_model(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("asset", "units", "up", "extents"),
    [
        ('<unit meter="0.0254"/><up_axis>Z_UP</up_axis>', 0.0254, "z", (1, 2, 3)),
        ('<unit meter="0.01"/><up_axis>Y_UP</up_axis>', 0.01, "y", (1, 3, 2)),
        ("<up_axis>X_UP</up_axis>", 1.0, "x", (3, 2, 1)),
        ("", 1.0, "y", (1, 3, 2)),
    ],
)
def test_units_and_up_axis_of_collada_are_used(
    tmp_path: Path, asset: str, units: float, up: str, extents: tuple
) -> None:
    pytest.importorskip("collada", reason="needs pycollada, which reads COLLADA")
    (tmp_path / "a.dae").write_text(collada(asset))
    model = read_model(tmp_path / "a.dae")
    assert (model.units, model.up, model.stated) == (units, up, ("units", "up"))
    np.testing.assert_allclose(model.parts[0].mesh.extents, units * np.array(extents))
    assert model.parts[0].mesh.volume == pytest.approx(units**3)
    assert read_model(tmp_path / "a.dae", metres_per_unit=0.5, up="z").units == 0.5


@pytest.mark.parametrize("meter", ["0", "-1", "nan", "1,5"])
def test_a_collada_unit_that_is_no_length_is_refused(tmp_path: Path, meter: str) -> None:
    pytest.importorskip("collada", reason="needs pycollada, which reads COLLADA")
    (tmp_path / "a.dae").write_text(collada(f'<unit meter="{meter}"/>'))
    with pytest.raises(InputError, match=rf"meter of its unit must be a number above 0 \(got {meter}\)"):
        read_model(tmp_path / "a.dae")


def test_a_truncated_stl_is_refused_with_its_likely_cause(tmp_path: Path) -> None:
    content = trimesh.creation.box((0.06, 0.06, 0.06)).export(file_type="stl")
    (tmp_path / "a.stl").write_bytes(content[:-100])
    with pytest.raises(InputError, match=r"a\.stl: a mesh needs at least one face \(got none; is the file complete\?"):
        read_model(tmp_path / "a.stl")


@pytest.mark.parametrize("is_coloured", [False, True])
def test_colours_of_stl_files_are_reported(tmp_path: Path, is_coloured: bool) -> None:
    """The two bytes after each face hold its colour in different ways (VisCAM, Magics)."""
    stored = bytearray(trimesh.exchange.stl.export_stl(trimesh.creation.box((1, 2, 3))))
    stored[84 + 48 : 84 + 50] = b"\xff\x7f" if is_coloured else b"\0\0"
    (tmp_path / "box.stl").write_bytes(stored)
    warnings = read_model(tmp_path / "box.stl").warnings
    assert [warning.partition(" are not read")[0] for warning in warnings] == is_coloured * ["the colours of its faces"]
