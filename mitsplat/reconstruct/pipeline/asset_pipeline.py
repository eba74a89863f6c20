"""Pipeline from photographs to an asset folder: capture, fit, reconstruction and evaluation.

Each stage is repeated only if its inputs change. The work folders ``capture/`` and ``fit/`` inside the asset folder
contain the results of those stages, which check their own inputs. The last stage stores a hash of all its inputs in
``verdict.json``, together with the quality figures.
"""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from mitsplat.arguments import check_type, path_of
from mitsplat.asset import ASSET_FILE, read_spec
from mitsplat.capture.capture import Capture
from mitsplat.capture.pipeline.capture_pipeline import capture_photos
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.errors import InputError
from mitsplat.fit.fit_folder import FIT_FILE, read_record
from mitsplat.fit.fit_settings import FitProgress, FitSettings
from mitsplat.fit.trainer import fit_capture
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.pages.html import REPORT_FILE
from mitsplat.progress import Progress
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE, Verdict
from mitsplat.reconstruct.asset_report import write_asset_report
from mitsplat.reconstruct.materials.capture_light import CaptureLight, require_light_frame
from mitsplat.reconstruct.materials.estimation import estimate_materials
from mitsplat.reconstruct.reconstruct import AssetJob, Reconstruction, reconstruct_asset
from mitsplat.storage.content_hash import ContentHash, file_hash
from mitsplat.storage.files import JsonObject, write_text
from mitsplat.surroundings.environment_from_photos import reconstruct_environment
from mitsplat.surroundings.ready_scene import recorded_scene, write_recorded_scene
from mitsplat.version import __version__


@dataclass(frozen=True)
class AssetResult:
    """An asset on disk.

    Attributes:
        folder: Folder of the asset.
        verdict: Quality figures.
        kept: True if an earlier run made the asset from the same inputs.
        warnings: Warnings on the photographs and the fit, one sentence each.
        scene: File of an example scene with the asset, if one was written.
    """

    folder: Path
    verdict: Verdict
    kept: bool
    warnings: tuple[str, ...] = ()
    scene: Path | None = None

    @property
    def shortcoming(self) -> str | None:
        """The missed thresholds with advice as one sentence, or None."""
        return "; ".join(self.verdict.misses()) or None


def asset_from_photos(
    photos: str | Path,
    out: str | Path,
    job: AssetJob,
    *,
    capture: CaptureSettings | None = None,
    fit: FitSettings | None = None,
    progress: Progress | None = None,
) -> AssetResult:
    """Make an asset from a folder of photographs; stages with unchanged inputs are not repeated.

    Args:
        photos: Folder of photographs of one object or place.
        out: Folder of the asset, with the work folders ``capture/`` and ``fit/``.
        job: Description of the asset.
        capture: Settings for cameras, scale and masks; defaults if None.
        fit: Settings of the fit; :func:`default_fit` if None.
        progress: Progress callback.

    Raises:
        InputError: If the photographs do not suffice.
        MissingResourceError: If a required program or model is missing.
    """
    photos, out = path_of(photos, "photos"), path_of(out, "out")
    check_type(job, AssetJob, "job", "for example mitsplat.AssetJob(name='cup')")
    fit = fit or default_fit(job.kind)
    taken = capture_photos(photos, out / "capture", capture or CaptureSettings(kind=job.kind), progress=progress)
    if job.light is not None:
        require_light_frame(taken.capture)

    def fitting(now: FitProgress) -> None:
        if progress is not None:
            done = int(now.fraction * fit.iterations)
            progress(done, fit.iterations, f"fitting: {now.psnr:.1f} dB, {now.gaussians} Gaussians")

    fitted = fit_capture(taken.capture, out / "fit", fit, overwrite=True, progress=fitting)
    done = make_asset(taken.capture, out / "fit", out, job, source=taken.source, progress=progress)
    return replace(done, warnings=(*taken.warnings, *fitted.warnings, *done.warnings))


def default_fit(kind: Literal["object", "environment"]) -> FitSettings:
    """Return the settings of the fit of an object or an environment; an environment has twice as many Gaussians."""
    return FitSettings() if kind == "object" else FitSettings(gaussians=60_000)


def make_asset(
    capture: Capture,
    fit: Path,
    out: Path,
    job: AssetJob,
    *,
    source: str | None = None,
    progress: Progress | None = None,
) -> AssetResult:
    """Write the asset of a capture and a fit with its verdict and its report, unless they already exist.

    For an environment, an example scene is written next to the folder of the asset.

    Args:
        capture: The capture.
        fit: Folder of ``mitsplat fit``, or a splat file in the capture's frame.
        out: Folder of the asset.
        job: Description of the asset.
        source: Source of the capture's scale and gravity, a clause.
        progress: Progress callback.

    Raises:
        InputError: If a file is missing or damaged, an object has no masks, or lights are given for a capture without a
            metric frame.
    """
    if job.light is not None:
        require_light_frame(capture)
    splat_file, psnr = read_fit(fit)
    inputs = _input_hash(capture, splat_file, job)
    earlier_scene = recorded_scene(out)
    done = _existing_asset(out, inputs)
    if done is None:
        refuse_to_replace(out, splat_file)
        edited = _edited_backup(out)
        splats = Splats.load(splat_file)
        if job.kind == "object":
            result = reconstruct_asset(capture, splats, job, psnr=psnr, progress=progress)
            if job.light is not None:
                result = _with_estimated_materials(result, capture, job.light, progress)
        else:
            result = reconstruct_environment(capture, splats, job, psnr=psnr, source=source, progress=progress)
        (out / VERDICT_FILE).unlink(missing_ok=True)
        if edited is not None:
            (out / ASSET_FILE).replace(edited)
        if job.material is not None:
            result = replace(
                result, asset=replace(result.asset, splats=result.asset.splats.with_material(**job.material))
            )
        result.asset.save(out)
        write_asset_report(out, capture, result)
        # Written last, so that an interrupted run does not look finished.
        _save_verdict(out, result, inputs)
        warnings = () if edited is None else (f"{ASSET_FILE} had been edited: the edited file is now {edited.name}",)
        done = AssetResult(out, result.verdict, kept=False, warnings=warnings)
    scene, warning = write_recorded_scene(out, earlier_scene)
    return replace(done, scene=scene, warnings=done.warnings if warning is None else (*done.warnings, warning))


def _with_estimated_materials(
    result: Reconstruction, capture: Capture, light: CaptureLight, progress: Progress | None
) -> Reconstruction:
    """Return the asset with the materials that its photographs show, or unchanged if the light does not fit them."""
    if progress is not None:
        progress(0, 1, "estimating materials")
    asset = result.asset
    if asset.mesh is None:
        return result
    found = estimate_materials(capture, asset.mesh, light)
    rows = {f"Material {number}": str(region) for number, region in enumerate(found.regions, start=1)}
    if (reason := found.shortcoming()) is None:
        result = replace(result, asset=replace(asset, splats=found.apply(asset.splats)))
    else:
        rows["Materials"] = (
            f"not used, and the captured colours are kept: {reason}; check whether the lights are those of the photos "
            "and the mesh is smooth, or import a CAD mesh"
        )
    return replace(result, verdict=replace(result.verdict, rows={**result.verdict.rows, **rows}))


def read_fit(path: Path) -> tuple[Path, float | None]:
    """Return the splat file and the held-out PSNR [dB] of a fit folder, or None for the PSNR of a plain splat file.

    Raises:
        InputError: If the folder has no finished fit.
    """
    if not path.is_dir():
        return path, None
    record = path / FIT_FILE
    stored = read_record(record)
    try:
        psnr = stored["psnr"]
        known = None if psnr is None else float(psnr)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{record}: not the record of a fit ({error})") from error
    if known is not None and not math.isfinite(known):
        raise InputError(f"{record}: psnr must be finite (got {known})")
    return path / "splats.ply", known


def refuse_to_replace(out: Path, splats: Path) -> None:
    """Refuse an output folder whose splats are the input, or whose files do not belong to an asset.

    Raises:
        InputError: If a file would be replaced; the message names it.
    """
    known = any((out / name).exists() for name in (ASSET_FILE, REPORT_FILE))
    for name in ("splats.ply", "materials.ply", "mesh.ply", "pieces.ply"):
        if (out / name).resolve() == splats.resolve() or ((out / name).exists() and not known):
            raise InputError(f"{out / name}: would be replaced: choose another output folder")


def _edited_backup(out: Path) -> Path | None:
    """Return a new path for the ``asset.yaml`` of an earlier run if it was edited since, or None."""
    described = out / ASSET_FILE
    try:
        if json.loads((out / VERDICT_FILE).read_text())[ASSET_FILE] == file_hash(described):
            return None
    except (OSError, ValueError, KeyError, TypeError):  # written by another version or edited by hand
        if not described.exists():
            return None
    names = (out / f"asset.edited{number if number > 1 else ''}.yaml" for number in itertools.count(1))
    return next(path for path in names if not path.exists())


_REMOVED_FIELDS = ("outside", "unseen", "needles", "floaters")


def _save_verdict(out: Path, result: Reconstruction, inputs: str) -> None:
    """Write the verdict of an asset with the hashes of its inputs and of ``asset.yaml``."""
    record: JsonObject = {"inputs": inputs, **asdict(result.verdict), **result.record}
    record[ASSET_FILE] = file_hash(out / ASSET_FILE)
    record["asset_from_capture"] = result.asset_from_capture.tolist()
    if result.isolation is not None:
        record["removed"] = {name: getattr(result.isolation, name) for name in _REMOVED_FIELDS}
    if result.alignment is not None:
        record["alignment"] = {
            "scale": result.alignment.scale,
            "residual": result.alignment.residual,
            "splats_from_mesh": result.alignment.splats_from_mesh.tolist(),
        }
    write_text(out / VERDICT_FILE, json.dumps(record, indent=1) + "\n")


def _input_hash(capture: Capture, splats: Path, job: AssetJob) -> str:
    """Return the hash of all inputs of the asset."""
    imported = None
    if job.imported is not None:
        matrix = job.imported.capture_from_mesh
        imported = [
            ContentHash(job.imported.mesh.vertices.tobytes(), job.imported.mesh.faces.tobytes()).hexdigest(),
            None if matrix is None else matrix.tolist(),
            job.imported.metres_per_unit,
        ]
    digest = ContentHash(capture.content_hash)
    digest.add_json(
        [__version__, job.name, job.class_name, job.kind, asdict(job.settings), imported, job.remove, job.material]
    )
    if job.light is not None:
        digest.add_json(job.light.content())
    digest.add_file(splats)
    return digest.hexdigest()


def _existing_asset(out: Path, inputs: str) -> AssetResult | None:
    """Return the asset of an earlier run with the same inputs if it is complete, or None."""
    if not all((out / name).is_file() for name in (VERDICT_FILE, REPORT_FILE, ASSET_FILE)):
        return None
    try:
        spec = read_spec(out)
        if not all(
            (out / file).is_file() for file in (spec.splats, spec.materials, spec.mesh, spec.pieces) if file is not None
        ):
            return None
        record = json.loads((out / VERDICT_FILE).read_text())
        if record.pop("inputs") != inputs:
            return None
        return AssetResult(out, Verdict(**{name: record[name] for name in Verdict.__dataclass_fields__}), kept=True)
    except (ValueError, KeyError, TypeError, OSError):
        return None
