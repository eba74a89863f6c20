"""3MF: units, colours and placement that the file states."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.errors import InputError
from mitsplat.images.colour import decode_srgb

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
MATERIAL = "http://schemas.microsoft.com/3dmanufacturing/material/2015/02"
PRODUCTION = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06"
VERTICES = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in ((0, 0, 0), (8, 0, 0), (0, 8, 0), (0, 0, 8)))
FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
RED, GREEN, BLUE = np.eye(3)
IDENTITY = "1 0 0 0 1 0 0 0 1"


pytestmark = pytest.mark.usefixtures("without_trial")


def tetrahedron(number: int, *, more: str = "", triangles: tuple[str, ...] = ("",) * 4) -> str:
    """Build an object: the corner of a cube with a side of 8 units."""
    rows = "".join(
        f'<triangle v1="{a}" v2="{b}" v3="{c}" {extra}/>' for (a, b, c), extra in zip(FACES, triangles, strict=True)
    )
    mesh = f"<mesh><vertices>{VERTICES}</vertices><triangles>{rows}</triangles></mesh>"
    return f'<object id="{number}" type="model" {more}>{mesh}</object>'


def write(path: Path, resources: str, build: str = '<item objectid="1"/>', unit: str = "", **files: bytes) -> Path:
    """Write a 3MF file."""
    model = (
        f'<model {unit} xmlns="{CORE}" xmlns:m="{MATERIAL}" xmlns:p="{PRODUCTION}">'
        f"<resources>{resources}</resources><build>{build}</build></model>"
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("3D/3dmodel.model", model)
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def corners_of(part: MeshPart) -> np.ndarray:
    assert part.colours is not None
    return part.colours


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("", 1e-3),
        *((f'unit="{u}"', m) for u, m in (("inch", 0.0254), ("foot", 0.3048), ("micron", 1e-6), ("meter", 1))),
    ],
)
def test_the_unit_of_the_file_is_used_unless_one_is_given(tmp_path: Path, unit: str, metres: float) -> None:
    path = write(tmp_path / "a.3mf", tetrahedron(1), unit=unit)
    model = read_model(path)
    assert (model.units, model.up, model.stated) == (metres, "z", ("units", "up"))
    np.testing.assert_allclose(model.parts[0].mesh.extents, 8 * metres)
    given = read_model(path, metres_per_unit=0.01, up="y")
    assert (given.units, given.up, given.stated) == (0.01, "y", ())
    np.testing.assert_allclose(given.parts[0].mesh.bounds, [(0, -0.08, 0), (0.08, 0, 0.08)], atol=1e-9)


def test_colours_of_objects_triangles_and_corners_are_read(tmp_path: Path) -> None:
    bases = '<basematerials id="5"><base name="a" displaycolor="#804020"/><base name="b" displaycolor="#00FF00FF"/>'
    colours = '<m:colorgroup id="6"><m:color color="#FF0000"/><m:color color="#0000FF"/></m:colorgroup>'
    triangles = ("", 'p1="1"', 'pid="6" p1="0" p2="1" p3="1"', 'pid="6" p1="1"')
    resources = bases + "</basematerials>" + colours + tetrahedron(1, more='pid="5" pindex="0"', triangles=triangles)
    (part,) = read_model(write(tmp_path / "a.3mf", resources)).parts
    found = corners_of(part)
    np.testing.assert_allclose(found[0], [decode_srgb(np.array([0x80, 0x40, 0x20]) / 255)] * 3)
    np.testing.assert_allclose(found[1], [GREEN] * 3)
    np.testing.assert_allclose(found[2], [RED, BLUE, BLUE])
    np.testing.assert_allclose(found[3], [BLUE] * 3)
    assert not part.shiny


def test_components_are_placed_by_their_transforms(tmp_path: Path) -> None:
    """The second component is mirrored; the build item moves both. A matrix lists its rows for row vectors."""
    components = (
        f'<object id="2"><components><component objectid="1" transform="{IDENTITY} 100 0 0"/>'
        '<component objectid="1" transform="-1 0 0 0 1 0 0 0 1 0 0 0"/></components></object>'
    )
    colours = '<m:colorgroup id="6"><m:color color="#FF0000"/><m:color color="#0000FF"/></m:colorgroup>'
    triangles = ('pid="6" p1="0" p2="1" p3="1"',) * 4
    build = '<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 0 0 50"/>'
    resources = colours + tetrahedron(1, triangles=triangles) + components
    first, second = read_model(write(tmp_path / "a.3mf", resources, build)).parts
    # (x, y, z) becomes (-y, x, z + 50).
    np.testing.assert_allclose(first.mesh.bounds, np.array([(-8, 100, 50), (0, 108, 58)]) * 1e-3, atol=1e-9)
    np.testing.assert_allclose(second.mesh.bounds, np.array([(-8, -8, 50), (0, 0, 58)]) * 1e-3, atol=1e-9)
    for part in (first, second):
        assert part.mesh.volume == pytest.approx(8**3 / 6 * 1e-9)
        red = corners_of(part)[..., 0] > 0.5
        tip = np.linalg.norm(part.mesh.triangles - [0, part.mesh.bounds[0, 1], 0.05], axis=2)
        assert red.sum() == 4
        assert (red.sum(axis=1) == 1).all()
        if part is second:
            tip = np.linalg.norm(part.mesh.triangles - [0, 0, 0.05], axis=2)
        assert (red == (tip < 1e-9))[[0, 1, 3]].all()


def test_textures_of_the_archive_are_read(tmp_path: Path) -> None:
    """The image is red on its left half; u grows from 0 to 1 along the first edge of a triangle."""
    image, buffer = Image.new("RGB", (8, 8), (0, 0, 255)), io.BytesIO()
    image.paste((255, 0, 0), (0, 0, 4, 8))
    image.save(buffer, "PNG")
    texture = '<m:texture2d id="7" path="/3D/Textures/a.png" contenttype="image/png" tilestyleu="clamp"/>'
    group = '<m:texture2dgroup id="8" texid="7">' + "".join(
        f'<m:tex2coord u="{u}" v="{v}"/>' for u, v in ((0, 0), (1, 0), (0, 1))
    )
    triangles = ('pid="8" p1="0" p2="1" p3="2"', "", "", "")
    resources = texture + group + "</m:texture2dgroup>" + tetrahedron(1, triangles=triangles)
    path = write(tmp_path / "a.3mf", resources, **{"3D/Textures/a.png": buffer.getvalue()})
    textured, plain = read_model(path).parts
    assert (len(textured.mesh.faces), len(plain.mesh.faces)) == (1, 3)
    weights = np.array([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1]])
    np.testing.assert_allclose(textured.colours_at(np.zeros(2, int), weights), [RED, BLUE])
    with pytest.raises(InputError, match=r"a\.3mf: its texture /3D/Textures/a\.png cannot be read .* is missing"):
        read_model(write(tmp_path / "a.3mf", resources))


def test_objects_of_other_model_files_are_read(tmp_path: Path) -> None:
    other = f'<model xmlns="{CORE}"><resources>{tetrahedron(4)}</resources></model>'.encode()
    component = '<object id="1"><components><component objectid="4" p:path="/3D/other.model"/></components></object>'
    (part,) = read_model(write(tmp_path / "a.3mf", component, **{"3D/other.model": other})).parts
    assert part.mesh.extents[0] == pytest.approx(8e-3)


@pytest.mark.parametrize(
    ("resources", "fault"),
    [
        ('<object id="1"><components><component objectid="1"/></components></object>', "object 1 contains itself"),
        ("", "object 1 is missing"),
        (tetrahedron(1, more='pid="9" pindex="0"'), "property group 9 is missing"),
        ('<basematerials id="9"/>' + tetrahedron(1, more='pid="9" pindex="0"'), "group 9 has 0 entries"),
        (tetrahedron(1).replace('v1="0"', 'v1="17"'), "vertices 1 to 17 of 4"),
        ("<object", "not well-formed"),
    ],
)
def test_damaged_files_are_refused_in_one_sentence(tmp_path: Path, resources: str, fault: str) -> None:
    with pytest.raises(InputError, match=rf"a\.3mf: not a mesh that can be read \(.*{fault}"):
        read_model(write(tmp_path / "a.3mf", resources))


def test_components_that_multiply_without_end_are_refused(tmp_path: Path) -> None:
    """Each of 20 objects has ten components: 10^20 parts."""
    chain = "".join(
        f'<object id="{number}"><components>' + f'<component objectid="{number + 1}"/>' * 10 + "</components></object>"
        for number in range(1, 21)
    )
    with pytest.raises(InputError, match="components make more than 100000 objects"):
        read_model(write(tmp_path / "a.3mf", chain + tetrahedron(21)))


@pytest.mark.parametrize(
    ("namespace", "is_read"),
    [
        (PRODUCTION, True),
        (MATERIAL, True),
        ("http://schemas.microsoft.com/3dmanufacturing/beamlattice/2017/02", False),
        ("http://example.com/cells", False),
    ],
)
def test_required_extensions_that_are_not_supported_are_named(tmp_path: Path, namespace: str, is_read: bool) -> None:
    path = write(tmp_path / "a.3mf", tetrahedron(1), unit=f'xmlns:x="{namespace}" requiredextensions="x"')
    if is_read:
        assert len(read_model(path).parts) == 1
        return
    with pytest.raises(InputError, match=f"extensions of 3MF that are not supported: export it without {namespace}"):
        read_model(path)


def test_supports_and_painted_colours_are_left_out_with_a_warning(tmp_path: Path) -> None:
    support = tetrahedron(2).replace('type="model"', 'type="support"')
    painted = tetrahedron(1, triangles=('paint_color="4"', "", "", ""))
    build = '<item objectid="1"/><item objectid="2" transform="1 0 0 0 1 0 0 0 1 50 0 0"/>'
    model = read_model(write(tmp_path / "a.3mf", painted + support, build))
    assert model.warnings == ("its painted colours of a slicer and supports are left out",)
    np.testing.assert_allclose(model.parts[0].mesh.extents, 0.008)


def test_volumes_of_slicers_that_are_no_parts_are_left_out(tmp_path: Path) -> None:
    """PrusaSlicer names triangles of one mesh, Bambu Studio components of an object."""
    double = tetrahedron(1, triangles=("",) * 4)
    rows = double[double.index("<triangle ") : double.index("</triangles>")]
    double = double.replace("</triangles>", rows.replace("<triangle ", "<triangle pid='5' p1='0' ") + "</triangles>")
    colours = '<m:colorgroup id="5"><m:color color="#FF0000"/></m:colorgroup>'
    volumes = (
        '<config><object id="1"><volume firstid="0" lastid="3"><metadata key="volume_type" value="ModelPart"/></volume>'
        '<volume firstid="4" lastid="7"><metadata key="volume_type" value="ParameterModifier"/></volume></object>'
        "</config>"
    )
    files = {"Metadata/Slic3r_PE_model.config": volumes.encode()}
    (tmp_path / "a").mkdir()
    prusa = read_model(write(tmp_path / "a/a.3mf", colours + double, **files))
    group = "<components>" + "".join(f'<component objectid="{number}"/>' for number in (1, 2)) + "</components>"
    kinds = ((1, "normal_part"), (2, "negative_part"))
    rows = "".join(f'<part id="{number}" subtype="{kind}"/>' for number, kind in kinds)
    parts = f'<config><object id="3">{rows}</object></config>'
    resources = tetrahedron(1) + tetrahedron(2) + f'<object id="3" type="model">{group}</object>'
    files = {"Metadata/model_settings.config": parts.encode()}
    bambu = read_model(write(tmp_path / "b.3mf", resources, '<item objectid="3"/>', **files))
    for model in (prusa, bambu):
        assert sum(len(part.mesh.faces) for part in model.parts) == 4
        assert model.warnings == ("its modifiers and negative volumes of a slicer are left out",)


def test_a_file_of_shapes_of_extensions_alone_is_refused(tmp_path: Path) -> None:
    shape = '<object id="1"><booleanshape objectid="1"/></object>'
    with pytest.raises(InputError, match="it has only objects of kind booleanshape, which are not read"):
        read_model(write(tmp_path / "a.3mf", shape, '<item objectid="1"/>'))


@pytest.mark.parametrize(
    ("resources", "sentence"),
    [
        (tetrahedron(1).replace("</mesh>", "<beamlattice/></mesh>"), "its beam lattices are left out"),
        ('<m:pbmetallicdisplayproperties id="8"/>' + tetrahedron(1), "its metalness and roughness are left out"),
        (
            '<m:colorgroup id="5"><m:color color="#FF000040"/></m:colorgroup>' + tetrahedron(1),
            "colours are transparent",
        ),
        (tetrahedron(1) + tetrahedron(2).replace('"model"', '"other"'), "its objects of type other are left out"),
    ],
)
def test_what_is_not_read_is_named(tmp_path: Path, resources: str, sentence: str) -> None:
    build = '<item objectid="1"/>' + '<item objectid="2"/>' * ('id="2"' in resources)
    model = read_model(write(tmp_path / "a.3mf", resources, build))
    (warning,) = model.warnings
    assert sentence in warning and sum(len(part.mesh.faces) for part in model.parts) == 4
