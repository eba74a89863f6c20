"""Materials: the same object in several mesh formats and finishes must give splats of the same colours."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from mitsplat.bake.bake import BakeResult, BakeSettings, bake_asset
from mitsplat.bake.bake_report import write_bake_report
from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.bake.surface_materials import SurfaceFinish
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.fit.image_metrics import psnr_of
from mitsplat.images.colour import decode_srgb
from mitsplat.mesh_files.mesh_file import DIELECTRIC_SPECULAR, ROUGHNESS
from mitsplat.mesh_files.trimesh_parts import read_material

COLOUR = (200, 120, 40)
QUICK = BakeSettings(gaussians=300, fit_steps=0, verify_views=1)


def box(visual: object = None) -> trimesh.Trimesh:
    """Build a box whose faces share no vertices."""
    mesh = trimesh.creation.box((0.04, 0.03, 0.02))
    return trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False, visual=visual)


def write_obj(folder: Path, lines: str, *, name: str = "box") -> Path:
    """Write the box as an OBJ with ``lines`` in its MTL, and a texture of one colour for reference."""
    Image.new("RGB", (8, 8), COLOUR).save(folder / "colour.png")
    (folder / f"{name}.mtl").write_text(f"newmtl paint\n{lines}\n")
    rows = [f"mtllib {name}.mtl", *("v {:.6f} {:.6f} {:.6f}".format(*corner) for corner in box().vertices)]
    rows += ["vt 0.1 0.1", "vt 0.9 0.1", "vt 0.5 0.9", "usemtl paint"]
    rows += [f"f {3 * k + 1}/1 {3 * k + 2}/2 {3 * k + 3}/3" for k in range(12)]
    (folder / f"{name}.obj").write_text("\n".join(rows))
    return folder / f"{name}.obj"


def part_of(folder: Path, lines: str, **finish: object) -> MeshPart:
    (part,) = read_model(write_obj(folder, lines), finish=SurfaceFinish(**finish)).parts  # type: ignore[arg-type]
    return part


def colour_of(part: MeshPart) -> np.ndarray:
    """Return the mean linear colour of a mesh part."""
    if part.colours is not None:
        return np.asarray(part.colours.mean(axis=(0, 1)))
    return np.asarray(decode_srgb(part.texture.pixels / 255.0).mean(axis=(0, 1)) * part.factor)


@pytest.fixture(scope="module")
def bakes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, BakeResult]:
    """Bake the box in one colour: as OBJ scan, as GLB, as PLY with vertex colours, and as STL with ``--colour``."""
    folder = tmp_path_factory.mktemp("formats")
    image, uv = Image.new("RGB", (8, 8), COLOUR), np.tile([[0.1, 0.1], [0.9, 0.1], [0.5, 0.9]], (12, 1))
    matt = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    box(TextureVisuals(uv=uv, material=matt)).export(folder / "box.glb")
    painted = box()
    painted.visual.vertex_colors = (*COLOUR, 255)
    painted.export(folder / "box.ply")
    box().export(folder / "box.stl")
    write_obj(folder, "map_Kd colour.png")
    finishes = {
        "obj": SurfaceFinish(),
        "glb": SurfaceFinish(specular=0.0),
        "ply": SurfaceFinish(),
        "stl": SurfaceFinish(colour="#c87828"),
    }
    return {
        kind: bake_asset(folder / f"box.{kind}", name="box", up="z", settings=QUICK, finish=finish)
        for kind, finish in finishes.items()
    }


@pytest.mark.parametrize("kind", ["obj", "ply", "stl"])
def test_the_same_object_in_each_mesh_format_bakes_to_the_same_colours(bakes: dict[str, BakeResult], kind: str) -> None:
    found, wanted = (bakes[name].views[0] for name in (kind, "glb"))
    assert psnr_of(((found.splats - wanted.splats) ** 2).mean()) > 40
    assert psnr_of(((found.mesh - wanted.mesh) ** 2).mean()) > 40


def test_splats_have_the_brightness_of_the_texture(bakes: dict[str, BakeResult], tmp_path: Path) -> None:
    assert bakes["obj"].brightness == pytest.approx(1.0, abs=0.05)
    assert bakes["glb"].brightness == pytest.approx(1.0, abs=0.05)
    assert bakes["ply"].brightness is None
    dark = bake_asset(write_obj(tmp_path, "Kd 0.4 0.4 0.4\nmap_Kd colour.png"), name="box", settings=QUICK)
    assert dark.brightness == pytest.approx(decode_srgb(0.4), rel=0.1)
    assert "as bright as its texture in the file" in dark.warnings[0]


def test_texels_outside_of_all_faces_do_not_count_for_brightness(tmp_path: Path) -> None:
    atlas = Image.new("RGB", (8, 8), "white")
    atlas.paste((58, 58, 58), (0, 0, 4, 8))
    uv = np.tile([[0.05, 0.1], [0.4, 0.1], [0.2, 0.9]], (12, 1))
    scan = PBRMaterial(baseColorTexture=atlas, metallicFactor=0.0, roughnessFactor=0.6)
    box(TextureVisuals(uv=uv, material=scan)).export(tmp_path / "dark.glb")
    baked = bake_asset(tmp_path / "dark.glb", name="dark", settings=QUICK)
    assert baked.brightness == pytest.approx(1.0, abs=0.05)
    assert not baked.warnings


def test_report_shows_mesh_beside_splats(bakes: dict[str, BakeResult], tmp_path: Path) -> None:
    page = write_bake_report(tmp_path, bakes["obj"]).read_text()
    assert page.count("<img") == 3
    for figure in ("40 x 30 x 20 mm", "0.024 kg", "1, at most 0.00 mm outside of the mesh", "below 24 dB"):
        assert figure in page


@pytest.mark.parametrize(
    ("lines", "colour", "gloss"),
    [
        ("map_Kd colour.png", decode_srgb(np.array(COLOUR) / 255), (False, 0.0, 1.0)),
        ("map_Kd colour.png\nKd 1 1 1", decode_srgb(np.array(COLOUR) / 255), (False, 0.0, 1.0)),
        ("Kd 0.4 0.4 0.4", decode_srgb(np.full(3, 0.4)), (False, 0.0, 1.0)),
        ("Ka 0 0 0", np.full(3, 0.5), (False, 0.0, 1.0)),
        ("Kd 1 1 1\nKs 0.5 0.5 0.5\nNs 30\nillum 2", np.ones(3), (True, 0.0, 0.5)),
        ("Kd 1 1 1\nKs 0.5 0.5 0.5\nNs 30\nillum 1", np.ones(3), (False, 0.0, 1.0)),
        ("Kd 1 1 1\nPr 0.3\nPm 1", np.ones(3), (True, 1.0, 0.3)),
    ],
)
def test_each_supported_mtl_statement_sets_its_property(
    tmp_path: Path, lines: str, colour: np.ndarray, gloss: tuple[object, ...]
) -> None:
    part = part_of(tmp_path, lines)
    np.testing.assert_allclose(colour_of(part), colour, atol=0.005)
    assert (part.shiny, part.metallic, pytest.approx(part.roughness)) == gloss
    assert part.warnings == ()


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ("Kd 1 1 1\nd 0.5", "transparent"),
        ("Kd 1 1 1\nTr 0.5", "transparent"),
        ("Kd 1 1 1\nmap_Ke colour.png", "emits light"),
        ("Kd 1 1 1\nmap_Pr colour.png\nmap_Bump colour.png", "map_bump, map_pr are left out"),
    ],
)
def test_each_unsupported_mtl_statement_gives_a_warning(tmp_path: Path, lines: str, sentence: str) -> None:
    (warning,) = part_of(tmp_path, lines).warnings
    assert sentence in warning


def test_factors_and_vertex_colours_of_gltf_are_linear(tmp_path: Path) -> None:
    """glTF 2.0, sections 3.9.2 and 3.7.2.1."""
    grey = PBRMaterial(baseColorFactor=[128, 128, 128, 255], metallicFactor=0.0, roughnessFactor=1.0)
    box(TextureVisuals(material=grey)).export(tmp_path / "factor.glb")
    (part,) = read_model(tmp_path / "factor.glb").parts
    np.testing.assert_allclose(colour_of(part), 128 / 255, atol=1e-6)
    painted = box()
    painted.visual.vertex_colors = (128, 128, 128, 255)
    painted.export(tmp_path / "colours.glb")
    painted.export(tmp_path / "colours.ply")
    for suffix, colour in (("glb", 128 / 255), ("ply", decode_srgb(128 / 255))):
        (part,) = read_model(tmp_path / f"colours.{suffix}").parts
        np.testing.assert_allclose(colour_of(part), colour, atol=1e-6)


def gloss_box(**maps: object) -> trimesh.Trimesh:
    """Build a box whose faces have u from 0 to 1 along their first edge and v along their third edge."""
    material = PBRMaterial(metallicFactor=1.0, roughnessFactor=0.5, **maps)
    return box(TextureVisuals(uv=np.tile([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], (12, 1)), material=material))


def test_each_gaussian_has_the_metalness_and_roughness_of_its_texels(tmp_path: Path) -> None:
    """Green is roughness and blue metalness, times the factors (glTF 2.0, 3.9.2). The image has two halves along u."""
    texels = np.zeros((4, 8, 3), np.uint8)
    texels[:, :4], texels[:, 4:] = (0, 255, 0), (0, 102, 255)
    gloss_box(metallicRoughnessTexture=Image.fromarray(texels)).export(tmp_path / "box.glb")
    (part,) = read_model(tmp_path / "box.glb").parts
    faces, corner = np.arange(12), np.tile([0.6, 0.2, 0.2], (12, 1))
    np.testing.assert_allclose(part.materials_at(faces, corner), [[0, 0.5, 0.5]] * 12, atol=0.003)
    np.testing.assert_allclose(part.materials_at(faces, corner[:, [1, 0, 2]]), [[1, 0.2, 0.5]] * 12, atol=0.003)
    baked = bake_asset(tmp_path / "box.glb", name="box", settings=QUICK).asset.splats.materials
    assert baked is not None
    assert baked.normals is None
    for values, pair in ((baked.metallic, (0, 1)), (baked.roughness, (0.5, 0.2))):
        assert [(np.abs(values - value) < 0.01).mean() > 0.1 for value in pair] == [True, True]
    finish = SurfaceFinish(metallic=0.0)
    (part,) = read_model(tmp_path / "box.glb", finish=finish).parts
    np.testing.assert_allclose(part.materials_at(faces, corner[:, [1, 0, 2]]), [[0, 0.2, 0.5]] * 12, atol=0.003)


def test_a_normal_map_tilts_the_normals_of_gaussians_towards_u_and_v() -> None:
    """The texel (0.6, 0, 0.8) tilts normals towards u and (0, 0.6, 0.8) towards v, which points up in the image."""
    for texel, axis in (((204, 128, 230), 0), ((128, 204, 230), 1)):
        tilted = gloss_box(normalTexture=Image.new("RGB", (2, 2), texel))
        splats = bake_asset(tilted, name="box", settings=QUICK).asset.splats
        assert splats.materials is not None
        assert splats.materials.normals is not None
        along = tilted.triangles[:, 1] - tilted.triangles[:, 0]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        tangents = along, np.cross(tilted.face_normals, along)
        expected = 0.8 * tilted.face_normals + 0.6 * tangents[axis]
        cosines = splats.materials.normals @ expected.T
        assert np.median(cosines.max(axis=1)) > 0.99


def test_mtl_and_matt_materials_reach_the_gaussians(tmp_path: Path) -> None:
    for lines, expected in (
        ("Kd 1 1 1\nPr 0.3\nPm 1", (1.0, 0.3, 0.5)),
        ("Kd 1 1 1\nKs 0.5 0.5 0.5\nNs 30\nillum 2", (0.0, 0.5, 0.5)),
        ("Kd 1 1 1", (0.0, 1.0, 0.0)),
    ):
        found = bake_asset(write_obj(tmp_path, lines), name="box", settings=QUICK).asset.splats.materials
        assert found is not None
        values = np.stack([found.metallic, found.roughness, found.specular], axis=1)
        np.testing.assert_allclose(values, [expected] * len(found), atol=1e-6)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("Pr 30", r"box\.mtl: Pr, the roughness, must be a number from 0 to 1 \(got Pr 30\)"),
        ("Pm steel", r"box\.mtl: Pm, the metalness, must be a number from 0 to 1 \(got Pm steel\)"),
        ("Pm nan", r"box\.mtl: Pm, the metalness, must be a number from 0 to 1 \(got Pm nan\)"),
    ],
)
def test_mtl_roughness_and_metalness_out_of_range_are_refused(tmp_path: Path, line: str, sentence: str) -> None:
    """They were limited to the range, or left out."""
    with pytest.raises(InputError, match=sentence):
        read_model(write_obj(tmp_path, line))


def test_texture_without_a_factor_is_not_scaled() -> None:
    image = Image.new("RGB", (4, 4), COLOUR)
    np.testing.assert_array_equal(read_material(SimpleMaterial(image=image)).factor, 1.0)
    given = read_material(SimpleMaterial(image=image, diffuse=[51, 51, 51, 255]))
    np.testing.assert_allclose(given.factor, decode_srgb(0.2), rtol=1e-6)


def test_a_given_finish_replaces_the_material_of_the_file(tmp_path: Path) -> None:
    part = part_of(tmp_path, "map_Kd colour.png", colour=(0.2, 0.4, 0.6))
    np.testing.assert_allclose(colour_of(part), decode_srgb(np.array([0.2, 0.4, 0.6])))
    assert (part.texture, part.shiny) == (None, False)
    part = part_of(tmp_path, "map_Kd colour.png", metallic=1.0, roughness=0.2)
    assert part.texture is not None
    assert (part.shiny, part.metallic, part.roughness) == (True, 1.0, 0.2)
    assert part.specular == pytest.approx(decode_srgb(np.array(COLOUR) / 255).mean(), abs=0.01)
    part = part_of(tmp_path, "Kd 1 1 1\nPr 0.3", specular=0.0)
    assert (part.shiny, part.specular) == (False, 0.0)
    part = part_of(tmp_path, "Kd 1 1 1", specular=0.08)
    assert (part.shiny, part.specular, part.roughness) == (True, pytest.approx(0.08), ROUGHNESS)
    part = part_of(tmp_path, "Kd 1 1 1", roughness=0.3)
    assert (part.shiny, part.specular, part.roughness) == (True, DIELECTRIC_SPECULAR, 0.3)


@pytest.mark.parametrize(
    ("finish", "sentence"),
    [
        ({"colour": "no such"}, "colour must be a name or #rrggbb, such as steelblue .got 'no such'."),
        ({"colour": (0.2, 0.4, 2.0)}, "colour must be red, green and blue from 0 to 1"),
        ({"roughness": -0.1}, "roughness must be from 0 to 1 .got -0.1."),
        ({"metallic": 2.0}, "metallic must be from 0 to 1 .got 2."),
        ({"metallic": float("nan")}, "metallic must be from 0 to 1 .got nan."),
        ({"specular": 0.5}, "specular must be from 0 to 0.08 .got 0.5. .for a metal, give metallic 1."),
    ],
)
def test_finishes_out_of_range_are_refused(finish: dict[str, object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        SurfaceFinish(**finish)  # type: ignore[arg-type]


def test_missing_textures_are_refused_unless_a_colour_is_given(tmp_path: Path) -> None:
    path = write_obj(tmp_path, "map_Kd absent.png")
    with pytest.raises(
        InputError, match=r"box\.mtl: its texture absent\.png is missing; put it there, or give a colour"
    ):
        read_model(path)
    assert read_model(path, finish=SurfaceFinish(colour="red")).parts
    (tmp_path / "box.mtl").unlink()
    with pytest.raises(InputError, match=r"box\.obj: its material file box\.mtl is missing") as missing:
        read_model(path)
    assert missing.value.__cause__ is not missing.value


@pytest.mark.parametrize("name", ["../colour.png", "{folder}/colour.png", "link.png"])
def test_textures_outside_of_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "in").mkdir()
    Image.new("RGB", (8, 8), COLOUR).save(tmp_path / "colour.png")
    (tmp_path / "in/link.png").symlink_to(tmp_path / "colour.png")
    name = name.replace("{folder}", str(tmp_path))
    path = write_obj(tmp_path / "in", f"map_Kd {name}")
    with pytest.raises(InputError, match=r"box\.mtl: its texture .* is outside of its folder; put it there"):
        read_model(path)
    (tmp_path / "in/box.mtl").rename(tmp_path / "box.mtl")
    path.write_text(path.read_text().replace("mtllib box.mtl", "mtllib ../box.mtl"))
    with pytest.raises(InputError, match=r"box\.obj: its material file \.\./box\.mtl is outside of its folder"):
        read_model(path)


def test_a_16_bit_grey_texture_keeps_its_brightness(tmp_path: Path) -> None:
    path = write_obj(tmp_path, "map_Kd colour.png")
    Image.fromarray(np.full((8, 8), 0x4080, dtype=np.uint16)).save(tmp_path / "colour.png")
    (part,) = read_model(path).parts
    np.testing.assert_allclose(colour_of(part), decode_srgb(np.full(3, 0x40 / 255)), atol=1e-3)


def test_textures_and_materials_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    path = write_obj(tmp_path, "map_Kd colour.png")
    cut = (tmp_path / "colour.png").read_bytes()[:-30]

    def refused(path: Path, match: str) -> None:
        with pytest.raises(InputError, match=match) as told:
            read_model(path)
        assert str(told.value).startswith(str(path.parent))

    (tmp_path / "colour.png").write_bytes(cut)
    refused(path, r"box\.mtl: its texture colour\.png cannot be read")
    for lines, match in (
        ("map_Kd -s 1 1 1 colour.png", "options of a texture are not supported"),
        ("newmtl other", r"its material paint is not in box\.mtl"),
    ):
        text = (lines + "\n") if lines.startswith("newmtl") else f"newmtl paint\n{lines}\n"
        (tmp_path / "box.mtl").write_text(text)
        refused(path, match)
    (tmp_path / "box.mtl").write_bytes("newmtl gr\u00fcn\n".encode("cp1252"))
    refused(path, "names must be UTF-8: save it so, or rename it .got newmtl gr\u00fcn.")
    (tmp_path / "other.mtl").write_text("newmtl other\n")
    path.write_text(path.read_text().replace("mtllib box.mtl", "mtllib box.mtl other.mtl"))
    refused(path, r"must have one material file .got box\.mtl other\.mtl.")
    box().export(tmp_path / "plain.ply", encoding="ascii")
    text = (tmp_path / "plain.ply").read_text()
    (tmp_path / "plain.ply").write_text(text.replace("comment", "comment TextureFile absent.png\ncomment", 1))
    refused(tmp_path / "plain.ply", r"its texture absent\.png is missing")
    trimesh.Scene(box(TextureVisuals(np.zeros((36, 2)), material=PBRMaterial()))).export(tmp_path / "model.gltf")
    document = json.loads((tmp_path / "model.gltf").read_text())
    document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    document |= {"textures": [{"source": 0}], "images": [{"uri": "not%20there.png"}]}
    (tmp_path / "model.gltf").write_text(json.dumps(document))
    refused(tmp_path / "model.gltf", r"its texture not there\.png is missing")
    document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"] = 7
    (tmp_path / "model.gltf").write_text(json.dumps(document))
    refused(tmp_path / "model.gltf", "a material's texture 7 is missing")


def test_meshes_with_invalid_faces_are_refused(tmp_path: Path) -> None:
    (tmp_path / "far.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    (tmp_path / "empty.glb").write_bytes(b"")
    for name in ("far.obj", "empty.glb"):
        with pytest.raises(InputError, match=name):
            read_model(tmp_path / name)


def test_a_missing_reader_of_a_format_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "box.dae").write_text("<COLLADA/>")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingResourceError, match=r"box\.dae: reading it needs `pip install pycollada`"):
        read_model(tmp_path / "box.dae")


@pytest.mark.parametrize("gaussians", [1, 2])
def test_one_or_two_gaussians_can_be_asked_for(gaussians: int) -> None:
    result = bake_asset(box(), name="box", settings=replace(QUICK, gaussians=gaussians))
    assert 0 < len(result.asset.splats) <= 12
