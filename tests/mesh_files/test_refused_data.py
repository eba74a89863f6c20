"""Data of PLY, STL, OBJ, COLLADA and 3MF files that would be read wrong: they are refused or named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsplat.bake.mesh_parts import read_model
from mitsplat.errors import InputError
from tests.mesh_files.test_spellings import COLOUR, FACES, FLOATS, POINTS, RED, dae, is_complete, obj, ply, shown, stl
from tests.mesh_files.test_threemf import tetrahedron, write

NAMES = ("red", "green", "blue")


pytestmark = pytest.mark.usefixtures("without_trial")


@pytest.mark.parametrize(("kind", "values"), [("ushort", "65535 32768 0"), ("char", "-1 64 0"), ("int", "0 0 256")])
@pytest.mark.parametrize("of_faces", [False, True])
def test_integer_colours_of_ply_beyond_eight_bits_are_refused(
    tmp_path: Path, kind: str, values: str, of_faces: bool
) -> None:
    """trimesh keeps their last eight bits."""
    columns = "".join(f"property {kind} {name}\n" for name in NAMES)
    faces = tuple(f"3 {a} {b} {c} {values}" for a, b, c in FACES)
    content = ply(faces=faces, face_columns=columns) if of_faces else ply(columns, values)
    (tmp_path / "a.ply").write_text(content)
    with pytest.raises(InputError, match=r"colours that are integers must be within 0 to 255 \(got -?\d+ to \d+\)"):
        read_model(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", ["ushort", "short", "int", "uint"])
def test_wide_integers_of_eight_bit_colours_of_ply_are_read(tmp_path: Path, kind: str) -> None:
    (tmp_path / "a.ply").write_text(ply("".join(f"property {kind} {name}\n" for name in NAMES), "200 100 50"))
    assert shown(read_model(tmp_path / "a.ply")) == list(COLOUR)


def test_colours_of_ply_with_other_names_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(ply("".join(f"property uchar ambient_{name}\n" for name in NAMES), "200 100 50"))
    (warning,) = read_model(tmp_path / "a.ply").warnings
    assert warning.startswith("its properties ambient_red, ambient_green, ambient_blue are left out")


def text_stl(name: str, offset: float, faces: int = 4, end: str = "endsolid\n") -> str:
    """Build a solid of a text STL file."""
    rows = [f"solid {name}"]
    for face in FACES[:faces]:
        corners = (f"vertex {x + offset} {y} {z}" for x, y, z in np.asarray(POINTS)[list(face)])
        rows += ["facet normal 0 0 0", " outer loop", *corners, " endloop", "endfacet"]
    return "\n".join([*rows, end])


@pytest.mark.parametrize("cut", [0, 30, 200])
def test_a_text_stl_whose_last_solid_is_cut_is_refused(tmp_path: Path, cut: int) -> None:
    """trimesh leaves out a solid without an end."""
    second = text_stl("b", 5, end="")
    (tmp_path / "a.stl").write_text(text_stl("a", 0) + second[: len(second) - cut])
    with pytest.raises(InputError, match=r"a\.stl: only 4 of its \d faces can be read \(is the file complete\?\)"):
        read_model(tmp_path / "a.stl")
    (tmp_path / "b.stl").write_text((text_stl("a", 0) + text_stl("facet", 5)).upper())
    assert len(read_model(tmp_path / "b.stl").parts) == 2


def test_a_binary_stl_with_facets_in_its_header_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(stl(header=b"4 facets of a tetrahedron"))
    assert is_complete(read_model(tmp_path / "a.stl"))


@pytest.mark.parametrize("more", [" 1 0.5 0 1", " 1 1 0.5 0", " 255 128 0 255", " 1 0.5"])
def test_vertices_of_obj_with_an_opacity_are_refused(tmp_path: Path, more: str) -> None:
    """Some programs write x y z w r g b, others x y z r g b a."""
    (tmp_path / "a.obj").write_text(obj(use="", vertex=f"v {{}} {{}} {{}}{more}").replace("mtllib a.mtl\n", ""))
    with pytest.raises(InputError, match=r"vertices must have 3 numbers, or 6 with red, green and blue \(got \d\)"):
        read_model(tmp_path / "a.obj")


def test_texture_coordinates_of_obj_with_one_number_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(obj(use="usemtl red\nvt 0.5", face="f {}/1 {}/1 {}/1"))
    (tmp_path / "a.mtl").write_text(RED + "map_Kd a.png\n")
    Image.new("RGB", (8, 8), (200, 0, 0)).save(tmp_path / "a.png")
    assert shown(read_model(tmp_path / "a.obj")) == [200, 0, 0]


@pytest.mark.parametrize("suffix", [".fbx", ".usdz", ".blend", ".dxf", ""])
def test_other_kinds_of_mesh_files_are_refused_with_a_remedy(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(b"x" * 100)
    with pytest.raises(InputError, match=r"must be a mesh \(.* export (it|meshes) as \.glb"):
        read_model(tmp_path / f"a{suffix}")


SURFACE = '<newparam sid="f"><surface type="2D"><init_from>image</init_from></surface></newparam>'
SAMPLER = '<newparam sid="s"><sampler2D><source>f</source>{}</sampler2D></newparam>'


def sampled(sampler: str, uv: str, bound: str | None = None) -> str:
    """Build a COLLADA file with a sampler, coordinates of a point, and a second set of coordinates if it is bound."""
    inputs, corner = '<input semantic="TEXCOORD" source="#uv" offset="1" set="0"/>', "{} 0"
    content = dae('<texture texture="s" texcoord="UV"/>', image="a.png", inputs=inputs, corner=corner)
    content = content.replace("<profile_COMMON>", "<profile_COMMON>" + SURFACE + SAMPLER.format(sampler))
    content = content.replace(">0.5 0.5<", f">{uv}<")
    if bound is None:
        return content
    axes = '<param name="S" type="float"/><param name="T" type="float"/>'
    more = inputs.replace("#uv", "#uv2").replace('set="0"', 'set="1"')
    bind = f'target="#m"><bind_vertex_input semantic="UV" input_semantic="TEXCOORD" input_set="{bound}"/>'
    content = content.replace(inputs, inputs + more)
    content = content.replace("<vertices", FLOATS.format("uv2", 2, "0.9 0.5", 1, 2, axes) + "<vertices")
    return content.replace('target="#m"/>', bind + "</instance_material>")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (sampled("<wrap_s>CLAMP</wrap_s>", "1.2 0.5"), r"continued by CLAMP outside of its image"),
        (sampled("<wrap_t>MIRROR</wrap_t>", "0.2 -0.5"), r"continued by MIRROR outside of its image"),
        (sampled("<wrap_t>CLAMP</wrap_t>", "1.2 0.5"), None),
        (sampled("<wrap_s>WRAP</wrap_s>", "1.2 0.5"), None),
        (sampled("", "1.2 0.5"), None),
        (sampled("", "0.2 0.5", "0"), None),
        (sampled("", "0.2 0.5", "1"), "has its coordinates in set 1"),
    ],
)
def test_textures_of_collada_that_trimesh_puts_elsewhere_are_refused(
    tmp_path: Path, content: str, sentence: str | None
) -> None:
    pytest.importorskip("collada", reason="needs pycollada, which reads COLLADA")
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4] = COLOUR  # the left half
    Image.fromarray(pixels).save(tmp_path / "a.png")
    (tmp_path / "a.dae").write_text(content)
    if sentence is None:
        assert shown(read_model(tmp_path / "a.dae")) == list(COLOUR)
    else:
        with pytest.raises(InputError, match=sentence):
            read_model(tmp_path / "a.dae")


def test_a_material_of_collada_that_is_not_bound_is_named(tmp_path: Path) -> None:
    pytest.importorskip("collada", reason="needs pycollada, which reads COLLADA")
    (tmp_path / "a.dae").write_text(dae("<color>1 0 0 1</color>").replace('symbol="s"', 'symbol="other"'))
    (warning,) = read_model(tmp_path / "a.dae").warnings
    assert warning == "its material symbol s has no material (instance_material): grey is used"


def test_items_of_3mf_that_are_not_printed_are_left_out(tmp_path: Path) -> None:
    """Slicers write these items for objects that are switched off or beside the bed."""
    items = '<item objectid="1"/><item objectid="1" printable="0" transform="1 0 0 0 1 0 0 0 1 50 0 0"/>'
    model = read_model(write(tmp_path / "a.3mf", tetrahedron(1), items))
    assert len(model.parts) == 1 and model.warnings == ("its items that are not printed are left out",)


def test_faces_of_stl_beyond_the_stated_number_are_refused(tmp_path: Path) -> None:
    """Bytes that are no faces, such as padding and notes of a program, are left out."""
    content = stl()
    (tmp_path / "a.stl").write_bytes(content[:80] + (3).to_bytes(4, "little") + content[84:])
    with pytest.raises(InputError, match="its header states 3 faces, but it has 4: export it again"):
        read_model(tmp_path / "a.stl")
    for more in (bytes(100), b"made by a scanner"):
        (tmp_path / "a.stl").write_bytes(content + more)
        assert is_complete(read_model(tmp_path / "a.stl"))


def test_faces_of_ply_without_a_list_of_vertices_are_refused_by_name(tmp_path: Path) -> None:
    rows = "".join(f"3 {' '.join(map(str, face))}\n" for face in FACES)
    points = "".join(f"{x} {y} {z}\n" for x, y, z in POINTS)
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 4\n{axes}element face 4\nproperty list uchar int vertexindices\n"
        f"end_header\n{points}{rows}"
    )
    with pytest.raises(InputError, match=r"must have a list vertex_indices \(got vertexindices\): rename it"):
        read_model(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        ("v 0 0 1e", r"a\.obj: line 6: vertices must be finite numbers \(got v 0 0 1e\)"),
        ("v 1,5 0 0", r"a\.obj: line 6: vertices must be finite numbers \(got v 1,5 0 0\)"),
        ("f 1 2 99", r"a\.obj: line 6: faces must name vertices from 1 to 4, the number in the file \(got f 1 2 99\)"),
        ("f 1/1 2/1 0/1", r"a\.obj: line 6: faces must name vertices from 1 to 4, .* \(got f 1/1 2/1 0/1\)"),
    ],
)
def test_wrong_numbers_of_obj_are_named_with_their_line(tmp_path: Path, row: str, sentence: str) -> None:
    rows = ["# a tetrahedron", *(f"v {x} {y} {z}" for x, y, z in POINTS), row]
    rows += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    (tmp_path / "a.obj").write_text("\n".join(rows))
    with pytest.raises(InputError, match=sentence):
        read_model(tmp_path / "a.obj")
