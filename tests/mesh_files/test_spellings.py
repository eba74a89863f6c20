"""OBJ, STL, PLY, OFF and COLLADA: unusual spellings of the same tetrahedron, and data that are named or refused."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals

from mitsplat.bake.mesh_parts import MeshModel, read_model
from mitsplat.errors import InputError
from mitsplat.images.colour import encode_srgb

POINTS = ((0, 0, 0), (2, 0, 0), (0, 3, 0), (0, 0, 4))
FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
VOLUME = 4.0
COLOUR = (200, 100, 50)


pytestmark = pytest.mark.usefixtures("without_trial")


def shown(model: MeshModel) -> list[int]:
    """Return the display-encoded colour of a model of one part at the middle of its last face."""
    (part,) = model.parts
    colour = part.colours_at(np.array([len(part.mesh.faces) - 1]), np.full((1, 3), 1 / 3))
    return [int(value) for value in np.rint(255 * encode_srgb(colour[0]))]


def is_complete(model: MeshModel) -> bool:
    return bool(np.isclose(sum(part.mesh.volume for part in model.parts), VOLUME))


def obj(vertex: str = "v {} {} {}", face: str = "f {} {} {}", use: str = "usemtl red") -> str:
    rows = ["# tetrahedron", "mtllib a.mtl", *(vertex.format(*point) for point in POINTS), use]
    return "\n".join([*rows, *(face.format(*(corner + 1 for corner in corners)) for corners in FACES), ""])


RED = "newmtl red\nKd 1 0 0\n"


@pytest.mark.parametrize(
    ("text", "library"),
    [
        (obj(face="  f {} {} {}"), RED),
        (obj(face="f\t{} {} {}"), RED),
        (obj().replace("f 1 2 4", "\tf 1 2 4"), RED),
        (obj(vertex="v\t{} {}\t{}"), RED),
        (obj().replace("v 2", " v 2"), RED),
        (obj(vertex="v {} {} {} # corner"), RED),
        (obj(face="f {} {} {} # face"), RED),
        (obj(vertex="v {} {} \\\n{}"), RED),
        (obj().replace("# tet", "# no mtllib b.mtl and no usemtl blue "), RED),
        (obj().replace("f 1 2 4", "# usemtl blue \nf 1 2 4"), RED),
        (obj().replace("\n", "\r"), RED.replace("\n", "\r")),
        ("\ufeff" + obj(), "\ufeff" + RED),
        (obj(), "newmtl red\n\tKd 1 0 0 # paint\n"),
        (obj(use="usemtl  dark   red\t"), "newmtl dark  red\nKd 1 0 0\n"),
        (obj(use="usemtl red#1"), "newmtl red#1\nKd 1 0 0\n"),
        (obj(), RED + "Ks 0\nKa 0.5\n"),
        (obj(), RED + "Tf 1 1 1\n"),  # written for opaque materials, as 0 0 0
        (obj(), RED + "Tf 0\n"),
    ],
)
def test_spellings_of_obj_give_the_same_mesh(tmp_path: Path, text: str, library: str) -> None:
    (tmp_path / "a.obj").write_bytes(text.encode())
    (tmp_path / "a.mtl").write_bytes(library.encode())
    model = read_model(tmp_path / "a.obj")
    assert is_complete(model) and shown(model) == [255, 0, 0] and model.warnings == ()


def test_wide_characters_of_obj_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(obj().replace("f 1 3 2", "f -4 -2 -3"), "utf-16")
    (tmp_path / "a.mtl").write_text(RED, "utf-16")
    model = read_model(tmp_path / "a.obj")
    assert is_complete(model) and shown(model) == [255, 0, 0]


@pytest.mark.parametrize("colour", ["Kd xyz 0.4 0.2 0.1", "Kd spectral a.rfl", "Kd 0.5 0.2", "Kd 255 128 0", "Ks 1 a"])
def test_colours_of_mtl_that_are_no_rgb_are_refused(tmp_path: Path, colour: str) -> None:
    """trimesh drops all materials of a file with one such colour."""
    (tmp_path / "a.obj").write_text(obj())
    (tmp_path / "a.mtl").write_text(f"{RED}newmtl other\n{colour}\n")
    with pytest.raises(InputError, match=rf"must be red, green and blue from 0 to 1 \(got {colour}\)"):
        read_model(tmp_path / "a.obj")


@pytest.mark.parametrize(
    ("text", "library", "sentence"),
    [
        (obj(vertex="v {} {} {} 0 1 0"), RED, "because its faces have materials"),
        (obj(use="").replace("mtllib a.mtl", "").replace("v 2 0 0", "v 2 0 0 1 0 0"), "", "some vertices have none"),
        (obj() + "l 1 2\n", RED, "points and lines are left out"),
        (obj() + "surf 0 1 0 1 1 2 3 4\n", RED, "free-form curves and surfaces are left out"),
        (obj() + "call b.obj\n", RED, "files that it calls are left out"),
        (obj(), RED + "d -halo 0.3\n", "is transparent"),
        (obj(), RED + "Tf 0.2 0.8 0.9\n", "transmits light (Tf)"),
        (obj(), RED + "Tf 0.5\n", "transmits light (Tf)"),
        (obj(), RED + "Tf spectral a.rfl\n", "transmits light (Tf)"),
        (obj() + "#MRGB ff0000ffff0000ff\n", RED, "(#MRGB) are left out, because their number"),
        (obj() + "#MRGB ff0000ffff0000ff\n#MRGB ff00ff00ffff0000\n", RED, "because its faces have materials"),
        (obj(), RED + "map_Ka a.png\n", "map_ka is left out"),
        (obj(), RED + "disp a.png\n", "disp is left out"),
        (obj(), "newmtl red\nKa 1 0 0\n", "it has no Kd"),
    ],
)
def test_what_is_not_read_of_obj_is_named(tmp_path: Path, text: str, library: str, sentence: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    (tmp_path / "a.mtl").write_text(library)
    model = read_model(tmp_path / "a.obj")
    (warning,) = (*model.warnings, *(warning for part in model.parts for warning in part.warnings))
    assert sentence in warning and is_complete(model)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_colours_of_polypaint_are_those_of_its_vertices(tmp_path: Path, end: str) -> None:
    """ZBrush writes MMRRGGBB for each vertex, with a mask MM."""
    colours = [(255, 0, 0), (0, 128, 255), (10, 20, 30), (200, 100, 50)]
    digits = ["{:02x}{:02X}{:02x}{:02X}".format(number, *colour) for number, colour in enumerate(colours)]
    paint = f"#MRGB {digits[0]}{digits[1]}{end} #MRGB {digits[2]}{digits[3]} {end}"
    text = obj(use="").replace("mtllib a.mtl\n", "").replace("\n", end)
    (tmp_path / "a.obj").write_bytes((text + paint).encode())
    model = read_model(tmp_path / "a.obj")
    (part,) = model.parts
    assert is_complete(model) and model.warnings == part.warnings == () and part.colours is not None
    shades = np.rint(255 * encode_srgb(part.colours)).astype(int)
    found = {
        (tuple(corner), tuple(colour))
        for corner, colour in zip(
            part.mesh.triangles.reshape(-1, 3).tolist(), shades.reshape(-1, 3).tolist(), strict=True
        )
    }
    assert found == set(zip(POINTS, colours, strict=True))


def test_colours_of_vertices_of_obj_are_fractions(tmp_path: Path) -> None:
    plain = obj(use="").replace("mtllib a.mtl", "")
    (tmp_path / "a.obj").write_text(
        "\n".join(f"{row} 1 0.5 0" if row.startswith("v ") else row for row in plain.split("\n"))
    )
    assert shown(read_model(tmp_path / "a.obj")) == [255, 128, 0]
    (tmp_path / "b.obj").write_text((tmp_path / "a.obj").read_text().replace(" 1 0.5 0", " 255 128 0"))
    with pytest.raises(InputError, match=r"colours of vertices must be within 0 to 1 \(got 255\)"):
        read_model(tmp_path / "b.obj")


def test_colours_and_grey_of_obj_without_material_file_survive_texture_coordinates(tmp_path: Path) -> None:
    """trimesh replaces both by a dark grey texture."""
    plain = obj(use="vt 0 0\nvt 1 0", face="f {}/1 {}/2 {}/2").replace("mtllib a.mtl\n", "")
    (tmp_path / "a.obj").write_text(plain)
    assert shown(read_model(tmp_path / "a.obj")) == [188, 188, 188]
    (tmp_path / "b.obj").write_text(obj(use="", vertex="v {} {} {} 1 0.5 0").replace("mtllib a.mtl\n", ""))
    model = read_model(tmp_path / "b.obj")
    assert shown(model) == [255, 128, 0] and model.warnings == ()
    sheet = trimesh.Trimesh(POINTS, FACES, process=False, visual=TextureVisuals(uv=np.zeros((4, 2))))
    assert shown(read_model(sheet)) == [188, 188, 188]


def test_a_black_factor_does_not_hide_the_texture_of_obj(tmp_path: Path) -> None:
    """Some programs write Kd 0 0 0 beside a texture."""
    (tmp_path / "a.obj").write_text(obj(use="usemtl red\nvt 0.5 0.5", face="f {}/1 {}/1 {}/1"))
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 0 0 0\nmap_Kd a.png\n")
    Image.new("RGB", (8, 8), COLOUR).save(tmp_path / "a.png")
    model = read_model(tmp_path / "a.obj")
    assert shown(model) == list(COLOUR) and "its Kd is black" in model.parts[0].warnings[0]


def test_two_materials_of_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(obj())
    (tmp_path / "a.mtl").write_text(RED + RED)
    assert shown(read_model(tmp_path / "a.obj")) == [255, 0, 0]
    (tmp_path / "a.mtl").write_text(RED + "newmtl red\nKd 0 1 0\n")
    with pytest.raises(InputError, match=r"a\.mtl: materials must have different names \(got 2 with the name red\)"):
        read_model(tmp_path / "a.obj")


@pytest.mark.parametrize("header", [b"", b"solid"])
def test_bytes_after_the_last_face_of_stl_are_ignored(tmp_path: Path, header: bytes) -> None:
    (tmp_path / "a.stl").write_bytes(stl(header=header) + bytes(100))
    assert is_complete(read_model(tmp_path / "a.stl"))


def stl(points: object = POINTS, header: bytes = b"") -> bytes:
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *np.asarray(points)[list(face)].ravel(), 0) for face in FACES)
    return header.ljust(80) + struct.pack("<I", len(FACES)) + rows


def test_faces_of_stl_with_nan_are_refused(tmp_path: Path) -> None:
    """Without them, the body would be open."""
    (tmp_path / "a.stl").write_bytes(stl(np.where(np.arange(12).reshape(4, 3) == 3, np.nan, POINTS)))
    with pytest.raises(InputError, match=r"vertex positions must be finite \(got \[nan, 0\.0, 0\.0\]"):
        read_model(tmp_path / "a.stl")


def test_a_colour_in_the_header_of_stl_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(stl(header=b"COLOR=\xff\0\0\xff"))
    (warning,) = read_model(tmp_path / "a.stl").warnings
    assert "colours of its faces are not read" in warning


def ply(
    columns: str = "", values: str = "", faces: tuple[str, ...] = (), face_columns: str = "", head: str = ""
) -> str:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    rows = [" ".join(map(str, point)) + f" {values}" for point in POINTS]
    faces = faces or tuple(f"3 {a} {b} {c}" for a, b, c in FACES)
    return (
        f"ply\nformat ascii 1.0\n{head}element vertex 4\n{axes}{columns}element face {len(faces)}\n"
        f"property list uchar int vertex_indices\n{face_columns}end_header\n" + "\n".join([*rows, *faces, ""])
    )


@pytest.mark.parametrize("names", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"])
def test_colours_of_ply_are_read_by_their_names(tmp_path: Path, names: str) -> None:
    columns = "".join(f"property uchar {name}\n" for name in names.split())
    (tmp_path / "a.ply").write_text(ply(columns, " ".join(map(str, COLOUR))))
    assert shown(read_model(tmp_path / "a.ply")) == list(COLOUR)


def test_transparent_colours_and_textures_without_coordinates_of_ply_are_named(tmp_path: Path) -> None:
    Image.new("RGB", (8, 8), COLOUR).save(tmp_path / "a.png")
    columns = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue", "alpha"))
    (tmp_path / "a.ply").write_text(ply(columns, "200 100 50 60"))
    (part,) = read_model(tmp_path / "a.ply").parts
    assert "colours of its vertices are transparent" in part.warnings[0]
    (tmp_path / "b.ply").write_text(ply(head="comment TextureFile a.png\n"))
    assert read_model(tmp_path / "b.ply").warnings == ("its texture a.png has no coordinates, and is left out",)


def test_other_colours_and_elements_of_ply_are_named(tmp_path: Path) -> None:
    columns = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    faces = tuple(f"3 {a} {b} {c} 0 255 0" for a, b, c in FACES)
    (tmp_path / "a.ply").write_text(ply(columns, "200 100 50", faces, columns))
    model = read_model(tmp_path / "a.ply")
    assert shown(model) == list(COLOUR) and "colours of its faces are left out" in model.warnings[0]
    material = "element material 1\nproperty uchar diffuse_red\nend_header"
    (tmp_path / "b.ply").write_text(ply().replace("end_header", material) + "255\n")
    assert read_model(tmp_path / "b.ply").warnings == ("its elements material are left out",)
    (tmp_path / "c.ply").write_text(ply(columns.replace("uchar", "float"), "255 128 0"))
    with pytest.raises(InputError, match=r"colours that are no integers must be within 0 to 1 \(got 255\)"):
        read_model(tmp_path / "c.ply")


def test_several_textures_of_ply_are_refused(tmp_path: Path) -> None:
    for name in "ab":
        Image.new("RGB", (8, 8)).save(tmp_path / f"{name}.png")
    (tmp_path / "a.ply").write_text(ply(head="comment TextureFile a.png\ncomment TextureFile b.png\n"))
    with pytest.raises(InputError, match=r"must have one texture \(got a\.png, b\.png\): merge them"):
        read_model(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (ply(faces=("3 0 1 -1",)), "a face refers to vertices 0 to 2 of 4"),
        (
            ply(faces=("4 0 1 2 3 9", "3 0 1 2 9"), face_columns="property uchar red\n"),
            "faces with colours must be tri",
        ),
    ],
)
def test_damaged_and_unsupported_faces_of_ply_are_refused(tmp_path: Path, content: str, sentence: str) -> None:
    (tmp_path / "a.ply").write_text(content)
    with pytest.raises(InputError, match=sentence):
        read_model(tmp_path / "a.ply")


def test_binary_polygons_of_different_sizes_are_refused_in_one_sentence(tmp_path: Path) -> None:
    header = ply().replace("ascii", "binary_little_endian").partition("end_header\n")[0].replace("face 4", "face 2")
    faces = struct.pack("<B4iB3i", 4, 0, 1, 2, 3, 3, 0, 1, 2)
    (tmp_path / "a.ply").write_bytes(header.encode() + b"end_header\n" + np.float32(POINTS).tobytes() + faces)
    with pytest.raises(InputError, match=r"different numbers of corners, .* export it with triangles"):
        read_model(tmp_path / "a.ply")


def off(header: str = "OFF", vertex: str = "", face: str = "") -> str:
    rows = [" ".join(map(str, point)) + vertex for point in POINTS]
    return "\n".join([header, "4 4 0", *rows, *(f"3 {a} {b} {c}{face}" for a, b, c in FACES), ""])


@pytest.mark.parametrize("content", [off("COFF", " 200 100 50 255"), off(face=" 200 100 50")])
def test_colours_of_off_files_are_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "a.off").write_text(content)
    model = read_model(tmp_path / "a.off")
    assert is_complete(model) and "colours of its vertices and faces are not read" in model.warnings[0]


def test_a_truncated_off_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text(off().removesuffix("3 0 3 2\n"))
    with pytest.raises(InputError, match=r"its header states 4 faces \(got 3; is the file complete\?\)"):
        read_model(tmp_path / "a.off")


def test_homogeneous_positions_of_off_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text(off("4OFF", " 2"))
    with pytest.raises(InputError, match=r"positions of three components \(got 4OFF\)"):
        read_model(tmp_path / "a.off")


FLOATS = (
    '<source id="{0}"><float_array id="{0}a" count="{1}">{2}</float_array><technique_common>'
    '<accessor source="#{0}a" count="{3}" stride="{4}">{5}</accessor></technique_common></source>'
)
TEXTURED = '<texture texture="image" texcoord="UV"/>'
COORDINATES = '<input semantic="TEXCOORD" source="#uv" offset="1"/>'


def dae(
    diffuse: str,
    *,
    image: str = "",
    effect: str = "",
    inputs: str = "",
    node: str = "",
    corner: str = "{}",
    more: str = "",
) -> str:
    """Build a COLLADA file of the tetrahedron with one material."""
    axes = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    positions = FLOATS.format("p", 12, " ".join(str(c) for point in POINTS for c in point), 4, 3, axes)
    uv = FLOATS.format("uv", 2, "0.5 0.5", 1, 2, '<param name="S" type="float"/><param name="T" type="float"/>')
    colours = FLOATS.format("c", 3, "0 1 0", 1, 3, "".join(f'<param name="{c}" type="float"/>' for c in "RGB"))
    corners = " ".join(corner.format(vertex) for face in FACES for vertex in face)
    return (
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>'
        f'<library_images><image id="image"><init_from>{image}</init_from></image></library_images>'
        '<library_effects><effect id="e"><profile_COMMON><technique sid="t"><phong>'
        f"<diffuse>{diffuse}</diffuse>{effect}</phong></technique></profile_COMMON></effect></library_effects>"
        '<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>'
        f'<library_geometries><geometry id="g"><mesh>{positions}{uv}{colours}<vertices id="v"><input '
        'semantic="POSITION" source="#p"/></vertices><triangles count="4" material="s"><input semantic="VERTEX" '
        f'source="#v" offset="0"/>{inputs}<p>{corners}</p></triangles></mesh></geometry></library_geometries>'
        f'<library_visual_scenes><visual_scene id="s"><node>{node}<instance_geometry url="#g"><bind_material>'
        '<technique_common><instance_material symbol="s" target="#m"/></technique_common></bind_material>'
        f"</instance_geometry>{more}</node></visual_scene></library_visual_scenes>"
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


@pytest.fixture
def read_dae(tmp_path: Path) -> Callable[[str], MeshModel]:
    pytest.importorskip("collada", reason="needs pycollada, which reads COLLADA")

    def read(content: str) -> MeshModel:
        (tmp_path / "a.dae").write_text(content)
        return read_model(tmp_path / "a.dae", up="z")

    return read


def test_colours_of_collada_are_display_encoded(read_dae: Callable[[str], MeshModel]) -> None:
    model = read_dae(dae("<color>0.5 0.25 0 1</color>"))
    assert is_complete(model)
    np.testing.assert_allclose(shown(model), (128, 64, 0), atol=1)


@pytest.mark.parametrize("uri", ["a%20%C3%BC.png", "file:///C:/work/a%20%C3%BC.png", "./a ü.png"])
def test_textures_of_collada_are_found_by_their_uri(
    read_dae: Callable[[str], MeshModel], tmp_path: Path, uri: str
) -> None:
    Image.new("RGB", (8, 8), COLOUR).save(tmp_path / "a ü.png")
    assert shown(read_dae(dae(TEXTURED, image=uri, inputs=COORDINATES, corner="{} 0"))) == list(COLOUR)
    (part,) = read_dae(dae(TEXTURED, image=uri)).parts
    assert "its texture has no coordinates" in part.warnings[0]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (dae(TEXTURED, image="gone.png"), r"a\.dae: its texture gone\.png is missing"),
        (dae("", more='<instance_controller url="#k"/>'), r"skins or morph targets \(controllers\)"),
        (dae("", node="<skew>45 1 0 0 0 1 0</skew>"), "a mesh placed by <skew>"),
        (dae("", node="<lookat>0 0 1 0 0 0 0 1 0</lookat>"), "a mesh placed by <lookat>"),
        (dae("").replace("0 0 0 2 0 0", "0 0 nan 2 0 0"), "its numbers must be finite"),
        (dae("").replace("<p>0 2 1", "<p>0 -1 1"), "a face refers to vertices 0 to 4 of 4"),
    ],
)
def test_what_cannot_be_read_of_collada_is_refused(
    read_dae: Callable[[str], MeshModel], content: str, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        read_dae(content)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (dae("<color>1 0 0 1</color>", effect="<transparency><float>0.3</float></transparency>"), "are transparent"),
        (
            dae("<color>1 0 0 1</color>", inputs='<input semantic="COLOR" source="#c" offset="1"/>', corner="{} 0"),
            "the colours of its vertices are left out",
        ),
    ],
)
def test_what_is_not_read_of_collada_is_named(
    read_dae: Callable[[str], MeshModel], content: str, sentence: str
) -> None:
    (warning,) = read_dae(content).warnings
    assert sentence in warning
