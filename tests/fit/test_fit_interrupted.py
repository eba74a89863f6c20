"""Interrupted replacement of a fit: the folder never mixes two fits, and the next run completes the new one."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from mitsplat.capture.capture import Capture
from mitsplat.capture.pipeline.capture_result import CaptureResult
from mitsplat.capture.pipeline.capture_settings import CaptureSettings
from mitsplat.errors import InputError
from mitsplat.fit import fit_folder
from mitsplat.fit import trainer as fit
from mitsplat.fit.trainer import fit_capture
from mitsplat.reconstruct.pipeline.asset_pipeline import AssetResult, asset_from_photos
from mitsplat.reconstruct.reconstruct import AssetJob
from tests.fit.test_fit import SMALL, photograph
from tests.reconstruct.test_reconstruct import GOOD

TINY = replace(SMALL, gaussians=40, iterations=6, refine_every=2, sh_degree=0, max_size=64)
NEW = replace(TINY, seed=1, target_psnr=60.0)

CHILD = """
import signal, sys
sys.path.insert(0, {tests!r})
from tests.fit.test_fit_interrupted import NEW, Places
from mitsplat.capture.capture import Capture
from mitsplat.fit.trainer import fit_capture
with Places({place}, signal.{how}).watched():
    fit_capture(Capture.load({capture!r}), {out!r}, NEW, overwrite=True)
"""


class Interrupted(BaseException):
    """Exception that no code catches."""


@dataclass
class Places:
    """Interruption at the n-th step of a fit or change of its folder.

    Attributes:
        left: Steps and changes until the interruption.
        how: Signal that the process sends itself; None raises :class:`Interrupted`.
    """

    left: int
    how: signal.Signals | None = None

    def pass_by(self) -> None:
        self.left -= 1
        if self.left == 0:
            if self.how is None:
                raise Interrupted
            signal.raise_signal(self.how)

    @contextmanager
    def watched(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(fit, "_REPORT_STEPS", 2)
            patch.setattr(fit, "_CHECKPOINT_SECONDS", 0.0)
            for owner, name in (
                (fit._Fit, "step"),
                (Path, "unlink"),
                (Path, "replace"),
                (fit_folder.shutil, "rmtree"),
            ):
                patch.setattr(owner, name, self._after(getattr(owner, name)))
            yield

    def _after(self, inner: Any) -> Any:
        def outer(*args: Any, **kwargs: Any) -> Any:
            result = inner(*args, **kwargs)
            self.pass_by()
            return result

        return outer


@dataclass(frozen=True)
class Fits:
    """Capture, and the folders of two fits to it."""

    capture: Capture
    old: Path
    new: Path

    def is_whole(self, folder: Path) -> bool:
        """Return True if a folder has a finished fit; all its files must be of the same fit."""
        if not (folder / "fit.json").exists():
            return False
        seed = json.loads((folder / "fit.json").read_text())["settings"]["seed"]
        whole = self.old if seed == TINY.seed else self.new
        names = ("splats.ply", *(f"held_out/{number:02}.png" for number in (0, 8, 16)))
        assert all((folder / name).read_bytes() == (whole / name).read_bytes() for name in names)
        return True

    def is_new(self, folder: Path) -> bool:
        """Return True if a folder has the second fit and nothing else."""
        names = ("fit.json", "held_out", "held_out/00.png", "held_out/08.png", "held_out/16.png", "splats.ply")
        return (
            self.is_whole(folder)
            and json.loads((folder / "fit.json").read_text())["settings"]["seed"] == NEW.seed
            and sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*")) == sorted(names)
        )


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> Fits:
    folder = tmp_path_factory.mktemp("fits")
    capture = photograph(folder).save(folder / "capture")
    fit_capture(capture, folder / "old", TINY)
    fit_capture(capture, folder / "new", NEW)
    assert (folder / "old/splats.ply").read_bytes() != (folder / "new/splats.ply").read_bytes()
    return Fits(capture, folder / "old", folder / "new")


def interrupted(fits: Fits, out: Path, place: int) -> bool:
    """Replace the old fit with an interruption at a place, and return True if the interruption happened."""
    shutil.copytree(fits.old, out)
    try:
        with Places(place).watched():
            fit_capture(fits.capture, out, NEW, overwrite=True)
    except Interrupted:
        return True
    return False


@pytest.mark.extended
def test_a_replacing_fit_interrupted_anywhere_ends_in_the_same_bytes(fits: Fits, tmp_path: Path) -> None:
    """The fit is interrupted after each step and each change of the folder.

    The next run gives the same bytes with and without overwriting.
    """
    left, place = [], 1
    while interrupted(fits, out := tmp_path / str(place), place):
        left.append(sorted(path.name for path in out.iterdir() if path.name[0] != "."))
        fits.is_whole(out)
        overwrite = place % 2 == 0
        if place % 3 == 0:  # a second interruption soon after
            with Places(4).watched(), suppress(Interrupted):
                fit_capture(fits.capture, out, NEW, overwrite=True)
        fit_capture(fits.capture, out, NEW, overwrite=overwrite)
        assert fits.is_new(out)
        place += 1
    assert fits.is_new(out)
    assert place > 15
    assert ["checkpoint.npz"] in left and ["held_out"] in left and ["checkpoint.npz", "held_out", "splats.ply"] in left


@pytest.mark.parametrize("place", [2, 7, 12])
def test_an_asset_with_an_interrupted_fit_resumes_to_the_same_bytes(
    fits: Fits, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    """Settings change, the run is interrupted, and the same command runs again. `asset` has no --overwrite."""
    captured = CaptureResult(fits.capture, 20, "a board", 0.5, doubtful={})
    monkeypatch.setattr(
        "mitsplat.reconstruct.pipeline.asset_pipeline.capture_photos", lambda photos, out, settings, progress: captured
    )
    monkeypatch.setattr(
        "mitsplat.reconstruct.pipeline.asset_pipeline.make_asset",
        lambda *args, **kwargs: AssetResult(tmp_path, GOOD, kept=False),
    )

    def make(settings: fit.FitSettings) -> None:
        asset_from_photos(tmp_path, tmp_path, AssetJob(name="part"), capture=CaptureSettings(), fit=settings)

    make(TINY)
    before = (tmp_path / "fit/splats.ply").stat().st_mtime_ns
    make(TINY)
    assert (tmp_path / "fit/splats.ply").stat().st_mtime_ns == before
    with Places(place).watched(), pytest.raises(Interrupted):
        make(NEW)
    make(NEW)
    assert fits.is_new(tmp_path / "fit")


@pytest.mark.cpu(reason="the processes that are ended fit on the CPU, and their fit goes on in this one")
@pytest.mark.parametrize(("place", "how"), [pytest.param(1, "SIGINT", marks=pytest.mark.extended), (10, "SIGKILL")])
def test_a_fit_process_that_is_killed_resumes_to_the_same_bytes(
    fits: Fits, tmp_path: Path, place: int, how: str
) -> None:
    """SIGINT stands for Ctrl-C, SIGKILL for the kernel's out-of-memory killer. Any process can resume the fit."""
    out = Path(shutil.copytree(fits.old, tmp_path / "out"))
    names = {"tests": str(Path(__file__).parents[2]), "capture": str(fits.old.parent / "capture"), "out": str(out)}
    code = CHILD.format(**names, place=place, how=how)
    # Children of a background shell job ignore Ctrl-C without the default handler.
    ended = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert ended.returncode == -signal.Signals[how], ended.stderr
    assert not (out / "fit.json").exists()
    assert (out / "checkpoint.npz").exists() == (place > 5)
    fit_capture(fits.capture, out, NEW)
    assert fits.is_new(out)


def test_damaged_files_are_replaced_with_overwrite(fits: Fits, tmp_path: Path) -> None:
    for name, content in (("splats.ply", None), ("splats.ply", b"ply"), ("fit.json", b"[]"), ("checkpoint.npz", b"")):
        out = Path(shutil.copytree(fits.new, tmp_path / "out"))
        (out / name).unlink(missing_ok=True)
        if content is not None:
            (out / name).write_bytes(content)
        if name != "checkpoint.npz":
            with pytest.raises(InputError, match=rf"{name}.*; --overwrite replaces it"):
                fit_capture(fits.capture, out, NEW)
        fit_capture(fits.capture, out, NEW, overwrite=True)
        assert fits.is_new(out)
        shutil.rmtree(out)


def test_a_checkpoint_of_other_inputs_is_refused_in_one_sentence(fits: Fits, tmp_path: Path) -> None:
    with Places(8).watched(), pytest.raises(Interrupted):
        fit_capture(fits.capture, tmp_path, TINY)
    with pytest.raises(InputError, match=r"checkpoint\.npz: belongs to a fit of other photos or settings.*--overwrite"):
        fit_capture(fits.capture, tmp_path, NEW)
    fit_capture(fits.capture, tmp_path, NEW, overwrite=True)
    assert fits.is_new(tmp_path)
