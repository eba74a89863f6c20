"""Reconstruction of assets from captures and splats: quality verdict, report page, and reuse of earlier runs."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, Photo
from mitsplat.capture.pipeline.capture_result import CaptureResult
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.errors import InputError
from mitsplat.fit.fit_folder import FitResult
from mitsplat.fit.fit_settings import FitSettings
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.mesh_distance import DistanceSurface
from mitsplat.reconstruct.asset_evaluation import Verdict
from mitsplat.reconstruct.asset_report import _directions
from mitsplat.reconstruct.pipeline.asset_pipeline import AssetResult, asset_from_photos, make_asset, read_fit
from mitsplat.reconstruct.reconstruct import (
    AssetJob,
    ImportedMesh,
    Reconstruction,
    ReconstructSettings,
    reconstruct_asset,
)
from mitsplat.reconstruct.surface import SurfaceSettings
from mitsplat.scene.loading.scene_loading import load_scene
from tests.conftest import KnownObject

SETTINGS = ReconstructSettings(surface=SurfaceSettings(voxels=96, faces=4000), view_size=160, verdict_size=160)
GOOD = Verdict(
    photos=32, rejected=0, psnr=30.0, psnr_object=29.0, splat_iou=0.98, mesh_iou=0.97, offset=1e-3, spread=1e-3,
    lost=0.01, scale_error=1e-3, units="metre", gaussians=9, faces=9, watertight=True, solid=True,
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def quick_pieces() -> Iterator[None]:
    """Replace the convex decomposition, which takes longer than all other stages and has its own tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mitsplat.reconstruct.reconstruct.convex_pieces", lambda mesh: (mesh.convex_hull,))
        yield


@pytest.fixture(scope="module")
def reconstructions() -> list[Reconstruction]:
    """Return the list of what ``made`` reconstructs."""
    return []


@pytest.fixture(scope="module")
def made(
    known_object: KnownObject, tmp_path_factory: pytest.TempPathFactory, reconstructions: list[Reconstruction]
) -> tuple[Path, AssetResult]:
    folder = tmp_path_factory.mktemp("made")
    (folder / "fit").mkdir()
    known_object.splats.save(folder / "fit" / "splats.ply")
    (folder / "fit" / "fit.json").write_text('{"psnr": 31.5}')
    capture = replace(known_object.capture, units="unknown", rejected={"blurred.jpg": "it is <blurred>"})
    capture.save(folder / "capture")
    job = AssetJob(name="part", class_name="bracket", settings=SETTINGS)

    def reconstruct(*given: Any, **options: Any) -> Reconstruction:
        reconstructions.append(reconstruct_asset(*given, **options))
        return reconstructions[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mitsplat.reconstruct.pipeline.asset_pipeline.reconstruct_asset", reconstruct)
        return folder, make_asset(Capture.load(folder / "capture"), folder / "fit", folder / "asset", job)


def test_mesh_and_splats_have_the_frame_of_the_truth(known_object: KnownObject, made: tuple[Path, AssetResult]) -> None:
    folder, done = made
    asset = Asset.load(folder / "asset")
    assert asset.class_name == "bracket"
    assert asset.mesh is not None
    assert asset.mesh.is_volume
    assert len(asset.pieces) == 1
    distance = np.abs(DistanceSurface(known_object.mesh).signed_distances(np.asarray(asset.mesh.sample(3000, seed=0))))
    assert distance.mean() < 0.004 * known_object.mesh.scale
    assert asset.check() == ()
    found = done.verdict
    assert found.splat_iou is not None
    assert found.splat_iou > 0.98
    assert found.mesh_iou is not None
    assert found.mesh_iou > 0.97
    assert found.offset is not None
    assert found.offset < 0.002
    assert (found.psnr, found.photos, found.rejected, found.watertight) == (31.5, 32, 1, True)
    assert done.shortcoming is None


def test_an_asset_of_unknown_units_is_refused_by_a_scene(made: tuple[Path, AssetResult]) -> None:
    folder, _ = made
    scene = folder / "scene.yaml"
    camera = "camera: {kind: orbit, radius: 1, height: 1, target: [0, 0, 0]}"
    common = f"name: s\nregion: {{min: [-1, -1, 0], max: [1, 1, 1]}}\n{camera}\n"
    scene.write_text(common + "objects: [{asset: asset}]\n")
    with pytest.raises(InputError, match=r"objects\[0\].asset: asset 'part' has unknown units"):
        load_scene(scene)
    scene.write_text(common + "objects: [{asset: asset, size: 0.3}]\n")
    loaded = load_scene(scene).assets[0]
    assert loaded.units == "metre"
    assert loaded.mesh is not None
    assert loaded.mesh.extents.max() == pytest.approx(0.3)


def test_the_report_is_one_file_with_every_section(made: tuple[Path, AssetResult]) -> None:
    page = (made[0] / "asset" / "report.html").read_text()
    assert not re.search(r'(src|href)="(?!data:)', page)
    for heading in ("Verdict", "Held-out views", "Cameras", "Photos", "Rejected"):
        assert f">{heading}<" in page
    assert "it is &lt;blurred&gt;" in page
    assert page.count('class="camera"') == 2 * 32
    assert page.count("mesh over photo") == 2 * 4
    assert "All thresholds are met" in page


def test_an_asset_is_reused_for_the_same_inputs_only(
    made: tuple[Path, AssetResult], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder, first = made
    job = AssetJob(name="part", class_name="bracket", settings=SETTINGS)

    def never(*args: object, **kwargs: object) -> None:
        raise InputError("made anew")

    monkeypatch.setattr("mitsplat.reconstruct.pipeline.asset_pipeline.reconstruct_asset", never)
    again = make_asset(Capture.load(folder / "capture"), folder / "fit", folder / "asset", job)
    assert again.kept
    assert again.verdict == first.verdict
    others = (replace(job, name="other"), replace(job, settings=replace(SETTINGS, size=0.2)))
    record = (folder / "asset" / "verdict.json").read_bytes()
    for other in others:
        with pytest.raises(InputError, match="made anew"):
            make_asset(Capture.load(folder / "capture"), folder / "fit", folder / "asset", other)
        (folder / "asset" / "verdict.json").write_bytes(record)
    mask = next((folder / "capture" / "masks").glob("*.png"))
    content = mask.read_bytes()
    mask.write_bytes(content + b"\0")
    with pytest.raises(InputError, match="made anew"):
        make_asset(Capture.load(folder / "capture"), folder / "fit", folder / "asset", job)
    mask.write_bytes(content)
    (folder / "asset" / "verdict.json").write_bytes(record[:50])
    with pytest.raises(InputError, match="made anew"):
        make_asset(Capture.load(folder / "capture"), folder / "fit", folder / "asset", job)
    (folder / "asset" / "verdict.json").write_bytes(record)


def test_edited_files_are_kept_and_missing_ones_made_again(
    made: tuple[Path, AssetResult],
    reconstructions: list[Reconstruction],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    folder, _ = made
    given, out = (Capture.load(folder / "capture"), folder / "fit"), tmp_path / "asset"
    job = AssetJob(name="part", class_name="bracket", settings=SETTINGS)

    def reconstruct_once(capture: Capture, splats: Splats, job: AssetJob, **options: Any) -> Reconstruction:
        return replace(reconstructions[0], asset=replace(reconstructions[0].asset, name=job.name))

    monkeypatch.setattr("mitsplat.reconstruct.pipeline.asset_pipeline.reconstruct_asset", reconstruct_once)
    shutil.copytree(folder / "asset", out)
    described = out / "asset.yaml"
    described.write_text(described.read_text().replace("friction: 0.5", "friction: 0.31"))
    assert make_asset(*given, out, job).kept
    result = make_asset(*given, out, replace(job, name="other"))
    assert result.warnings == ("asset.yaml had been edited: the edited file is now asset.edited.yaml",)
    assert "friction: 0.31" in (out / "asset.edited.yaml").read_text() and "friction: 0.5" in described.read_text()
    assert make_asset(*given, out, job).warnings == ()
    described.write_text(described.read_text().replace("friction: 0.5", "friction: 0.4"))
    make_asset(*given, out, replace(job, name="third"))
    assert "friction: 0.4" in (out / "asset.edited2.yaml").read_text()
    make_asset(*given, out, job)
    (out / "mesh.ply").unlink()
    assert not make_asset(*given, out, job).kept and (out / "mesh.ply").is_file()
    for name in ("splats.ply", "mesh.ply"):
        mine = tmp_path / name[:5] / name
        mine.parent.mkdir()
        shutil.copy(folder / "fit/splats.ply", mine)
        with pytest.raises(InputError, match=f"{name}: would be replaced"):
            make_asset(given[0], mine if name == "splats.ply" else given[1], mine.parent, job)


@pytest.mark.parametrize("psnr", ['"abc"', "NaN", "[]"])
def test_the_record_of_a_fit_must_have_its_numbers(tmp_path: Path, psnr: str) -> None:
    (tmp_path / "fit.json").write_text(f'{{"psnr": {psnr}}}')
    with pytest.raises(InputError, match=r"fit\.json: "):
        read_fit(tmp_path)


def test_a_drawing_determines_the_scale_of_a_capture(known_object: KnownObject) -> None:
    """The capture has no unit and the CAD drawing is in millimetres: the asset has the size of the drawing."""
    tenth = np.diag([0.1, 0.1, 0.1, 1.0])
    capture = replace(known_object.capture.transformed(tenth), units="unknown")
    drawing = known_object.mesh.copy()
    drawing.apply_transform(trimesh.transformations.rotation_matrix(2.0, (1, 2, 3)))
    drawing.apply_scale(1000.0)
    job = AssetJob(name="part", settings=SETTINGS, imported=ImportedMesh(drawing, metres_per_unit=1e-3))
    found = reconstruct_asset(capture, known_object.splats.transformed(tenth), job)
    assert found.alignment is not None
    assert found.asset.units == found.verdict.units == "metre"
    assert found.asset.mesh is not None
    assert found.asset.mesh.scale == pytest.approx(known_object.mesh.scale, rel=5e-3)
    assert found.verdict.offset is not None
    assert found.verdict.offset < 0.003


def test_a_placed_mesh_of_known_unit_determines_the_scale_of_a_capture(known_object: KnownObject) -> None:
    capture_from_mesh = np.diag([1e-4, 1e-4, 1e-4, 1.0])
    capture = replace(known_object.capture.transformed(np.diag([0.1, 0.1, 0.1, 1.0])), units="unknown")
    imported = ImportedMesh(known_object.mesh.copy().apply_scale(1e3), capture_from_mesh, metres_per_unit=1e-3)
    job = AssetJob(name="part", settings=SETTINGS, imported=imported)
    found = reconstruct_asset(capture, known_object.splats.transformed(np.diag([0.1, 0.1, 0.1, 1.0])), job)
    assert found.asset.units == "metre" and found.asset.mesh is not None
    assert found.asset.mesh.scale == pytest.approx(known_object.mesh.scale, rel=1e-3)
    np.testing.assert_allclose(found.asset_from_capture, np.diag([10.0, 10, 10, 1]))


@pytest.mark.parametrize(("height", "lowest"), [(0.049, 0.0), pytest.param(0.0, -0.05, marks=pytest.mark.extended)])
def test_an_object_is_cut_at_the_table_below_it(known_object: KnownObject, height: float, lowest: float) -> None:
    """Gaussians 1 mm below the table are removed; a plane through the middle of an object is not its support."""
    lifted = np.eye(4)
    lifted[2, 3] = height
    capture = replace(known_object.capture.transformed(lifted), table=True)
    found = reconstruct_asset(capture, known_object.splats.transformed(lifted), AssetJob("part", settings=SETTINGS))
    assert found.asset.mesh is not None
    assert found.asset.mesh.bounds[0, 2] == pytest.approx(lowest, abs=4e-4)
    assert found.asset.mesh.is_volume


def test_surroundings_without_masks_get_an_open_mesh(known_object: KnownObject) -> None:
    photos = tuple(replace(photo, mask=None) for photo in known_object.capture.photos)
    capture = replace(known_object.capture, photos=photos)
    found = reconstruct_asset(capture, known_object.splats, AssetJob("cell", kind="environment", settings=SETTINGS))
    assert found.isolation is None
    assert found.asset.pieces == ()
    assert len(found.asset.splats) == len(known_object.splats)
    assert (found.verdict.mesh_iou, found.verdict.lost) == (None, None)
    with pytest.raises(InputError, match="masks from at least 3 sides"):
        reconstruct_asset(capture, known_object.splats, AssetJob("part", settings=SETTINGS))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"rejected": 30}, "only 32 of 62 photos have a camera pose"),
        ({"psnr": 12.0}, "12.0 dB"),
        ({"splat_iou": 0.5}, "the splats have an IoU with held-out masks"),
        ({"mesh_iou": 0.5}, "the mesh has an IoU with held-out masks"),
        ({"offset": 0.02}, "2.00% of the diagonal (at most 0.5% is required)"),
        ({"scale_error": 0.05}, "the error of the scale is 5.0%"),
        ({"watertight": False}, "the mesh is open"),
        ({"lost": 0.5}, "removed 50.0% of the object"),
    ],
)
def test_each_missed_threshold_is_one_sentence_with_advice(change: dict[str, float], sentence: str) -> None:
    assert GOOD.misses() == ()
    (miss,) = replace(GOOD, **change).misses()
    assert sentence in miss
    assert " is required): " in miss


def test_a_size_is_refused_for_a_capture_in_metres(known_object: KnownObject) -> None:
    with pytest.raises(InputError, match="already in metres and must have no size"):
        job = AssetJob("part", settings=replace(SETTINGS, size=0.2))
        reconstruct_asset(known_object.capture, known_object.splats, job)


def test_a_given_size_is_the_longest_edge_in_any_orientation(known_object: KnownObject) -> None:
    """The capture's axes are unrelated to the edges of the smallest upright box around the solid."""
    turn = trimesh.transformations.rotation_matrix(0.6, (0, 0, 1)) @ np.diag([3.0, 3.0, 3.0, 1.0])
    capture = replace(known_object.capture.transformed(turn), units="unknown")
    vertices = np.asarray(known_object.mesh.vertices)
    edges = trimesh.bounds.oriented_bounds_2D(vertices[:, :2])[1]
    settings = replace(SETTINGS, size=float(max(*edges, np.ptp(vertices[:, 2]))))
    found = reconstruct_asset(capture, known_object.splats.transformed(turn), AssetJob("part", settings=settings))
    assert found.asset.mesh is not None
    assert found.asset.mesh.extents.max() == pytest.approx(settings.size, rel=1e-12)
    assert found.asset.units == "metre"
    # The remaining error is a fraction of a grid cell.
    asset_from_truth = found.asset_from_capture @ turn
    np.testing.assert_allclose(np.cbrt(np.linalg.det(asset_from_truth[:3, :3])), 1, rtol=0.01)
    np.testing.assert_allclose(np.sort(found.asset.mesh.extents[:2]), np.sort(edges), rtol=0.01)
    assert found.isolation is not None
    kept = known_object.splats.select(found.isolation.kept).transformed(asset_from_truth)
    np.testing.assert_allclose(found.asset.splats.means, kept.means, atol=1e-6)


def test_photos_become_an_asset_through_all_stages(
    known_object: KnownObject, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A fit of other inputs is replaced without a prompt, see test_fit_interrupted.py."""
    overwritten = []

    def fit_capture(
        capture: object, out: Path, settings: FitSettings, *, overwrite: bool, progress: object
    ) -> FitResult:
        overwritten.append(overwrite)
        return FitResult(known_object.splats, 5, 60.0, (), "", ("the fit was short",))

    def made_of(found: Capture, fit: Path, out: Path, job: AssetJob, **_: object) -> AssetResult:
        assert (found, fit) == (capture, out / "fit")
        return AssetResult(out, GOOD, kept=False)

    capture = known_object.capture.save(tmp_path / "asset" / "capture")
    captured = CaptureResult(capture, 32, "a board", 0.5, doubtful={"05.png": 0.6})
    monkeypatch.setattr(
        "mitsplat.reconstruct.pipeline.asset_pipeline.capture_photos", lambda photos, out, settings, progress: captured
    )
    monkeypatch.setattr("mitsplat.reconstruct.pipeline.asset_pipeline.fit_capture", fit_capture)
    monkeypatch.setattr("mitsplat.reconstruct.pipeline.asset_pipeline.make_asset", made_of)
    job = AssetJob(name="part")
    for settings in (FitSettings(), FitSettings(), FitSettings(iterations=5)):
        made = asset_from_photos(tmp_path, tmp_path / "asset", job, capture=CaptureSettings(), fit=settings)
    assert made.folder == tmp_path / "asset"
    assert made.warnings == (*captured.warnings, "the fit was short")
    assert "05.png (60%)" in made.warnings[0]
    assert overwritten == [True, True, True]


def test_missing_fits_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has the fit finished"):
        read_fit(tmp_path)
    (tmp_path / "fit.json").write_text("[]")
    with pytest.raises(InputError, match="not the record of a fit"):
        read_fit(tmp_path)
    assert read_fit(tmp_path / "one.ply") == (tmp_path / "one.ply", None)


def test_the_diagram_of_views_has_the_zenith_in_its_centre() -> None:
    offsets = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.1, 0.0, -1.0]])
    cameras = [Camera.look_at(o, (0, 0, 0), up=(0.1, 0.2, 0.3), width=8, height=8, fov_x=40) for o in offsets]
    photos = tuple(Photo(f"{number}.jpg", Path("none"), camera) for number, camera in enumerate(cameras))
    capture = Capture(photos, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8), up="z")
    found = re.findall(r'<circle cx="([0-9.]+)" cy="([0-9.]+)" r="3.5"><title>', _directions(capture))
    places = np.array(found, dtype=float)
    middle = places[0]
    assert ((places > 0) & (places < 2 * middle)).all()
    right, below = places[1] - middle, places[3] - middle
    np.testing.assert_allclose(2 * right, places[2] - middle, atol=0.2)  # 45 degrees are half of 90
    assert right[0] > 0 and below[1] < 0  # y points up on the page
