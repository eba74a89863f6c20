"""glTF: the texel that a point shows follows from the coordinates that the file defines, worked out here separately."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.bake.proxy_mesh import make_proxy
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.images.colour import encode_srgb
from mitsplat.mesh_files.mesh_reading import read_mesh
from tests.mesh_files.glb import CORNER_UV, CORNERS, QUAD, SIZE, Glb, coordinate_image, cube_mesh, matt, sheet

pytestmark = pytest.mark.usefixtures("without_trial")


WEIGHTS = np.array([(0.5, 0.3, 0.2), (0.1, 0.6, 0.3), (0.2, 0.15, 0.65)])


def samples(part: MeshPart) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) of a part, and the image coordinates (N, 2), v down, of the texels that they show."""
    faces = np.repeat(np.arange(len(part.mesh.faces)), len(WEIGHTS))
    weights = np.tile(WEIGHTS, (len(part.mesh.faces), 1))
    shown = 255.0 * encode_srgb(part.colours_at(faces, weights))
    return np.einsum("nk,nkd->nd", weights, part.mesh.triangles[faces]), (shown[:, :2] / 4 + 0.5) / 64


def read(path: Path) -> tuple[MeshPart, ...]:
    """Read a file in its own axes."""
    return read_model(path, up="z").parts


def shown_uv(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates (N, 2) within the sheet, v down, and those of the texels that it shows there."""
    (part,) = read(path)
    points, texels = samples(part)
    return np.stack([points[:, 0] / SIZE, 1.0 - points[:, 1] / SIZE], axis=1), texels


def test_a_sheet_shows_its_texture(tmp_path: Path) -> None:
    uv, texels = shown_uv(sheet().save(tmp_path / "a.glb"))
    np.testing.assert_allclose(texels, uv, atol=0.01)


@pytest.mark.parametrize(
    "nodes",
    [
        [{"mesh": 0, "scale": [-1, 1, 1]}],
        [{"mesh": 0, "scale": [1, -2, 1], "translation": [0.3, 0, 0]}],
        [{"children": [1], "scale": [-1, -1, -1]}, {"mesh": 0, "rotation": [0, 0, 0.6, 0.8]}],
        [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0.1, 0.2, 0.3, 1]}],
        [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "scale": [-1, 1, 1], "translation": [-0.05, 0, 0]}],
    ],
)
def test_mirrored_nodes_show_the_mirrored_texture(tmp_path: Path, nodes: list[dict[str, Any]]) -> None:
    """Each side of the cube shows the image along its two other axes, whatever the node's transform is."""
    glb = Glb()
    positions, uv, faces = cube_mesh()
    attributes = {"POSITION": glb.accessor(positions), "TEXCOORD_0": glb.accessor(uv)}
    glb.mesh(attributes, glb.accessor(faces), matt(glb.texture()))
    parts = read(glb.save(tmp_path / "mirrored.glb", nodes=nodes))
    for part, node in zip(parts, [node for node in nodes if "mesh" in node], strict=True):
        pose = pose_of(node) if "children" not in nodes[0] else pose_of(nodes[0]) @ pose_of(node)
        assert part.mesh.volume == pytest.approx(SIZE**3 * abs(np.linalg.det(pose)), rel=1e-5)
        points, texels = samples(part)
        local = (points - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T / SIZE
        side = np.abs(local - 0.5).argmax(axis=1)
        wanted = np.array([np.delete(place, axis) for place, axis in zip(local, side, strict=True)])
        np.testing.assert_allclose(texels, wanted, atol=0.015)


def pose_of(node: dict[str, Any]) -> np.ndarray:
    """Compute the pose of a node by quaternion algebra."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose = np.eye(4)
    pose[:3, :3] = np.array(turn) @ np.diag(node.get("scale", (1, 1, 1)))
    pose[:3, 3] = node.get("translation", (0, 0, 0))
    return pose


def test_instances_of_a_node_are_placed_and_may_be_mirrored(tmp_path: Path) -> None:
    glb = sheet()
    attributes = {
        "TRANSLATION": glb.accessor(np.array([(0, 0, 0), (0.5, 0, 0)], np.float32)),
        "SCALE": glb.accessor(np.array([(1, 1, 1), (-1, 1, 1)], np.float32)),
    }
    node = {"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}}
    first, second = read(glb.save(tmp_path / "a.glb", nodes=[node], extensionsRequired=["EXT_mesh_gpu_instancing"]))
    np.testing.assert_allclose(first.mesh.bounds[:, 0], (0, SIZE), atol=1e-7)
    np.testing.assert_allclose(second.mesh.bounds[:, 0], (0.5 - SIZE, 0.5), atol=1e-7)
    points, texels = samples(second)
    np.testing.assert_allclose(texels[:, 0], (0.5 - points[:, 0]) / SIZE, atol=0.01)


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        ({"scale": [0.5, 0.25], "offset": [0.5, 0.125]}, lambda u, v: (0.5 * u + 0.5, 0.25 * v + 0.125)),
        # The example of the specification: the lower left quadrant of the image, turned clockwise by 90 degrees.
        ({"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}, lambda u, v: (0.5 * v, 1 - 0.5 * u)),
        ({"offset": [0, 1], "scale": [1, -1]}, lambda u, v: (u, 1 - v)),
    ],
)
def test_a_texture_transform_selects_part_of_the_image(tmp_path: Path, transform: Any, expected: Any) -> None:
    glb = sheet(extensions={"KHR_texture_transform": transform})
    uv, texels = shown_uv(glb.save(tmp_path / "a.glb", extensionsRequired=["KHR_texture_transform"]))
    np.testing.assert_allclose(texels, np.stack(expected(*uv.T), axis=1), atol=0.01)


@pytest.mark.parametrize("info", [{"texCoord": 1}, {"extensions": {"KHR_texture_transform": {"texCoord": 1}}}])
def test_each_texture_uses_its_own_set_of_coordinates(tmp_path: Path, info: dict[str, Any]) -> None:
    """The base colour uses the second set, which is turned; the normal map and the gloss use the first set."""
    glb = Glb()
    attributes = {
        "POSITION": glb.accessor(CORNERS),
        "TEXCOORD_0": glb.accessor(CORNER_UV),
        "TEXCOORD_1": glb.accessor(CORNER_UV[:, ::-1].copy()),
    }
    texture = glb.texture()
    material = matt(texture, **info) | {"normalTexture": {"index": texture}}
    material["pbrMetallicRoughness"]["metallicRoughnessTexture"] = {"index": texture}
    glb.mesh(attributes, glb.accessor(QUAD), material)
    path = glb.save(tmp_path / "a.glb")
    uv, texels = shown_uv(path)
    np.testing.assert_allclose(texels, uv[:, ::-1], atol=0.01)
    (part,) = read(path)
    assert part.normal_map is not None
    np.testing.assert_allclose(part.normal_map.uv[0, 1], (1, 0))
    gloss = part.materials_at(np.zeros(1, int), np.array([[0.5, 0.3, 0.2]]))
    np.testing.assert_allclose(gloss[0, 1], 0.8, atol=0.02)  # green is four times the row, v = 0.8


@pytest.mark.parametrize(
    ("wrap", "expected"),
    [
        (10497, lambda t: t % 1),
        (33071, lambda t: np.clip(t, 0, 1)),
        (33648, lambda t: np.abs((t + 1) % 2 - 1)),
    ],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_a_sampler_continues_the_image_along_each_axis(tmp_path: Path, wrap: int, expected: Any, axis: int) -> None:
    glb = sheet(uv=3.0 * CORNER_UV - 1.0, sampler={f"wrap{'ST'[axis]}": wrap})
    uv, texels = shown_uv(glb.save(tmp_path / "a.glb"))
    wanted = (3.0 * uv - 1.0) % 1
    wanted[:, axis] = expected(3.0 * uv[:, axis] - 1.0)
    np.testing.assert_allclose(texels, wanted, atol=0.015)


@pytest.mark.parametrize(("kind", "largest"), [("i1", 127), ("u1", 255), ("i2", 32767), ("u2", 65535)])
def test_quantised_positions_and_coordinates_have_their_size(tmp_path: Path, kind: str, largest: int) -> None:
    glb = Glb()
    ones = np.round(CORNERS / np.float32(SIZE) * largest).astype(kind)
    attributes = {
        "POSITION": glb.accessor(np.pad(ones, ((0, 0), (0, 1))), normalized=True, type="VEC3"),
        "TEXCOORD_0": glb.accessor(np.round(CORNER_UV * largest).astype(kind), normalized=True),
    }
    stride = 4 * np.dtype(kind).itemsize
    glb.document["bufferViews"][0]["byteStride"] = stride
    glb.mesh(attributes, glb.accessor(QUAD), matt(glb.texture()))
    nodes = [{"mesh": 0, "scale": [SIZE, SIZE, SIZE]}]
    path = glb.save(tmp_path / "a.glb", nodes=nodes, extensionsRequired=["KHR_mesh_quantization"])
    uv, texels = shown_uv(path)
    np.testing.assert_allclose(read(path)[0].mesh.extents, (SIZE, SIZE, 0), atol=1e-6)
    np.testing.assert_allclose(texels, uv, atol=0.015)


def test_integers_that_are_not_normalised_keep_their_values(tmp_path: Path) -> None:
    glb = Glb()
    positions = np.round(CORNERS / np.float32(SIZE) * 100).astype(np.int16)
    glb.mesh({"POSITION": glb.accessor(positions)}, glb.accessor(QUAD))
    (part,) = read(glb.save(tmp_path / "a.glb", nodes=[{"mesh": 0, "scale": [1e-3, 1e-3, 1e-3]}]))
    np.testing.assert_allclose(part.mesh.extents, (0.1, 0.1, 0))


def test_sparse_accessors_replace_single_elements(tmp_path: Path) -> None:
    glb = sheet()
    values = {"bufferView": glb.view(np.array([(0.2, 0.1, 0)], np.float32).tobytes())}
    indices = {"bufferView": glb.view(np.array([2], np.uint8).tobytes()), "componentType": 5121}
    glb.document["accessors"][0]["sparse"] = {"count": 1, "indices": indices, "values": values}
    (part,) = read(glb.save(tmp_path / "a.glb"))
    assert part.mesh.extents[0] == pytest.approx(0.2)


def test_draco_is_decoded_or_its_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draco = pytest.importorskip("DracoPy", reason="needs DracoPy: pip install 'mitsplat[draco]'")
    glb = sheet()
    packed = draco.encode(CORNERS, QUAD.reshape(-1, 3), quantization_bits=14, tex_coord=CORNER_UV.astype(float))
    ids = {one["attribute_type"]: one["unique_id"] for one in draco.decode(packed).attributes}
    stored = {"bufferView": glb.view(packed), "attributes": {"POSITION": ids[0], "TEXCOORD_0": ids[3]}}
    glb.document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": stored}
    for accessor in glb.document["accessors"]:
        del accessor["bufferView"]
    path = glb.save(tmp_path / "a.glb", extensionsRequired=["KHR_draco_mesh_compression"])
    uv, texels = shown_uv(path)
    np.testing.assert_allclose(texels, uv, atol=0.015)
    monkeypatch.setitem(__import__("sys").modules, "DracoPy", None)
    with pytest.raises(MissingResourceError, match=r"a\.glb: its geometry is compressed by Draco, which needs `pip"):
        read(path)


def test_other_compressions_are_refused_with_a_remedy(tmp_path: Path) -> None:
    glb = sheet()
    glb.document["bufferViews"][0] |= {"buffer": 1, "extensions": {"EXT_meshopt_compression": {"buffer": 0}}}
    packed = glb.save(tmp_path / "a.glb", buffers=[{"byteLength": 48}], extensionsRequired=["EXT_meshopt_compression"])
    with pytest.raises(
        InputError, match=r"a\.glb: its geometry is compressed by meshoptimizer .*gltf-transform/cli copy"
    ):
        read(packed)
    glb = sheet()
    glb.document["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
    path = glb.save(tmp_path / "b.glb", extensionsRequired=["KHR_texture_basisu"])
    with pytest.raises(
        InputError, match=r"b\.glb: its texture 0 is compressed as KTX2 .* ktxdecompress .* give a colour"
    ):
        read(path)
    glb.document["textures"][0]["source"] = 0
    uv, texels = shown_uv(glb.save(tmp_path / "c.glb"))
    np.testing.assert_allclose(texels, uv, atol=0.01)


def test_required_extensions_that_are_not_supported_are_named(tmp_path: Path) -> None:
    path = sheet().save(tmp_path / "a.glb", extensionsRequired=["KHR_texture_transform", "EXT_unheard", "KHR_also"])
    with pytest.raises(InputError, match=r"a\.glb: .* not supported: export it without EXT_unheard, KHR_also$"):
        read(path)


def material_of(tmp_path: Path, **changes: Any) -> MeshPart:
    glb = Glb()
    glb.mesh({"POSITION": glb.accessor(CORNERS)}, glb.accessor(QUAD), changes)
    (part,) = read(glb.save(tmp_path / "a.glb"))
    return part


def test_materials_follow_the_specification(tmp_path: Path) -> None:
    """Absent factors are 1 (glTF 2.0, 5.22); F0 = ((n - 1) / (n + 1))^2 (``KHR_materials_ior``)."""
    default = material_of(tmp_path)
    assert (default.metallic, default.roughness, default.shiny) == (1.0, 1.0, True)
    unlit = material_of(tmp_path, extensions={"KHR_materials_unlit": {}})
    assert not unlit.shiny
    assert material_of(tmp_path, extensions={"KHR_materials_ior": {"ior": 1.33}}).reflectance == pytest.approx(
        0.02006, rel=1e-3
    )
    half = {"KHR_materials_specular": {"specularFactor": 0.5}}
    assert material_of(tmp_path, extensions=half).reflectance == pytest.approx(0.02)
    old = {"diffuseFactor": [0.2, 0.4, 0.6, 1], "specularFactor": [0.05, 0.05, 0.05], "glossinessFactor": 0.7}
    part = material_of(tmp_path, extensions={"KHR_materials_pbrSpecularGlossiness": old})
    assert (part.metallic, part.roughness, part.reflectance) == (0.0, pytest.approx(0.3), pytest.approx(0.05))
    assert part.colours is not None
    np.testing.assert_allclose(part.colours[0, 0], (0.2, 0.4, 0.6))


def test_colours_of_vertices_are_fractions(tmp_path: Path) -> None:
    glb = Glb()
    colours = glb.accessor(np.full((4, 3), 255.0, dtype=np.float32))
    glb.mesh({"POSITION": glb.accessor(CORNERS), "COLOR_0": colours}, glb.accessor(QUAD))
    with pytest.raises(InputError, match=r"colours of vertices must be within 0 to 1 \(got 255\)"):
        read_model(glb.save(tmp_path / "a.glb"))


def test_a_node_of_scale_0_is_hidden(tmp_path: Path) -> None:
    glb = Glb()
    glb.mesh({"POSITION": glb.accessor(CORNERS)}, glb.accessor(QUAD))
    glb.document["nodes"] = [{"mesh": 0, "scale": [0, 0, 0], "translation": [9, 0, 0]}, {"mesh": 0}]
    glb.document["scenes"] = [{"nodes": [0, 1]}]
    assert len(read_model(glb.save(tmp_path / "a.glb")).parts) == 1


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"extensions": {"KHR_materials_clearcoat": {}, "KHR_materials_sheen": {}}}, "clearcoat, .*sheen are left out"),
        ({"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]}}, "it is transparent"),
        ({"emissiveFactor": [1, 0, 0]}, "emits light"),
        ({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}, "TEXCOORD_0, which are missing"),
    ],
)
def test_ignored_properties_of_a_material_are_reported(tmp_path: Path, changes: Any, sentence: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Glb, "save", with_texture(Glb.save))
        (warning,) = material_of(tmp_path, **changes).warnings
    assert __import__("re").search(sentence, warning)


@pytest.mark.parametrize(("cutoff", "alpha"), [(None, 1.0), (0.25, 1.0), (0.25, 0.5), (1.5, 1.0)])
def test_masked_texels_are_cut_out(tmp_path: Path, cutoff: float | None, alpha: float) -> None:
    """Opacity grows from left to right, so that the right part of the sheet remains, with its texture."""
    image = coordinate_image()
    image.putalpha(Image.fromarray(np.tile(np.arange(64, dtype=np.uint8) * 4, (64, 1))))
    glb = Glb()
    attributes = {"POSITION": glb.accessor(CORNERS), "TEXCOORD_0": glb.accessor(CORNER_UV)}
    material = matt(glb.texture(image)) | {"alphaMode": "MASK"} | ({} if cutoff is None else {"alphaCutoff": cutoff})
    material["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 1, alpha]
    glb.mesh(attributes, glb.accessor(QUAD), material)
    path = glb.save(tmp_path / "a.glb")
    if cutoff == 1.5:
        with pytest.raises(InputError, match="faces that have an area"):
            read(path)
        return
    (part,) = read(path)
    edge = (cutoff or 0.5) / alpha
    assert part.mesh.area == pytest.approx((1 - edge) * SIZE**2, rel=0.02) and part.warnings == ()
    assert part.mesh.bounds[0, 0] == pytest.approx(edge * SIZE, abs=1.5 * SIZE / 64)
    points, texels = samples(part)
    np.testing.assert_allclose(texels, np.stack([points[:, 0] / SIZE, 1.0 - points[:, 1] / SIZE], axis=1), atol=0.01)


@pytest.mark.parametrize("has_texture", [False, True])
def test_opacity_of_vertex_colours_is_cut_out(tmp_path: Path, has_texture: bool) -> None:
    """It grows from left to right, and multiplies that of a texture, which is 0.8 everywhere."""
    glb = Glb()
    colours = np.c_[np.ones((4, 3)), CORNERS[:, 0] / SIZE].astype(np.float32)
    attributes = {"POSITION": glb.accessor(CORNERS), "COLOR_0": glb.accessor(colours)}
    material = matt()
    if has_texture:
        attributes["TEXCOORD_0"] = glb.accessor(CORNER_UV)
        material = matt(glb.texture(Image.new("RGBA", (64, 64), (255, 0, 0, 204))))
    glb.mesh(attributes, glb.accessor(QUAD), material | {"alphaMode": "MASK"})
    (part,) = read(glb.save(tmp_path / "a.glb"))
    edge = 0.5 / 0.8 if has_texture else 0.5
    assert part.mesh.area == pytest.approx((1 - edge) * SIZE**2, rel=0.05)
    glb.document["materials"][0]["alphaMode"] = "BLEND"
    (part,) = read(glb.save(tmp_path / "b.glb"))
    assert any("colours of its vertices are transparent" in warning for warning in part.warnings)


def test_transparent_entries_of_a_palette_are_reported(tmp_path: Path) -> None:
    glb, image = Glb(), Image.new("P", (8, 8))
    image.putpalette([200, 100, 50])
    image.info["transparency"] = 0
    attributes = {"POSITION": glb.accessor(CORNERS), "TEXCOORD_0": glb.accessor(CORNER_UV)}
    glb.mesh(attributes, glb.accessor(QUAD), matt(glb.texture(image)) | {"alphaMode": "BLEND"})
    (part,) = read(glb.save(tmp_path / "a.glb"))
    assert "transparent texels" in part.warnings[0]


def test_the_scene_that_is_read_is_named_if_there_are_several(tmp_path: Path) -> None:
    glb = sheet()
    glb.document["nodes"].append({"mesh": 0, "scale": [2, 2, 2]})
    path = glb.save(tmp_path / "a.glb", scene=1, scenes=[{"nodes": [0]}, {"nodes": [1]}])
    model = read_model(path)
    assert model.warnings == ("it has 2 scenes, of which only scene 1 is read",)
    assert model.parts[0].mesh.extents.max() == pytest.approx(2 * SIZE)


def test_morph_targets_change_colours_and_texture_coordinates(tmp_path: Path) -> None:
    glb = Glb()
    black, red = np.zeros((4, 3), np.float32), np.float32([[1, 0, 0]] * 4)
    attributes = {"POSITION": glb.accessor(CORNERS), "COLOR_0": glb.accessor(black)}
    glb.mesh(attributes, glb.accessor(QUAD), matt(), targets=[{"COLOR_0": glb.accessor(red)}])
    glb.document["meshes"][0]["weights"] = [1.0]
    (part,) = read(glb.save(tmp_path / "a.glb"))
    np.testing.assert_allclose(part.colours_at(np.arange(2), np.full((2, 3), 1 / 3)), [(1, 0, 0)] * 2)
    glb = sheet(uv=np.zeros((4, 2)))
    glb.document["meshes"][0]["primitives"][0]["targets"] = [{"TEXCOORD_0": glb.accessor(CORNER_UV)}]
    glb.document["nodes"][0]["weights"] = [1.0]
    expected, texels = shown_uv(glb.save(tmp_path / "b.glb"))
    np.testing.assert_allclose(texels, expected, atol=0.01)


def test_joints_outside_of_the_scene_are_refused(tmp_path: Path) -> None:
    glb = Glb()
    weights = np.float32([[1, 0, 0, 0]] * 4)
    skin = {"JOINTS_0": glb.accessor(np.zeros((4, 4), np.uint8)), "WEIGHTS_0": glb.accessor(weights)}
    glb.mesh({"POSITION": glb.accessor(CORNERS), **skin}, glb.accessor(QUAD))
    glb.document["nodes"] = [{"mesh": 0, "skin": 0}, {}]
    path = glb.save(tmp_path / "a.glb", skins=[{"joints": [1]}])
    with pytest.raises(InputError, match="joint 1 of a skin is not in the scene"):
        read(path)


def test_the_proxy_of_a_cut_out_has_its_outline(tmp_path: Path) -> None:
    image = coordinate_image()
    row, column = np.mgrid[:64, :64] - 31.5
    image.putalpha(Image.fromarray(np.where(np.hypot(row, column) < 25, 255, 0).astype(np.uint8)))
    glb = Glb()
    attributes = {"POSITION": glb.accessor(CORNERS), "TEXCOORD_0": glb.accessor(CORNER_UV)}
    glb.mesh(attributes, glb.accessor(QUAD), matt(glb.texture(image)) | {"alphaMode": "MASK", "doubleSided": True})
    proxy = make_proxy(read(glb.save(tmp_path / "a.glb")), 1000)
    assert proxy.area == pytest.approx(np.pi * 25**2 * (SIZE / 64) ** 2, rel=0.02)
    assert len(proxy.faces) < 1000


def with_texture(save: Any) -> Any:
    def saved(glb: Glb, path: Path) -> Path:
        glb.texture()
        return save(glb, path)

    return saved


def test_only_open_surfaces_are_double_sided(tmp_path: Path) -> None:
    """The inside of a closed body is never seen."""
    glb = sheet()
    glb.document["materials"][0]["doubleSided"] = True
    assert read(glb.save(tmp_path / "a.glb"))[0].double_sided
    glb = Glb()
    positions, _, faces = cube_mesh()
    glb.mesh({"POSITION": glb.accessor(positions)}, glb.accessor(faces), matt() | {"doubleSided": True})
    assert not read(glb.save(tmp_path / "b.glb"))[0].double_sided


@pytest.mark.parametrize(("mode", "indices"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3]), (4, [0, 1, 2, 0, 2, 3])])
def test_strips_and_fans_make_the_same_faces(tmp_path: Path, mode: int, indices: list[int]) -> None:
    glb = Glb()
    glb.mesh({"POSITION": glb.accessor(CORNERS)}, glb.accessor(np.array(indices, np.uint16)), mode=mode)
    (part,) = read(glb.save(tmp_path / "a.glb"))
    np.testing.assert_allclose(part.mesh.face_normals, [(0, 0, 1)] * 2)
    assert part.mesh.area == pytest.approx(SIZE**2)


def test_hidden_nodes_points_and_lines_are_left_out(tmp_path: Path) -> None:
    glb = sheet()
    glb.mesh({"POSITION": 0}, mode=0)
    hidden = {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]}
    nodes = [{"mesh": 0, "children": [1, 3]}, hidden, {"mesh": 0}, {"mesh": 1}]
    model = read_model(glb.save(tmp_path / "a.glb", nodes=nodes))
    assert len(model.parts) == 1
    assert model.warnings == ("its points and lines are left out",)


def test_skins_and_morph_targets_have_the_pose_of_the_file(tmp_path: Path) -> None:
    """Half of the sheet follows a joint that is 0.3 m higher; the node of a skinned mesh does not move it."""
    glb = sheet()
    joints = np.zeros((4, 4), np.uint8)
    joints[2:, 0] = 1
    weights = np.tile(np.array([1, 0, 0, 0], np.float32), (4, 1))
    attributes = glb.document["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {"JOINTS_0": glb.accessor(joints), "WEIGHTS_0": glb.accessor(weights)}
    skins, nodes = [{"joints": [1, 2]}], [{"mesh": 0, "skin": 0, "translation": [9, 9, 9], "children": []}]
    nodes = [*nodes, {"children": [2]}, {"translation": [0, 0, 0.3]}]
    scenes = [{"nodes": [0, 1]}]
    (part,) = read(glb.save(tmp_path / "a.glb", nodes=nodes, skins=skins, scenes=scenes))
    np.testing.assert_allclose(part.mesh.bounds, [(0, 0, 0), (SIZE, SIZE, 0.3)], atol=1e-6)
    glb = sheet()
    target = {"POSITION": glb.accessor(np.array([(0, 0, 1)] * 4, np.float32))}
    glb.document["meshes"][0]["primitives"][0]["targets"] = [target]
    (part,) = read(glb.save(tmp_path / "b.glb", nodes=[{"mesh": 0, "weights": [0.25]}]))
    np.testing.assert_allclose(part.mesh.bounds[:, 2], 0.25)


def test_vertices_may_follow_more_than_four_joints(tmp_path: Path) -> None:
    """The fifth joint has the whole weight."""
    glb = sheet()
    first, second = np.tile(np.arange(4, dtype=np.uint8), (4, 1)), np.full((4, 4), 4, np.uint8)
    weights = np.tile(np.array([1, 0, 0, 0], np.float32), (4, 1))
    attributes = glb.document["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {"JOINTS_0": glb.accessor(first), "WEIGHTS_0": glb.accessor(0 * weights)}
    attributes |= {"JOINTS_1": glb.accessor(second), "WEIGHTS_1": glb.accessor(weights)}
    nodes = [{"mesh": 0, "skin": 0}, *({"translation": [0, 0, 0.1 * k]} for k in range(5))]
    scenes, skins = [{"nodes": list(range(6))}], [{"joints": [1, 2, 3, 4, 5]}]
    (part,) = read(glb.save(tmp_path / "a.glb", nodes=nodes, skins=skins, scenes=scenes))
    np.testing.assert_allclose(part.mesh.bounds[:, 2], 0.4, atol=1e-6)


def test_data_and_files_of_uris_are_read(tmp_path: Path) -> None:
    glb = sheet()
    (tmp_path / "my data.bin").write_bytes(glb.data)
    encoded = "data:application/octet-stream;base64," + base64.b64encode(glb.data).decode()
    for uri in ("my%20data.bin", encoded):
        buffers = [{"byteLength": len(glb.data), "uri": uri}]
        (tmp_path / "a.gltf").write_text(json.dumps({**glb.document, "buffers": buffers}))
        uv, texels = shown_uv(tmp_path / "a.gltf")
        np.testing.assert_allclose(texels, uv, atol=0.01)
    (tmp_path / "in").mkdir()
    for uri, fault in (("../my%20data.bin", "outside of its folder"), ("none.bin", "is missing")):
        (tmp_path / "in/a.gltf").write_text(json.dumps({**glb.document, "buffers": [{"byteLength": 8, "uri": uri}]}))
        with pytest.raises(InputError, match=rf"a\.gltf: its buffer .* {fault}"):
            read(tmp_path / "in/a.gltf")


@pytest.mark.parametrize(
    "change",
    [
        {"nodes": [{"children": [0], "mesh": 0}]},
        {"nodes": [{"mesh": 7}]},
        {"accessors": [{"componentType": 5126, "count": 4, "type": "VEC3", "bufferView": 99}]},
        {"asset": {"version": "1.0"}},
        {"scenes": [], "scene": 3},
        {"bufferViews": []},
    ],
)
def test_damaged_documents_are_refused_in_one_sentence(tmp_path: Path, change: dict[str, Any]) -> None:
    path = sheet().save(tmp_path / "a.glb", **change)
    with pytest.raises(InputError, match=r"a\.glb: not a mesh that can be read \("):
        read(path)


def test_a_texture_of_a_file_is_read_once_for_all_its_parts(tmp_path: Path) -> None:
    glb = sheet()
    nodes = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [0, 0, 1]}]
    first, second = read(glb.save(tmp_path / "a.glb", nodes=nodes))
    assert first.texture is not None and second.texture is not None
    assert first.texture.pixels is second.texture.pixels
    assert first.name == second.name == "sheet"


def test_an_image_that_is_no_image_is_refused(tmp_path: Path) -> None:
    glb = sheet()
    Image.new("RGB", (4, 4)).save(tmp_path / "cut.png")
    glb.document["images"][0] = {"uri": "cut.png"}
    (tmp_path / "cut.png").write_bytes((tmp_path / "cut.png").read_bytes()[:40])
    with pytest.raises(InputError, match=r"a\.glb: its texture cut\.png cannot be read"):
        read(glb.save(tmp_path / "a.glb"))


def test_proxy_meshes_of_assets_and_scenes_have_the_same_geometry(tmp_path: Path) -> None:
    """A quantised cube, mirrored by its node: ``mesh`` of ``asset.yaml`` and of ``shapes`` has the axes of the file."""
    glb = Glb()
    positions, _, faces = cube_mesh()
    ones = np.pad(np.round(positions / np.float32(SIZE) * 127).astype(np.int8), ((0, 0), (0, 1)))
    position = glb.accessor(ones, normalized=True, type="VEC3")
    glb.document["bufferViews"][0]["byteStride"] = 4
    glb.mesh({"POSITION": position}, glb.accessor(faces))
    mesh = read_mesh(glb.save(tmp_path / "a.glb", nodes=[{"mesh": 0, "scale": [-SIZE, SIZE, 2 * SIZE]}]))
    np.testing.assert_allclose(mesh.bounds, [(-SIZE, 0, 0), (0, SIZE, 2 * SIZE)], atol=1e-7)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(2 * SIZE**3)


def _normal_mapped(scale: object, tmp_path: Path, **factors: object) -> Path:
    """Save a sheet with the normal (0.6, 0, 0.8) everywhere, and factors of its material."""
    glb = Glb()
    attributes = {"POSITION": glb.accessor(CORNERS), "TEXCOORD_0": glb.accessor(CORNER_UV)}
    texture = glb.texture(Image.new("RGB", (2, 2), (204, 128, 230)))
    material = {"normalTexture": {"index": texture, "scale": scale}, "pbrMetallicRoughness": factors}
    glb.mesh(attributes, glb.accessor(QUAD), material)
    return glb.save(tmp_path / "a.glb")


@pytest.mark.parametrize("scale", [0, 0.5, 5, -1])
def test_scale_of_a_normal_map_multiplies_its_slopes(scale: float, tmp_path: Path) -> None:
    """glTF 2.0, 3.9.3: normalize((2 texel - 1) * (scale, scale, 1))."""
    (part,) = read(_normal_mapped(scale, tmp_path))
    normal = part.normals_at(np.zeros(1, int), np.full((1, 3), 1 / 3))[0]
    expected = np.array([0.6 * scale, 0.0, 0.8]) / np.hypot(0.6 * scale, 0.8)
    along, up = normal @ [1, 0, 0], abs(normal @ part.mesh.face_normals[0])
    np.testing.assert_allclose((along, up), (expected[0], expected[2]), atol=0.02)


@pytest.mark.parametrize(
    ("scale", "factors", "message"),
    [
        ("1", {}, r"scale of a normal map must be a finite number \(got 1\)"),
        (1, {"metallicFactor": 3}, r"metallicFactor of a material must be from 0 to 1 \(got 3\)"),
        (1, {"roughnessFactor": -1}, r"roughnessFactor of a material must be from 0 to 1 \(got -1\)"),
        (1, {"metallicFactor": float("nan")}, r"metallicFactor of a material must be from 0 to 1 \(got nan\)"),
    ],
)
def test_material_factors_out_of_range_are_refused(
    scale: object, factors: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        read(_normal_mapped(scale, tmp_path, **factors))
