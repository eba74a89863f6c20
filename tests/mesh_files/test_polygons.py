"""Faces of OBJ, PLY, OFF and COLLADA files: relative indices, polygons with many corners, several material files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsplat.errors import InputError
from mitsplat.images.colour import encode_srgb
from mitsplat.mesh_files.mesh_reading import read_mesh_file

TRIANGLE = ((0, 0, 0), (1, 0, 0), (1, 1, 0))
ARROW = ((4, 0, 0), (1, 1, 0), (0, 4, 0), (0, 0, 0))
"""Quadrilateral with an area of 4, whose second corner points inwards."""
COMB = ((0, 0, 0), (5, 0, 0), (5, 3, 0), (4, 3, 0), (4, 1, 0), (1, 1, 0), (1, 3, 0), (0, 3, 0))
"""Polygon with an area of 9."""


pytestmark = pytest.mark.usefixtures("without_trial")


def rows_of(points: object, prefix: str = "v ") -> str:
    return "".join(f"{prefix}{' '.join(map(str, point))}\n" for point in np.asarray(points))


def triangles(path: Path) -> np.ndarray:
    (part,) = read_mesh_file(path).parts
    return np.asarray(part.vertices[part.faces])


@pytest.mark.parametrize("corner", ["{0}", "{0}//-1", "{0}/{0}", "{0}/{0}/-1"])
def test_relative_indices_of_obj_count_from_their_line(tmp_path: Path, corner: str) -> None:
    """Each object is followed by its faces, as CAD programs write it."""
    face = "f " + " ".join(corner.format(k) for k in (-3, -2, -1)) + "\n"
    block = "vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\n"
    far = np.add(TRIANGLE, (5, 0, 0))
    (tmp_path / "a.obj").write_text(rows_of(TRIANGLE) + block + face + rows_of(far) + block + face)
    np.testing.assert_allclose(triangles(tmp_path / "a.obj"), [TRIANGLE, far])


@pytest.mark.parametrize(("outline", "area"), [(ARROW, 4.0), (COMB, 9.0)])
@pytest.mark.parametrize("shift", range(4))
@pytest.mark.parametrize("axis", range(3))
def test_concave_polygons_of_obj_keep_their_outline(
    tmp_path: Path, outline: tuple[tuple[int, ...], ...], area: float, shift: int, axis: int
) -> None:
    points = np.roll(np.roll(outline, shift, axis=0), axis, axis=1)
    normal = np.roll((0, 0, 1), axis)
    face = "f " + " ".join(str(k + 1) for k in range(len(points))) + " # outline\n"
    (tmp_path / "a.obj").write_text(rows_of(points) + face)
    found = triangles(tmp_path / "a.obj")
    areas = 0.5 * np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0]) @ normal
    sense = np.sign(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0) @ normal)
    assert (sense * areas > 0).all()
    assert abs(areas).sum() == pytest.approx(area)


def test_polygons_keep_their_texture_coordinates_and_continue_on_the_next_line(tmp_path: Path) -> None:
    rows = rows_of(COMB) + rows_of(np.array(COMB)[:, :2] / 5, "vt ")
    corners = [f"{k}/{k}" for k in range(1, 9)]
    (tmp_path / "a.mtl").write_text("newmtl paint\nmap_Kd a.png\n")
    text = f"mtllib a.mtl\nusemtl paint\n{rows}f {' '.join(corners[:5])} \\\n{' '.join(corners[5:])}\n"
    (tmp_path / "a.obj").write_text(text)
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    (part,) = read_mesh_file(tmp_path / "a.obj").parts
    assert part.material.texture is not None
    assert part.faces.shape == (6, 3)
    np.testing.assert_allclose(part.material.texture.uv, part.vertices[part.faces][..., :2] / 5, atol=1e-6)


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1 2 -9", "f 1 2 3 4", "f 1 2 x3 4"])
def test_damaged_faces_of_obj_are_refused(tmp_path: Path, face: str) -> None:
    (tmp_path / "a.obj").write_text(f"{rows_of(TRIANGLE)}{face}\n")
    with pytest.raises(InputError, match=rf"a\.obj: line 4: faces must name vertices from 1 to 3, .* \(got {face}\)"):
        read_mesh_file(tmp_path / "a.obj")


def write_ply(path: Path, outline: object) -> None:
    points = np.asarray(outline)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(header + rows_of(points, "") + f"{len(points)} {' '.join(map(str, range(len(points))))}\n")


def write_off(path: Path, outline: object) -> None:
    points = np.asarray(outline)
    faces = f"{len(points)} {' '.join(map(str, range(len(points))))}\n"
    path.write_text(f"OFF # of a CAD program\n{len(points)} 1 0\n{rows_of(points, '')}{faces}")


def write_dae(path: Path, outline: object) -> None:
    points = np.asarray(outline)
    values, count = " ".join(map(str, points.ravel())), len(points)
    source = (
        f'<source id="p"><float_array id="a" count="{3 * count}">{values}</float_array><technique_common>'
        f'<accessor source="#a" count="{count}" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>'
        '<param name="Z" type="float"/></accessor></technique_common></source>'
    )
    faces = (
        '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><polylist count="1"><input '
        f'semantic="VERTEX" source="#v" offset="0"/><vcount>{count}</vcount><p>{" ".join(map(str, range(count)))}</p>'
        "</polylist>"
    )
    scene = (
        '<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>'
        '</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene>'
    )
    path.write_text(
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/><library_geometries>'
        f'<geometry id="g"><mesh>{source}{faces}</mesh></geometry></library_geometries>{scene}</COLLADA>'
    )


PENTAGON = ((0, 0, 0), (5, 0, 0), (6, 3, 0), (3, 5, 0), (0, 3, 0))


@pytest.mark.parametrize("write", [write_ply, write_off])
def test_concave_polygons_of_ply_and_off_keep_their_outline(
    tmp_path: Path, write: Callable[[Path, object], None]
) -> None:
    path = tmp_path / f"a.{write.__name__.removeprefix('write_')}"
    write(path, PENTAGON)
    assert len(triangles(path)) == 3
    write(path, COMB)
    found = triangles(path)
    areas = 0.5 * np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])[:, 2]
    assert len(areas) == 6 and areas.min() > 0 and areas.sum() == pytest.approx(9)


def test_concave_polygons_of_ply_keep_the_colours_of_vertices(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", COMB)
    text = (tmp_path / "a.ply").read_text()
    text = text.replace(
        "element face", "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "element face"
    )
    for number, row in enumerate(rows_of(COMB, "").splitlines()):
        text = text.replace(f"{row}\n", f"{row} {20 * number} 0 0\n", 1)
    (tmp_path / "a.ply").write_text(text)
    (part,) = read_mesh_file(tmp_path / "a.ply").parts
    assert part.colours is not None
    corners = part.vertices[part.faces].reshape(-1, 3)
    index = [int(np.flatnonzero((np.array(COMB) == corner).all(axis=1))[0]) for corner in corners]
    assert 255 * encode_srgb(part.colours[..., 0].ravel()) == pytest.approx(20.0 * np.array(index), abs=0.5)


def test_concave_polygons_of_collada_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("collada")
    write_dae(tmp_path / "a.dae", PENTAGON)
    assert len(triangles(tmp_path / "a.dae")) == 3
    write_dae(tmp_path / "b.dae", COMB)
    with pytest.raises(InputError, match=r"b\.dae: it has concave polygons, .* export it with triangles"):
        read_mesh_file(tmp_path / "b.dae")


def test_two_material_files_and_a_missing_one_are_named(tmp_path: Path) -> None:
    rows = f"{rows_of(TRIANGLE)}usemtl paint\nf 1 2 3\n"
    for name in "ab":
        (tmp_path / f"{name}.mtl").write_text(f"newmtl {'paint' if name == 'b' else 'other'}\nKd 1 0 0\n")
    (tmp_path / "two.obj").write_text(f"mtllib a.mtl\nmtllib b.mtl\n{rows}")
    with pytest.raises(InputError, match=r"must have one material file \(got a\.mtl, b\.mtl\): join them"):
        read_mesh_file(tmp_path / "two.obj")
    (tmp_path / "none.obj").write_text(rows)
    assert read_mesh_file(tmp_path / "none.obj").warnings == (
        "it names no material file (mtllib) of its material paint, which is left out",
    )
