"""OpenUSD: assets out and back, stages of other programs, and hostile files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.gaussians.spherical_harmonics import evaluate_sh
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.mesh import mass_properties
from mitsplat.images.colour import encode_srgb
from mitsplat.usd import usd_layers
from mitsplat.usd.stage_assets import read_stage_asset
from mitsplat.usd.usd_export import export_asset_usd
from mitsplat.usd.usd_layers import open_confined
from tests.cli.typed import run
from tests.conftest import box_asset

pxr = pytest.importorskip("pxr", reason="needs OpenUSD: pip install 'mitsplat[usd]'")
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation, UsdVol, Vt  # noqa: E402

ARRAYS = ("means", "quats", "scales", "opacities", "sh")


def random_splats(count: int = 50, degree: int = 3, seed: int = 0) -> Splats:
    """Return random splats."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(0, 0.05, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(1e-3, 1e-2, (count, 3)),
        opacities=rng.random(count),
        sh=rng.normal(0, 0.3, (count, (degree + 1) ** 2, 3)),
    )


def faults(stage: Usd.Stage) -> list[str]:
    """Return the findings of all validators of OpenUSD."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    return [error.GetErrorAsString() for error in UsdValidation.ValidationContext(validators).Validate(stage)]


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
def test_an_asset_survives_a_round_trip(tmp_path: Path, suffix: str) -> None:
    mesh = trimesh.creation.box((0.02, 0.03, 0.01)).apply_transform(
        trimesh.transformations.rotation_matrix(0.4, (1, 2, 3), (0.1, 0, 0))
    )
    splats = replace(random_splats(12, 0).with_material(metallic=0.5, roughness=0.2), kernel="mip")
    asset = replace(
        box_asset("nut"),
        class_name="fastener",
        splats=splats,
        mesh=mesh,
        pieces=(mesh,),
        density=7850.0,
        friction=0.35,
        restitution=0.25,
        rolling_friction=2e-4,
        keypoints={"tip": (0.0, 0.01, 0.02)},
    )
    export_asset_usd(asset, tmp_path / f"nut{suffix}")
    assert faults(Usd.Stage.Open(str(tmp_path / f"nut{suffix}"))) == []
    again = read_stage_asset(tmp_path / f"nut{suffix}").asset
    assert again is not None and again.splats.materials is not None and splats.materials is not None
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(again.splats, name), getattr(splats, name), rtol=0, atol=1e-7)
    assert np.array_equal(again.splats.materials.roughness, splats.materials.roughness)
    assert (again.name, again.class_name, again.splats.kernel) == ("nut", "fastener", "mip")
    assert (again.rolling_friction, again.keypoints) == (2e-4, asset.keypoints)
    assert [again.friction, again.restitution] == pytest.approx([0.35, 0.25], rel=1e-6)
    assert again.mesh is not None
    first, second = (
        mass_properties(one.mesh, one.pieces, density=one.density, mass=one.mass) for one in (asset, again)
    )
    assert second.mass == pytest.approx(first.mass, rel=1e-6)
    np.testing.assert_allclose(second.inertia, first.inertia, rtol=0, atol=1e-5 * first.inertia.max())


def test_the_stage_of_an_object_states_its_inertia_and_class(tmp_path: Path) -> None:
    asset = box_asset("nut", (0.02, 0.03, 0.01))
    export_asset_usd(asset, tmp_path / "nut.usda")
    stage = Usd.Stage.Open(str(tmp_path / "nut.usda"))
    prim = stage.GetDefaultPrim()
    mass = UsdPhysics.MassAPI(prim)
    turn = mass.GetPrincipalAxesAttr().Get()
    axes = Rotation.from_quat([*turn.GetImaginary(), turn.GetReal()]).as_matrix()
    inertia = axes @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ axes.T
    kilograms, size = 1000 * 0.02 * 0.03 * 0.01, np.array((0.02, 0.03, 0.01))
    expected = np.diag(kilograms / 12 * (size @ size - size**2))  # solid box
    np.testing.assert_allclose(inertia, expected, rtol=0, atol=1e-6 * expected.max())
    assert mass.GetMassAttr().Get() == pytest.approx(kilograms)
    assert list(prim.GetAttribute("semantics:labels:class").Get()) == ["nut"]


def new_stage(path: Path) -> Usd.Stage:
    """Return a new stage in metres with z up."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    return stage


def write_field(
    stage: Usd.Stage, path: str, splats: Splats, *, half: bool = False
) -> UsdVol.ParticleField3DGaussianSplat:
    """Write splats with the API of usd-core alone."""
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    end, vectors = ("h", Vt.Vec3hArray) if half else ("", Vt.Vec3fArray)
    kind = Gf.Quath if half else Gf.Quatf
    quats = [kind(w, x, y, z) for x, y, z, w in splats.quats.astype(float).tolist()]
    for name, values in (
        ("Positions", vectors(splats.means.tolist())),
        ("Orientations", (Vt.QuathArray if half else Vt.QuatfArray)(quats)),
        ("Scales", vectors(splats.scales.tolist())),
        ("Opacities", (Vt.HalfArray if half else Vt.FloatArray)(splats.opacities.tolist())),
        ("RadianceSphericalHarmonicsCoefficients", vectors(splats.sh.reshape(-1, 3).tolist())),
    ):
        getattr(field, f"Create{name}{end}Attr")(values)
    field.CreateRadianceSphericalHarmonicsDegreeAttr(splats.sh_degree)
    return field


def test_fields_of_another_program_arrive_in_metres_with_z_up(tmp_path: Path) -> None:
    """Centimetres, y up, two fields with transforms, one of them in half precision, of different degrees."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "two.usdc"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    first, second = random_splats(degree=3), random_splats(degree=1, seed=1)
    UsdGeom.Xformable(write_field(stage, "/root/a", first)).AddTranslateOp().Set((10, 20, 30))
    parent = UsdGeom.Xform.Define(stage, "/root/turned")
    parent.AddRotateXYZOp().Set((20, 30, 40))
    parent.AddScaleOp().Set((2, 2, 2))
    write_field(stage, "/root/turned/b", second, half=True)
    UsdGeom.Points.Define(stage, "/root/points").CreatePointsAttr([(0, 0, 0)])
    stage.Save()
    found = read_stage_asset(tmp_path / "two.usdc")
    assert found.asset is None
    assert found.notes == ("not imported: 1 prims of type Points (/root/points)",)
    z_up: Float64Array = np.array([[0.01, 0, 0, 0], [0, 0, -0.01, 0], [0, 0.01, 0, 0], [0, 0, 0, 1]])
    move = np.eye(4)
    move[:3, 3] = 10, 20, 30
    turn = trimesh.transformations.euler_matrix(*np.radians((20, 30, 40)), axes="sxyz") @ np.diag([2, 2, 2, 1.0])
    expected = Splats.concatenate([first.transformed(z_up @ move), second.transformed(z_up @ turn)])
    tolerance = {"means": 1e-4, "quats": 2e-3, "scales": 1e-6, "opacities": 1e-3, "sh": 2e-3}  # half precision
    for name, atol in tolerance.items():
        got, want = getattr(found.splats, name), getattr(expected, name)
        if name == "quats":
            got = got * np.sign((got * want).sum(axis=1, keepdims=True))
        np.testing.assert_allclose(got, want, rtol=0, atol=atol, err_msg=name)
        np.testing.assert_allclose(got[:50], want[:50], rtol=0, atol=1e-6, err_msg=name)


def test_attributes_follow_the_rules_of_their_lengths(tmp_path: Path) -> None:
    """Longer arrays are cut, shorter ones ignored; a field without opacities and radiance is opaque and grey."""
    stage = new_stage(tmp_path / "short.usda")
    splats = random_splats(6, 1)
    field = write_field(stage, "/a", splats)
    field.GetScalesAttr().Set(Vt.Vec3fArray(np.concatenate([splats.scales, splats.scales]).tolist()))
    field.GetOpacitiesAttr().Set(Vt.FloatArray([0.5]))
    field.GetRadianceSphericalHarmonicsCoefficientsAttr().Set(Vt.Vec3fArray(5))
    stage.Save()
    found = read_stage_asset(tmp_path / "short.usda")
    assert np.array_equal(found.splats.scales, splats.scales)
    assert (found.splats.opacities == 1).all() and (found.splats.sh == 0).all()  # colour 0.5
    assert sorted(note.partition(" (")[0].removeprefix("not imported: ") for note in found.notes) == [
        "1 surplus values of scales",
        "1 values of opacities that are too few",
        "1 values of radiance:sphericalHarmonicsCoefficients that are too few",
    ]


def test_linear_colours_are_encoded(tmp_path: Path) -> None:
    stage = new_stage(tmp_path / "linear.usda")
    splats = random_splats(20, 0)
    prim = write_field(stage, "/a", splats).GetPrim()
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.LinearRec709)
    stage.Save()
    up = np.array([0, 0, 1.0])
    got = evaluate_sh(read_stage_asset(tmp_path / "linear.usda").splats.sh, up)
    np.testing.assert_allclose(got, encode_srgb(evaluate_sh(splats.sh, up)), rtol=0, atol=1e-6)


def test_a_stage_with_colliders_of_another_program_becomes_an_asset(tmp_path: Path) -> None:
    """Millimetres and grams, a body under a scaled prim, a cube and a hull as colliders."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "part.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.001)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 0.001)
    body = UsdGeom.Xform.Define(stage, "/part")
    body.AddTranslateOp().Set((0, 0, 500))
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    UsdPhysics.MassAPI.Apply(body.GetPrim()).CreateMassAttr(250.0)
    splats = random_splats(30, 0).transformed(np.diag([100, 100, 100, 1.0]))
    write_field(stage, "/part/splats", splats)
    cube = UsdGeom.Cube.Define(stage, "/part/cube")
    cube.CreateSizeAttr(20.0)
    ball = UsdGeom.Sphere.Define(stage, "/part/ball")
    ball.CreateRadiusAttr(5.0)
    ball.AddTranslateOp().Set((0, 0, 12))
    for prim in (cube.GetPrim(), ball.GetPrim()):
        UsdPhysics.CollisionAPI.Apply(prim)
    stage.Save()
    asset = read_stage_asset(tmp_path / "part.usda").asset
    assert asset is not None and asset.mesh is not None and asset.mesh.is_watertight
    assert (asset.name, asset.kind, len(asset.pieces)) == ("part", "object", 2)
    assert asset.mass == pytest.approx(0.25)
    np.testing.assert_allclose(asset.mesh.bounds, [[-0.01, -0.01, -0.01], [0.01, 0.01, 0.017]], atol=1e-6)
    np.testing.assert_allclose(asset.splats.means, 0.001 * splats.means, atol=1e-7)


@pytest.mark.parametrize("place", ["mass", "density", "material"])
def test_masses_of_colliders_and_materials_are_those_of_the_body(
    tmp_path: Path, place: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A cube of 1 litre states a mass or density, in units of centimetres and grams; a second cube has 1 g/cm^3."""
    stage = new_stage(tmp_path / "part.usda")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 0.001)
    body = UsdGeom.Xform.Define(stage, "/part").GetPrim()
    UsdPhysics.RigidBodyAPI.Apply(body)
    UsdPhysics.MassAPI.Apply(body)
    write_field(stage, "/part/splats", random_splats(30, 0).transformed(np.diag([100, 100, 100, 1.0])))
    for number, name in enumerate(("first", "second")):
        cube = UsdGeom.Cube.Define(stage, f"/part/{name}")
        cube.CreateSizeAttr(1.0)
        cube.AddTranslateOp().Set((20.0 * number, 0, 0))
        cube.AddScaleOp().Set((10.0, 10.0, 10.0))
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
        if place == "material" and not number:
            material = UsdShade.Material.Define(stage, "/part/metal")
            UsdPhysics.MaterialAPI.Apply(material.GetPrim()).CreateDensityAttr(7.8)
            UsdShade.MaterialBindingAPI.Apply(cube.GetPrim()).Bind(material, materialPurpose="physics")
        elif not number:
            mass = UsdPhysics.MassAPI.Apply(cube.GetPrim())
            (mass.CreateMassAttr if place == "mass" else mass.CreateDensityAttr)(7800.0 if place == "mass" else 7.8)
        else:
            UsdPhysics.MassAPI.Apply(cube.GetPrim()).CreateDensityAttr(1.0)
    stage.Save()
    asset = read_stage_asset(tmp_path / "part.usda").asset
    assert asset is not None and asset.mass == pytest.approx(8.8, rel=1e-6)
    assert "not imported: 1 distributions of a mass over colliders (/part)" in caplog.text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('def "x" (references=@http://host/y.usd@</a>) {}', "not addresses or expressions"),
        ('def "x" (references=@../outside.usda@</a>) {}', "must lie in its folder"),
        ('def "x" (payload=@/etc/passwd.usda@</a>) {}', "must lie in its folder"),
        ('def "x" (references=@missing.usda@</a>) {}', "no such file"),
        ('def "x" (clips = {dictionary default={string primPath="/x"}}) {}', "value clips are not supported"),
        ('def "x" {', "not a USD file that can be read"),
    ],
)
def test_a_hostile_stage_is_refused_in_a_sentence(tmp_path: Path, text: str, message: str) -> None:
    folder = tmp_path / "stage"
    folder.mkdir()
    (tmp_path / "outside.usda").write_text('#usda 1.0\ndef "a" {}\n')
    (folder / "bad.usda").write_text(f"#usda 1.0\n{text}\n")
    with pytest.raises(InputError, match=message) as caught:
        open_confined(folder / "bad.usda")
    assert str(caught.value).startswith(str(folder / "bad.usda")) and "\n" not in str(caught.value)


def test_a_child_process_refuses_hostile_stages(tmp_path: Path) -> None:
    (tmp_path / "bad.usda").write_text('#usda 1.0\ndef "x" (references=@/etc/passwd.usda@</a>) {}\n')
    with pytest.raises(
        InputError,
        match=r"bad\.usda: files of a stage must lie in its folder; flatten the stage \(got /etc/passwd\.usda\)",
    ):
        read_stage_asset(tmp_path / "bad.usda")
    (tmp_path / "empty.usda").write_text("#usda 1.0\n")
    with pytest.raises(InputError, match=r"empty\.usda: must have a ParticleField3DGaussianSplat"):
        read_stage_asset(tmp_path / "empty.usda")


def test_invalid_values_name_the_prim(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "bad.usda"))
    field = write_field(stage, "/a", random_splats(3, 0))
    field.GetOpacitiesAttr().Set(Vt.FloatArray([0.5, 2.0, 0.5]))
    stage.Save()
    with pytest.raises(InputError, match=r"bad\.usda: /a: opacities must be in \[0, 1\] \(got 2 at row 1\)"):
        read_stage_asset(tmp_path / "bad.usda")


def test_a_missing_package_names_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usd_layers, "find_spec", lambda name: None)
    with pytest.raises(MissingResourceError, match=r"pip install 'mitsplat\[usd\]'"):
        export_asset_usd(box_asset("nut"), tmp_path / "nut.usda")


def test_the_commands_export_and_import_an_asset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = box_asset("nut")
    asset.save(tmp_path / "nut")
    assert run("export", tmp_path / "nut", "-o", tmp_path / "nut.usdz") == 0
    assert run("import", tmp_path / "nut.usdz", "-o", tmp_path / "again", "--friction", 0.7, "--class", "hex") == 0
    again = Asset.load(tmp_path / "again")
    assert (again.name, again.class_name, again.friction) == ("nut", "hex", 0.7)
    assert np.array_equal(again.splats.means, asset.splats.means)
    assert run("import", tmp_path / "nut.usdz", "-o", tmp_path / "third", "--size", 0.1) == 2
    assert "--size does not apply" in capsys.readouterr().err
    assert run("export", tmp_path / "nut", "-o", tmp_path / "nut.xml") == 2
    assert "must be a USD stage, .glb, or MJCF with --mjcf" in capsys.readouterr().err
