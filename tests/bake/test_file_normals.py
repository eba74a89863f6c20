"""Normals of mesh files against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image

from mitsplat.asset import Asset
from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.bake.mesh_parts import read_model
from mitsplat.bake.surface_materials import SurfaceFinish
from mitsplat.errors import InputError
from mitsplat.geometry.mesh_normals import corner_normals, normal_matrix, smooth_normals, stated_normals
from mitsplat.images.colour import decode_srgb
from mitsplat.runtime.variant import ensure_variant
from tests.mesh_files.glb import Glb

QUICK = BakeSettings(gaussians=200, fit_steps=0, verify_views=0)
RADIUS = 0.05


@pytest.fixture(autouse=True, scope="module")
def _variant() -> None:
    ensure_variant()


def ball() -> tuple[trimesh.Trimesh, np.ndarray]:
    """Build a sphere of 128 faces in steps of 36 and 45 degrees, and its exact normals at the vertices."""
    mesh = trimesh.creation.uv_sphere(RADIUS, count=[5, 8])
    assert len(mesh.faces) == 128
    return mesh, mesh.vertices / RADIUS


def glb(path: Path, mesh: trimesh.Trimesh, normals: np.ndarray, **node: object) -> Path:
    """Write a mesh with normals at its vertices, which lie in the axes of glTF: y up."""
    made = Glb()
    attributes = {"POSITION": made.accessor(mesh.vertices.astype("f4")), "NORMAL": made.accessor(normals.astype("f4"))}
    made.mesh(attributes, made.accessor(mesh.faces.ravel().astype("u4")))
    made.document["nodes"] = [{"mesh": 0, **node}]
    return made.save(path.with_suffix(".glb"))


def quantised_glb(path: Path, mesh: trimesh.Trimesh, normals: np.ndarray) -> Path:
    """Write normals as signed bytes (``KHR_mesh_quantization``), padded to four bytes."""
    made = Glb()
    padded = np.pad(np.rint(127 * normals), ((0, 0), (0, 1))).astype("i1")
    view = made.view(padded.tobytes(), byteStride=4)
    made.document["accessors"].append(
        {"bufferView": view, "componentType": 5120, "count": len(normals), "type": "VEC3", "normalized": True}
    )
    made.mesh(
        {"NORMAL": 0, "POSITION": made.accessor(mesh.vertices.astype("f4"))},
        made.accessor(mesh.faces.ravel().astype("u4")),
    )
    return made.save(path.with_suffix(".glb"), extensionsRequired=["KHR_mesh_quantization"])


def trimesh_file(path: Path, mesh: trimesh.Trimesh, normals: np.ndarray, **options: object) -> Path:
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, process=False)
    made.export(path, **options)
    return path


def trimesh_glb(path: Path, mesh: trimesh.Trimesh, normals: np.ndarray) -> Path:
    return trimesh_file(path.with_suffix(".glb"), mesh, normals, include_normals=True)


def trimesh_obj(path: Path, mesh: trimesh.Trimesh, normals: np.ndarray) -> Path:
    return trimesh_file(path.with_suffix(".obj"), mesh, normals, include_normals=True)


def ply(path: Path, mesh: trimesh.Trimesh, normals: np.ndarray) -> Path:
    return trimesh_file(path.with_suffix(".ply"), mesh, normals, vertex_normal=True)


def text_ply(path: Path, mesh: trimesh.Trimesh, normals: np.ndarray) -> Path:
    return trimesh_file(path.with_suffix(".ply"), mesh, normals, vertex_normal=True, encoding="ascii")


def obj(corner: str, material: bool = False) -> Callable[[Path, trimesh.Trimesh, np.ndarray], Path]:
    """Return a writer of OBJ files with corners of the form ``corner``, and normals in another order than vertices."""

    def write(path: Path, mesh: trimesh.Trimesh, normals: np.ndarray) -> Path:
        count = len(normals)
        lines = ["mtllib a.mtl", "usemtl grey"] if material else []
        lines += ["v {} {} {}".format(*v) for v in mesh.vertices]
        lines += [f"vt {k / count} 0.5" for k in range(count)] if "t" in corner else []
        lines += ["vn {} {} {}".format(*n) for n in 3 * normals[::-1]]
        corners = [[corner.format(v=v + 1, n=count - v, t=v + 1) for v in face] for face in mesh.faces]
        lines += ["s 1", *("f " + " ".join(face) for face in corners)]
        (path.parent / "a.mtl").write_text("newmtl grey\nKd 0.5 0.5 0.5\n")
        path.with_suffix(".obj").write_text("\n".join(lines))
        return path.with_suffix(".obj")

    return write


WRITERS = {
    "glb": glb,
    "quantised": quantised_glb,
    "trimesh glb": trimesh_glb,
    "trimesh obj": trimesh_obj,
    "ply": ply,
    "text ply": text_ply,
    "obj": obj("{v}//{n}"),
    "obj with coordinates": obj("{v}/{t}/{n}"),
    "obj with a material": obj("{v}//{n}", material=True),
    "obj with both": obj("{v}/{t}/{n}", material=True),
}


@pytest.mark.parametrize("writer", WRITERS.values(), ids=WRITERS)
def test_exact_normals_of_a_coarse_sphere_reach_its_proxy(
    writer: Callable[[Path, trimesh.Trimesh, np.ndarray], Path], tmp_path: Path
) -> None:
    """The interpolated normals at the centres of the faces are radial. Computed ones are 20 degrees off."""
    (bare,) = read_model(ball()[0]).parts
    assert np.abs(smooth_normals(bare.mesh) - bare.mesh.triangles / RADIUS).max() > 0.3
    path = writer(tmp_path / "ball", *ball())
    baked = bake_asset(path, name="ball", settings=QUICK)
    assert not [one for one in baked.warnings if "normals" in one]
    baked.asset.save(tmp_path / "asset")
    mesh = Asset.load(tmp_path / "asset").mesh
    assert mesh is not None
    assert mesh.is_watertight
    for scale, turned in ((1.0, mesh), (3.0, mesh.copy().apply_scale(3.0))):
        normals = smooth_normals(turned).mean(axis=1)
        radial = turned.triangles_center / np.linalg.norm(turned.triangles_center, axis=1, keepdims=True)
        cosine = (normals * radial).sum(axis=1) / np.linalg.norm(normals, axis=1)
        assert np.degrees(np.arccos(cosine.min())) < 0.6
        np.testing.assert_allclose(smooth_normals(turned), turned.triangles / (scale * RADIUS), atol=0.01)
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.9]))
    turned = mesh.copy().apply_transform(turn)
    np.testing.assert_allclose(smooth_normals(turned), smooth_normals(mesh) @ turn[:3, :3].T, atol=1e-5)


def split(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return the faces of a mesh without common vertices, and their plane normals at the vertices."""
    apart = trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False)
    return apart, np.repeat(mesh.face_normals, 3, axis=0)


@pytest.mark.parametrize(
    "body", [trimesh.creation.cylinder(0.02, 0.03, sections=24), trimesh.creation.icosphere(1, 0.02)]
)
def test_split_normals_keep_facets_plane(body: trimesh.Trimesh, tmp_path: Path) -> None:
    """Computed normals of these bodies are smooth. Stated ones that differ at each edge are those of the faces."""
    assert not np.allclose(smooth_normals(body), body.face_normals[:, None], atol=0.1)
    mesh = bake_asset(glb(tmp_path / "a", *split(body)), name="a", settings=QUICK).asset.mesh
    assert mesh is not None
    assert mesh.is_watertight
    np.testing.assert_allclose(smooth_normals(mesh), np.repeat(mesh.face_normals[:, None], 3, axis=1), atol=1e-5)


def test_split_normals_of_a_box_change_nothing(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.04, 0.03, 0.02))
    apart, normals = split(box)
    apart.export(tmp_path / "bare.glb", include_normals=False)
    for number, path in enumerate((tmp_path / "bare.glb", glb(tmp_path / "a", apart, normals))):
        bake_asset(path, name="box", settings=QUICK).asset.save(tmp_path / str(number))
    files = [sorted((tmp_path / str(number)).iterdir()) for number in range(2)]
    assert len(files[0]) == 5
    for one, other in zip(*files, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name


@pytest.mark.parametrize("sign", [1, -1])
def test_normals_follow_uneven_scales_and_mirrored_nodes(sign: int, tmp_path: Path) -> None:
    """The normal of an ellipsoid x = D s of the unit sphere s is along D^-1 s. glTF's y points up: (x, -z, y)."""
    scale = np.array([sign * 2.0, 1.0, 0.5])
    (part,) = read_model(glb(tmp_path / "a", *ball(), scale=scale.tolist())).parts
    y_up = part.mesh.triangles @ np.array([(1, 0, 0), (0, 0, -1), (0, 1, 0)])
    expected = (y_up / scale**2) @ np.array([(1, 0, 0), (0, 0, -1), (0, 1, 0)]).T
    expected /= np.linalg.norm(expected, axis=2, keepdims=True)
    np.testing.assert_allclose(corner_normals(part.mesh), expected, atol=1e-5)
    assert part.mesh.volume > 0


def test_unusable_normals_are_computed_from_the_faces(tmp_path: Path) -> None:
    mesh, normals = ball()
    wrong = normals.copy()
    wrong[0], wrong[1], wrong[2] = 0, np.nan, -normals[2]
    model = read_model(glb(tmp_path / "a", mesh, wrong))
    (part,) = model.parts
    count = int(np.isin(mesh.faces, (0, 1, 2)).sum())
    assert model.warnings == (
        f"{count} of the 384 normals of its face corners are absent, zero, not finite, or on the back of their "
        "face: these are computed from the faces",
    )
    found = corner_normals(part.mesh)
    computed = corner_normals(trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, process=False))
    is_exact = np.abs(found - part.mesh.triangles / RADIUS).max(axis=2) < 1e-5
    assert int((~is_exact).sum()) == count
    np.testing.assert_allclose(found[~is_exact], computed[~is_exact], atol=1e-6)


def test_normals_against_all_faces_are_left_out(tmp_path: Path) -> None:
    """A body that is inside out keeps its faces, and normals on their backs are not used."""
    mesh, normals = ball()
    inverted = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    model = read_model(glb(tmp_path / "a", inverted, normals))
    assert stated_normals(model.parts[0].mesh) is None
    assert [one.split(" ")[:2] for one in model.warnings] == [["384", "of"], ["a", "closed"]]
    model = read_model(glb(tmp_path / "b", inverted, -normals))
    np.testing.assert_allclose(corner_normals(model.parts[0].mesh), -model.parts[0].mesh.triangles / RADIUS, atol=1e-5)


def test_normals_that_round_a_box_are_used_and_named(tmp_path: Path) -> None:
    """Normals at the eight shared vertices are diagonal, as of Blender's *shade smooth*."""
    box = trimesh.creation.box((0.04, 0.04, 0.04))
    model = read_model(glb(tmp_path / "a", box, box.vertices / 0.02 / np.sqrt(3)))
    np.testing.assert_allclose(
        corner_normals(model.parts[0].mesh), model.parts[0].mesh.triangles / 0.02 / np.sqrt(3), atol=1e-5
    )
    (warning,) = model.warnings
    assert "its normals round the edges of 100% of its area" in warning


def test_the_two_faces_of_a_sheet_at_one_place_keep_their_normals(tmp_path: Path) -> None:
    """A part of a cylinder about z has each face twice, in both windings, as sheets of many game models do."""
    angle, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.6, 0.6, 4), [0, 0.02, 0.04]))
    normals = np.stack([np.cos(angle), np.sin(angle), 0 * z], axis=1)
    corners = np.array([(k, k + 1, k + 5, k + 4) for k in (0, 1, 2, 4, 5, 6)])
    front = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    back = np.concatenate([corners[:, [1, 0, 3]], corners[:, [1, 3, 2]]])  # with the other diagonals
    sheet = trimesh.Trimesh(
        np.tile(RADIUS * normals + np.outer(z, (0, 0, 1)), (2, 1)), np.concatenate([front, back + 12]), process=False
    )
    path = ply(tmp_path / "a", sheet, np.concatenate([normals, -normals]))
    mesh = bake_asset(path, name="a", kind="environment", settings=QUICK).asset.mesh
    assert mesh is not None
    assert len(mesh.faces) == 24
    radial = mesh.triangles * (1, 1, 0) / RADIUS
    radial *= np.sign((radial.mean(axis=1) * mesh.face_normals).sum(axis=1))[:, None, None]
    np.testing.assert_allclose(smooth_normals(mesh), radial, atol=0.01)


def test_normals_of_a_skinned_part_turn_with_its_joints(tmp_path: Path) -> None:
    """A joint that turns by 90 degrees about x and doubles x maps the ellipsoid (2, 1, 1) and its normals."""
    mesh, normals = ball()
    made = Glb()
    joints, weights = np.zeros((len(normals), 4), np.uint8), np.tile(np.array([1, 0, 0, 0], np.float32), (66, 1))
    arrays = {"POSITION": mesh.vertices.astype("f4"), "NORMAL": normals.astype("f4"), "JOINTS_0": joints}
    attributes = {name: made.accessor(values) for name, values in (arrays | {"WEIGHTS_0": weights}).items()}
    made.mesh(attributes, made.accessor(mesh.faces.ravel().astype("u4")))
    joint = {"rotation": [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], "scale": [2, 1, 1]}
    nodes, scenes = [{"mesh": 0, "skin": 0}, joint], [{"nodes": [0, 1]}]
    (part,) = read_model(made.save(tmp_path / "a.glb", nodes=nodes, scenes=scenes, skins=[{"joints": [1]}])).parts
    expected = part.mesh.triangles / (4.0, 1.0, 1.0)
    expected /= np.linalg.norm(expected, axis=2, keepdims=True)
    np.testing.assert_allclose(corner_normals(part.mesh), expected, atol=1e-5)


def test_cut_out_faces_keep_the_normals_of_their_places(tmp_path: Path) -> None:
    """Alpha of the vertices hides about half of the sphere; normals of the rest are radial."""
    mesh, normals = ball()
    made = Glb()
    alpha = np.where(normals[:, 1] > 0, 1.0, 0.0)[:, None]
    arrays = {"POSITION": mesh.vertices, "NORMAL": normals, "COLOR_0": np.hstack([np.ones((66, 3)), alpha])}
    attributes = {name: made.accessor(values.astype("f4")) for name, values in arrays.items()}
    made.mesh(attributes, made.accessor(mesh.faces.ravel().astype("u4")), {"alphaMode": "MASK"})
    (part,) = read_model(made.save(tmp_path / "a.glb")).parts
    assert len(part.mesh.faces) > 200
    radial = part.mesh.triangles / np.linalg.norm(part.mesh.triangles, axis=2, keepdims=True)
    np.testing.assert_allclose(corner_normals(part.mesh), radial, atol=0.03)


@pytest.mark.parametrize("material", [False, True])
@pytest.mark.parametrize("bare", ["{v}", "{v}/{t}", "{v}/", "{v}/{t}/"])
@pytest.mark.parametrize("full", ["{v}//{n}", "{v}/{t}/{n}"])
@pytest.mark.parametrize("first", ["full", "bare"])
def test_obj_faces_with_and_without_normals_in_one_file(
    first: str, full: str, bare: str, material: bool, tmp_path: Path
) -> None:
    """Half of the sphere has exact normals, and the other half those of its faces."""
    mesh, normals = ball()
    lines = obj("{v}/{t}/{n}", material=material)(tmp_path / "a", mesh, normals).read_text().split("\n")
    count, is_full = len(normals), (np.arange(128) < 64) == (first == "full")
    faces = [
        "f " + " ".join((full if has else bare).format(v=v + 1, t=v + 1, n=count - v) for v in face)
        for face, has in zip(mesh.faces, is_full, strict=True)
    ]
    path = tmp_path / "a.obj"
    path.write_text("\n".join([*(line for line in lines if not line.startswith("f ")), *faces]))
    model = read_model(path)
    (part,) = model.parts
    computed = corner_normals(trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, process=False))
    expected = np.where(is_full[:, None, None], part.mesh.triangles / RADIUS, computed)
    np.testing.assert_allclose(corner_normals(part.mesh), expected, atol=1e-5)
    assert any(one.startswith("192 of the 384 normals of its face corners are absent") for one in model.warnings)


def test_colours_of_an_obj_file_are_read_with_its_normals(tmp_path: Path) -> None:
    mesh, normals = ball()
    path = obj("{v}/{t}/{n}")(tmp_path / "a", mesh, normals)
    shades = iter(mesh.vertices[:, 2] / RADIUS / 2 + 0.5)
    lines = [f"{line} {next(shades)} 0 0" if line.startswith("v ") else line for line in path.read_text().split("\n")]
    path.write_text("\n".join(lines))
    (part,) = read_model(path).parts
    assert part.colours is not None
    expected = decode_srgb(part.mesh.triangles[..., 2] / RADIUS / 2 + 0.5)
    np.testing.assert_allclose(part.colours[..., 0], expected, atol=0.01)
    np.testing.assert_allclose(corner_normals(part.mesh), part.mesh.triangles / RADIUS, atol=1e-5)


@pytest.mark.parametrize("corners", [3, 4])
def test_normals_of_a_ply_file_with_seams_of_its_texture_are_read(corners: int, tmp_path: Path) -> None:
    """Coordinates at the corners of faces divide vertices, as those of MeshLab do."""
    mesh, normals = ball()
    polygons = mesh.faces
    if corners == 4:  # a sheet of 3 x 2 squares, as part of a cylinder about y
        angle, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.6, 0.6, 4), [0, 0.02, 0.04]))
        normals = np.stack([np.sin(angle), 0 * y, np.cos(angle)], axis=1)
        mesh = trimesh.Trimesh(RADIUS * normals + np.outer(y, (0, 1, 0)), process=False)
        polygons = np.array([(k, k + 1, k + 5, k + 4) for k in (0, 1, 2, 4, 5, 6)])
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    kinds = [("float", axis) for axis in ("x", "y", "z", "nx", "ny", "nz")]
    lines = ["ply", "format ascii 1.0", "comment TextureFile a.png", f"element vertex {len(normals)}"]
    lines += [f"property {kind} {name}" for kind, name in kinds] + [f"element face {len(polygons)}"]
    lines += ["property list uchar int vertex_indices", "property list uchar float texcoord", "end_header"]
    lines += [" ".join(map(str, row)) for row in np.hstack([mesh.vertices, normals])]
    uv = np.random.default_rng(0).random((len(polygons), 2 * corners)).round(1)
    lines += [" ".join(map(str, [corners, *f, 2 * corners, *t])) for f, t in zip(polygons, uv, strict=True)]
    (tmp_path / "a.ply").write_text("\n".join(lines) + "\n")
    (part,) = read_model(tmp_path / "a.ply").parts
    assert part.texture is not None
    expected = part.mesh.triangles * ((1, 1, 1) if corners == 3 else (1, 0, 1)) / RADIUS
    np.testing.assert_allclose(corner_normals(part.mesh), expected, atol=1e-5)


def test_normals_of_a_proxy_file_must_be_unit_vectors(tmp_path: Path) -> None:
    bake_asset(glb(tmp_path / "ball", *ball()), name="ball", settings=QUICK).asset.save(tmp_path / "asset")
    path = tmp_path / "asset/mesh.ply"
    content = path.read_bytes()
    path.write_bytes(content[:-36] + np.zeros(9, "<f4").tobytes())
    with pytest.raises(InputError, match=r"mesh\.ply: corner_normals must be three vectors of length 1 for each face"):
        Asset.load(tmp_path / "asset")


def test_normals_of_a_proxy_file_are_read_from_text_too(tmp_path: Path) -> None:
    asset = bake_asset(glb(tmp_path / "ball", *ball()), name="ball", settings=QUICK).asset
    asset.save(tmp_path / "asset")
    assert asset.mesh is not None
    asset.mesh.export(tmp_path / "asset/mesh.ply", encoding="ascii")
    mesh = Asset.load(tmp_path / "asset").mesh
    assert mesh is not None
    np.testing.assert_allclose(smooth_normals(mesh), smooth_normals(asset.mesh), atol=1e-4)


def test_normals_of_a_proxy_file_must_be_lists(tmp_path: Path) -> None:
    bake_asset(glb(tmp_path / "ball", *ball()), name="ball", settings=QUICK).asset.save(tmp_path / "asset")
    faces = np.zeros(1, [("count", "u1"), ("corners", "<i4", 3), ("corner_normals", "<f4")])
    faces["count"], faces["corners"] = 3, (0, 1, 2)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "element face 1\n"
    head += "property list uchar int vertex_indices\nproperty float corner_normals\nend_header\n"
    (tmp_path / "asset/mesh.ply").write_bytes(head.encode() + np.eye(3, dtype="<f4").tobytes() + faces.tobytes())
    with pytest.raises(InputError, match=r"mesh\.ply: corner_normals must be three vectors"):
        Asset.load(tmp_path / "asset")


def test_files_without_normals_and_meshes_in_memory_have_computed_normals(tmp_path: Path) -> None:
    mesh, normals = ball()
    mesh.export(tmp_path / "a.stl")
    mesh.export(tmp_path / "a.obj")
    mesh.export(tmp_path / "a.ply")
    held = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, process=False)
    for source in (tmp_path / "a.stl", tmp_path / "a.obj", tmp_path / "a.ply", held):
        (part,) = read_model(source).parts
        assert stated_normals(part.mesh) is None


def test_normal_matrix_is_the_inverse_transpose_up_to_a_positive_scale() -> None:
    matrices = np.random.default_rng(0).normal(size=(50, 3, 3))
    expected = np.linalg.inv(matrices).transpose(0, 2, 1) * np.abs(np.linalg.det(matrices))[:, None, None]
    np.testing.assert_allclose(normal_matrix(matrices), expected, atol=1e-9)
    flat = np.diag([1.0, 1.0, 0.0])
    np.testing.assert_allclose(normal_matrix(flat), np.diag([0.0, 0.0, 1.0]))


def _highlight(scene: dict[str, object], size: int) -> np.ndarray:
    """Return the centroid (2,) of the highlight of a picture [px]."""
    light = {"type": "rectangle", "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}}
    look_at, film = mi.ScalarTransform4f().look_at, {"type": "hdrfilm", "width": size, "height": size}
    light["to_world"] = look_at([0.3, 0.3, 0.8], [0, 0, 0], [0, 1, 0]) @ mi.ScalarTransform4f().scale(0.12)
    camera = {"type": "perspective", "fov": 30.0, "to_world": look_at([0.25, -0.2, 0.15], [0, 0, 0], [0, 0, 1])}
    camera |= {"film": film, "sampler": {"type": "independent", "sample_count": 128}}
    rgb = np.array(mi.render(mi.load_dict({"type": "scene", "sensor": camera, "light": light, **scene})))[..., :3]
    luminance = rgb.mean(axis=2)
    return np.argwhere(luminance > 0.5 * luminance.max()).mean(axis=0)


def test_the_highlight_of_a_coarse_sphere_is_where_mitsuba_traces_it(tmp_path: Path) -> None:
    """The path tracer renders the triangles of a PLY file with its normals. Without them, the highlight moves."""
    from mitsplat.plugins import splat_proxy, splats  # registers both plugins  # noqa: F401

    size, metal = 256, {"metallic": 1.0, "roughness": 0.25}
    path = ply(tmp_path / "ball", *ball())
    bsdf = {"type": "principled", "base_color": {"type": "rgb", "value": 0.5}, **metal}
    shape = {"type": "ply", "filename": str(path), "bsdf": bsdf}
    traced = _highlight({"integrator": {"type": "path", "max_depth": 2}, "shape": shape}, size)
    found = []
    for number, source in enumerate((path, ball()[0])):
        folder = tmp_path / f"asset_{number}"
        settings = BakeSettings(gaussians=2000, fit_steps=0, verify_views=0)
        finish = SurfaceFinish(metallic=1.0, roughness=0.25)
        bake_asset(source, name="ball", settings=settings, finish=finish).asset.save(folder)
        asset = {"type": "splats", "asset": str(folder), "instance": 1}
        found.append(_highlight({"integrator": {"type": "splat_proxy", "shadow_samples": 256}, "shape": asset}, size))
    assert np.linalg.norm(found[0] - traced) < 0.7
    assert np.linalg.norm(found[1] - traced) > 2
