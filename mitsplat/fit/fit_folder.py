"""The folder of a fit, which never contains files of two different fits.

``fit.json`` (:class:`FitResult` and the settings) is written last and removed first. If it exists, ``splats.ply`` and
``held_out/NAME.png`` (photo | render | difference) of every held-out photo belong to it. An unfinished fit resumes from
``checkpoint.npz``. Both files contain the hash of the inputs.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mitsplat.arrays import AnyArray
from mitsplat.errors import InputError
from mitsplat.fit.training_view import HeldOut
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.storage.files import JsonObject, write_file, write_text
from mitsplat.storage.format_version import FORMAT_VERSION, FORMAT_VERSIONS, check_format_version

FIT_FILE = "fit.json"
_CHECKPOINT = "checkpoint.npz"
T = TypeVar("T")
_RUNNING_MARKER = ".unfinished"
"""Marker file of a running or interrupted fit."""


@dataclass(frozen=True, eq=False)
class FitResult:
    """Result of a fit.

    Attributes:
        splats: The Gaussians, in the capture's frame and units.
        iterations: Number of optimiser steps.
        seconds: Duration of the steps, over all runs [s].
        held_out: Quality on photos that affected neither the fit nor its end.
        inputs: SHA-256 of photos, masks, depth maps, cameras, points, settings and version.
        warnings: Sentences on inputs that could not be used, and on a budget that allowed few steps.
        validation: Quality on photos that were not fitted, and whose PSNR decided the end of the fit; empty without a
            target.
    """

    splats: Splats
    iterations: int
    seconds: float
    held_out: tuple[HeldOut, ...]
    inputs: str
    warnings: tuple[str, ...] = ()
    validation: tuple[HeldOut, ...] = ()

    @property
    def psnr(self) -> float:
        """Mean PSNR of the held-out photos [dB]."""
        return _mean_psnr(self.held_out)

    @property
    def ssim(self) -> float:
        """Mean SSIM of the held-out photos."""
        return float(np.mean([h.ssim for h in self.held_out]))

    @property
    def validation_psnr(self) -> float | None:
        """Mean PSNR of the validation photos [dB], or None without a target."""
        return _mean_psnr(self.validation) if self.validation else None


def _read_held_out(photo: JsonObject) -> HeldOut:
    """Read the fields of a photo and ignore fields that only older versions wrote."""
    return HeldOut(**{field.name: photo[field.name] for field in fields(HeldOut)})


def _mean_psnr(photos: Sequence[HeldOut]) -> float:
    return float(np.mean([photo.psnr for photo in photos]))


def read_record(path: Path) -> JsonObject:
    """Read ``fit.json`` and check its format version; the keys are not checked.

    Raises:
        InputError: If the file is missing, not JSON, or of a newer version.
    """
    try:
        record: JsonObject = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file: has the fit finished?") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not the record of a fit ({error})") from error
    check_format_version(record, FORMAT_VERSIONS[FIT_FILE], path)
    return record


@dataclass(frozen=True)
class FitFolder:
    """Output folder of a fit with given inputs.

    Attributes:
        path: The folder.
        inputs: Hash of all inputs of the fit.
    """

    path: Path
    inputs: str

    @property
    def held_out(self) -> Path:
        """Folder of the comparisons with the held-out photos."""
        return self.path / "held_out"

    def finished(self, *, overwrite: bool) -> FitResult | None:
        """Return the finished fit of these inputs, or None; arguments and errors are as in :meth:`checkpoint`."""
        result = self._existing(FIT_FILE, self._read, overwrite)
        if result is not None:
            for name in (_CHECKPOINT, _RUNNING_MARKER):  # left by a run that was interrupted after its last step
                (self.path / name).unlink(missing_ok=True)
        return result

    def checkpoint(self, *, overwrite: bool) -> dict[str, AnyArray] | None:
        """Return the checkpoint of an unfinished fit of these inputs, or None.

        Args:
            overwrite: True to treat a file of other inputs, or a damaged file, as absent.

        Raises:
            InputError: If the folder contains such a file and ``overwrite`` is False.
        """
        return self._existing(_CHECKPOINT, self._read_checkpoint, overwrite)

    def _existing(self, name: str, read: Callable[[Path], T], overwrite: bool) -> T | None:
        """Return the content of a file if it exists and belongs to this fit."""
        path = self.path / name
        if not path.exists():
            return None
        try:
            return read(path)
        except InputError as error:
            if overwrite:
                return None
            raise InputError(f"{error}; --overwrite replaces it") from error

    def _read(self, path: Path) -> FitResult:
        """Read the record and the splats of a finished fit."""
        record = read_record(path)
        try:
            held_out, validation = (
                tuple(_read_held_out(photo) for photo in record[name]) for name in ("held_out", "validation")
            )
            found, iterations, seconds = record["inputs"], int(record["iterations"]), float(record["seconds"])
            warnings = tuple(record["warnings"])
        except KeyError as error:
            raise InputError(f"{path}: not the record of a fit by this version (it lacks {error})") from error
        except (ValueError, TypeError) as error:
            raise InputError(f"{path}: not the record of a fit ({error})") from error
        self._check_inputs(path, found)
        splats = Splats.load(self.path / "splats.ply")
        return FitResult(splats, iterations, seconds, held_out, self.inputs, warnings, validation)

    def _read_checkpoint(self, path: Path) -> dict[str, AnyArray]:
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                state = dict(stored)
            found = str(state.pop("inputs"))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: not a checkpoint of a fit ({error})") from error
        self._check_inputs(path, found)
        return state

    def _check_inputs(self, path: Path, found: str) -> None:
        if found != self.inputs:
            raise InputError(f"{path}: belongs to a fit of other photos or settings, or by another version")

    def refuse_others(self) -> None:
        """Refuse a folder whose files a fit would replace, if they are not from a fit.

        Raises:
            InputError: If there is such a file; the message names it.
        """
        if any((self.path / name).exists() for name in (FIT_FILE, _CHECKPOINT, _RUNNING_MARKER)):
            return
        for there in (self.path / "splats.ply", self.held_out):
            if there.exists():
                raise InputError(f"{there}: exists already and does not belong to a fit; --overwrite replaces it")

    def start(self, *, resumed: bool) -> None:
        """Remove the files of an earlier fit, the record first; keep the checkpoint if the fit resumes from it."""
        self.path.mkdir(parents=True, exist_ok=True)
        (self.path / _RUNNING_MARKER).touch()
        (self.path / FIT_FILE).unlink(missing_ok=True)
        if not resumed:
            (self.path / _CHECKPOINT).unlink(missing_ok=True)
        (self.path / "splats.ply").unlink(missing_ok=True)
        shutil.rmtree(self.held_out, ignore_errors=True)
        for part in self.path.glob(".*.part"):  # left by a run that was killed during a write
            part.unlink()

    def save_checkpoint(self, state: Mapping[str, Any]) -> None:
        """Write a checkpoint."""

        def write(temporary: Path) -> None:
            with temporary.open("wb") as file:
                np.savez(file, inputs=self.inputs, **state)

        write_file(self.path / _CHECKPOINT, write)

    def save(self, result: FitResult, known: JsonObject) -> None:
        """Write the finished fit; the record contains the result and the entries of ``known``."""
        result.splats.save(self.path / "splats.ply")
        names = ("inputs", "iterations", "seconds", "psnr", "ssim", "validation_psnr", "warnings")
        record = {FORMAT_VERSION: FORMAT_VERSIONS[FIT_FILE]} | {name: getattr(result, name) for name in names}
        record |= {"gaussians": len(result.splats)} | dict(known)
        record |= {name: [asdict(p) for p in getattr(result, name)] for name in ("held_out", "validation")}
        write_text(self.path / FIT_FILE, json.dumps(record, indent=1) + "\n")
        for name in (_CHECKPOINT, _RUNNING_MARKER):
            (self.path / name).unlink(missing_ok=True)
