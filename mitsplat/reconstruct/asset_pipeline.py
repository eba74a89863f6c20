"""Pipeline from photographs to an asset folder: capture, fit, isolation, mesh and evaluation.

Each stage is repeated only if its inputs change. The work folders ``capture/`` and ``fit/`` inside the asset folder
contain the results of those stages, which check their own inputs. The last stage stores a hash of all its inputs in
``verdict.json``, together with the quality figures.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from mitsplat.asset import ASSET_FILE, read_spec
from mitsplat.capture.capture import Capture
from mitsplat.capture.pipeline.capture_pipeline import CaptureSettings, capture_photos
from mitsplat.errors import InputError
from mitsplat.fit.fit_folder import FIT_FILE, read_record
from mitsplat.fit.trainer import FitProgress, FitSettings, fit_capture
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.pages.html import REPORT_FILE
from mitsplat.progress import Progress
from mitsplat.reconstruct.asset_evaluation import VERDICT_FILE, Verdict
from mitsplat.reconstruct.asset_report import write_asset_report
from mitsplat.reconstruct.reconstruct import (
    ImportedMesh,
    Reconstruction,
    ReconstructSettings,
    check_refinable,
    reconstruct_asset,
)
from mitsplat.storage.content_hash import ContentHash, file_hash
from mitsplat.storage.files import write_text
from mitsplat.version import __version__


@dataclass(frozen=True, eq=False)
class AssetJob:
    """Description of the asset to make.

    Attributes:
        name: Name of the asset.
        class_name: Class for detectors; the name if None.
        kind: Objects are isolated and can be dropped; environments stay whole.
        settings: Settings of the reconstruction.
        imported: Mesh that replaces the reconstructed one.
        remove: Things to remove from an environment, PHOTO:X,Y in pixels of the capture's photos.

    Raises:
        InputError: If an object's mesh cannot be refined, or ``remove`` is used with an object or an imported mesh.
    """

    name: str
    class_name: str | None = None
    kind: Literal["object", "environment"] = "object"
    settings: ReconstructSettings = field(default_factory=ReconstructSettings)
    imported: ImportedMesh | None = None
    remove: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_refinable(self.settings, self.kind, self.imported)
        if self.remove and self.kind != "environment":
            raise InputError("things can be removed only from an environment: use --kind environment, or omit --remove")
        if self.remove and self.imported is not None:
            raise InputError("things cannot be removed from an imported mesh: omit one of the two")


@dataclass(frozen=True)
class AssetResult:
    """An asset on disk.

    Attributes:
        folder: Folder of the asset.
        verdict: Quality figures.
        kept: True if an earlier run made the asset from the same inputs.
        warnings: Warnings on the photographs, one sentence each.
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


Maker = Callable[[Capture, Splats, AssetJob, float | None, str | None, Progress | None], Reconstruction]
"""Function that makes an asset from a capture and splats.

Further arguments are the job, the held-out PSNR of the fit [dB], the source of the scale, and a progress callback.
"""


def reconstruct_job(
    capture: Capture, splats: Splats, job: AssetJob, psnr: float | None, source: str | None, progress: Progress | None
) -> Reconstruction:
    """Reconstruct the asset of a job with :func:`~mitsplat.reconstruct.reconstruct.reconstruct_asset`; a :data:`Maker`.

    Raises:
        InputError: As in that function.
    """
    return reconstruct_asset(
        capture, splats, name=job.name, class_name=job.class_name, kind=job.kind, settings=job.settings,
        imported=job.imported, psnr=psnr, progress=progress,
    )  # fmt: skip


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


def asset_from_photos(
    photos: Path,
    out: Path,
    job: AssetJob,
    *,
    capture: CaptureSettings | None = None,
    fit: FitSettings | None = None,
    make: Maker = reconstruct_job,
    progress: Progress | None = None,
) -> AssetResult:
    """Make an asset from a folder of photographs; stages with unchanged inputs are not repeated.

    Args:
        photos: Folder of photographs of one object or place.
        out: Folder of the asset, with the work folders ``capture/`` and ``fit/``.
        job: Description of the asset.
        capture: Settings for cameras, scale and masks; defaults if None.
        fit: Settings of the fit; defaults if None.
        make: Function of the last stage.
        progress: Progress callback.

    Raises:
        InputError: If the photographs do not suffice.
        MissingResourceError: If a required program or model is missing.
    """
    fit = fit or FitSettings()
    taken = capture_photos(photos, out / "capture", capture or CaptureSettings(), progress=progress)
    found = taken.capture

    def fitting(now: FitProgress) -> None:
        if progress is not None:
            done = int(now.fraction * fit.iterations)
            progress(done, fit.iterations, f"fitting: {now.psnr:.1f} dB, {now.gaussians} Gaussians")

    fit_capture(found, out / "fit", fit, overwrite=True, progress=fitting)
    done = make_asset(out / "capture", out / "fit", out, job, make=make, source=taken.source, progress=progress)
    return replace(done, warnings=(*taken.warnings, *done.warnings))


def make_asset(
    capture_folder: Path,
    fit: Path,
    out: Path,
    job: AssetJob,
    *,
    make: Maker = reconstruct_job,
    source: str | None = None,
    progress: Progress | None = None,
) -> AssetResult:
    """Write the asset of a capture and a fit with its verdict and its report, unless they already exist.

    Args:
        capture_folder: Folder of ``mitsplat capture``.
        fit: Folder of ``mitsplat fit``, or a splat file in the capture's frame.
        out: Folder of the asset.
        job: Description of the asset.
        make: Function that makes the asset.
        source: Source of the capture's scale and gravity, a clause.
        progress: Progress callback.

    Raises:
        InputError: If a file is missing or damaged, or an object has no masks.
    """
    capture = Capture.load(capture_folder)
    splat_file, psnr = read_fit(fit)
    inputs = _input_hash(capture_folder, capture, splat_file, job)
    done = _existing_asset(out, inputs)
    if done is not None:
        return done
    refuse_to_replace(out, splat_file)
    edited = _edited_backup(out)
    result = make(capture, Splats.load(splat_file), job, psnr, source, progress)
    (out / VERDICT_FILE).unlink(missing_ok=True)
    if edited is not None:
        (out / ASSET_FILE).replace(edited)
    result.asset.save(out)
    write_asset_report(out, capture, result)
    # Written last, so that an interrupted run does not look finished.
    _save_verdict(out, result, inputs)
    warnings = () if edited is None else (f"{ASSET_FILE} had been edited: the edited file is now {edited.name}",)
    return AssetResult(out, result.verdict, kept=False, warnings=warnings)


def refuse_to_replace(out: Path, splats: Path) -> None:
    """Refuse an output folder whose splats are the input, or whose files do not belong to an asset.

    Raises:
        InputError: If a file would be replaced; the message names it.
    """
    known = any((out / name).exists() for name in (ASSET_FILE, REPORT_FILE))
    for name in ("splats.ply", "mesh.ply", "pieces.ply"):
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


def _save_verdict(out: Path, result: Reconstruction, inputs: str) -> None:
    record: dict[str, Any] = {"inputs": inputs, **asdict(result.verdict), **result.record}
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


_REMOVED_FIELDS = ("outside", "unseen", "needles", "floaters")


def _input_hash(folder: Path, capture: Capture, splats: Path, job: AssetJob) -> str:
    """Return the hash of all inputs of the asset."""
    imported = None
    if job.imported is not None:
        matrix = job.imported.capture_from_mesh
        imported = [
            ContentHash(job.imported.mesh.vertices.tobytes(), job.imported.mesh.faces.tobytes()).hexdigest(),
            None if matrix is None else matrix.tolist(),
            job.imported.metres_per_unit,
        ]
    decisive = [__version__, job.name, job.class_name, job.kind, asdict(job.settings), imported, job.remove]
    digest = ContentHash()
    digest.add_json(decisive)
    for path in (*_capture_files(folder, capture), splats):
        digest.add_file(path)
    return digest.hexdigest()


def _capture_files(folder: Path, capture: Capture) -> list[Path]:
    """Return all files of a capture."""
    pictures = [path for photo in capture.photos for path in (photo.file, photo.mask) if path is not None]
    return [folder / "capture.json", folder / "points.npz", *pictures]


def _existing_asset(out: Path, inputs: str) -> AssetResult | None:
    """Return the asset of an earlier run with the same inputs if it is complete, or None."""
    if not all((out / name).is_file() for name in (VERDICT_FILE, REPORT_FILE, ASSET_FILE)):
        return None
    try:
        spec = read_spec(out)
        if not all((out / file).is_file() for file in (spec.splats, spec.mesh, spec.pieces) if file is not None):
            return None
        record = json.loads((out / VERDICT_FILE).read_text())
        if record.pop("inputs") != inputs:
            return None
        return AssetResult(out, Verdict(**{name: record[name] for name in Verdict.__dataclass_fields__}), kept=True)
    except (ValueError, KeyError, TypeError, OSError):
        return None
