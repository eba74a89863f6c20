"""Figures of the documentation: recorded by benchmarks, inserted into pages, and checked."""

from __future__ import annotations

import argparse
import copy
import json
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main

from benchmarks import again, figures, record
from benchmarks.detector.table import experiment_table, gain_cells
from benchmarks.figures import FigureError, caption, differences, filled, formatted, read_results, unsaid
from benchmarks.record import configuration_of, figure, read_recorded, recording, refusal, revision
from mitsplat.checks import doctor
from mitsplat.cli import app

ROOT = Path(__file__).parents[1]
RESULTS = read_results()


def test_pages_equal_those_generated_from_the_results() -> None:
    assert differences(RESULTS) == []


def test_pages_name_existing_tests() -> None:
    names = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        names |= {path.stem, *re.findall(r"def (test_\w+)\(", path.read_text())}
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").rglob("*.md")]
    named = {(page.name, name) for page in pages for name in re.findall(r"[`/:](test_\w+)", page.read_text())}
    assert len(named) > 50
    assert {(page, name) for page, name in named if name not in names} == set()


def test_a_changed_figure_is_reported_for_the_page_that_shows_it() -> None:
    changed = copy.deepcopy(RESULTS)
    changed["scale.faults-seed_51-frames_6"]["figures"]["kills"][0] += 1
    found = " ".join(differences(changed))
    assert "docs/reliability.md is not" in found and "docs/figures.md" not in found


def test_a_sentence_with_another_figure_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "TEMPLATES", tmp_path)
    (tmp_path / "sentences.md").write_text("# page.md\n\n* It takes {{ one seconds .1f }} s.\n")
    (tmp_path / "page.md").write_text("Some words. It takes\n1.3 s. More.\n")
    assert list(unsaid({"one": {"figures": {"seconds": [1.26, "s"]}}})) == []
    assert list(unsaid({"one": {"figures": {"seconds": [1.46, "s"]}}})) == ["page.md should say: It takes 1.5 s."]


def test_detectors_are_compared_over_the_same_draws_of_scenes() -> None:
    def run(strict: float, samples: list[float]) -> dict[str, Any]:
        return {"figures": {"map50_95": [strict, ""], "map50": [2 * strict, ""], "samples": [samples, ""]}}

    draws = np.random.default_rng(1).uniform(0.2, 0.6, 200)  # wide spread of scenes, equal for every arm
    results = {
        "detector.experiment-real-0": run(0.25, list(draws - 0.15)),
        "detector.experiment-synthetic-0": run(0.40, list(draws)),
        "detector.experiment-synthetic-1": run(0.42, list(draws + 0.02)),
        "detector.experiment-no_shadow-0": run(0.35, list(draws - 0.05)),
        "detector.experiment-traced_shadow-0": run(0.45, list(draws + 0.05)),
        "detector.experiment-images_3177-0": run(0.38, list(draws - 0.02)),
        "detector.experiment-traced_shadow-0-plan_workshop": run(0.3, list(draws - 0.1)),
        "detector.experiment-no_shadow-0-plan_workshop": run(0.2, list(draws - 0.2)),
    }
    *_, earlier, shadow, real, synthetic, _ = experiment_table(results).splitlines()
    low, high = np.percentile(draws, [2.5, 97.5])
    interval = f"{low - 0.15:.3f} to {high - 0.15:.3f}"
    assert real == f"| `real` | 1 | 0.250 | {interval} | 0.500 | `synthetic` | 0.150 to 0.170 |"
    assert synthetic.startswith("| `synthetic` | 2 | 0.410 | ") and synthetic.endswith("| 0.820 | – | – |")
    assert shadow.endswith("| `traced_shadow` | 0.100 to 0.100 |")  # same views
    assert earlier.endswith("| – | – |")  # no arm to compare with
    assert gain_cells(results, "arms", "no_shadow", "traced_shadow") == "−0.100 | −0.100 to −0.100"
    assert gain_cells(results, "arms", "synthetic", "real") == "+0.160 | +0.150 to +0.170"
    results["detector.experiment-no_shadow-0"]["figures"]["scenes"] = ["of later ones", ""]
    results["detector.experiment-real-0"]["figures"]["scenes"] = ["", ""]
    *_, shadow, real, _, _ = experiment_table(results).splitlines()
    assert shadow.endswith("| – | – |") and real.endswith("| `synthetic` | 0.150 to 0.170 |")
    results["detector.experiment-images_3087-0"] = run(0.38, list(draws - 0.02))
    for seed in range(2):
        results[f"detector.experiment-synthetic-{seed}"]["figures"]["scenes"] = ["of later ones", ""]
    *_, before, _, _, _, _, _ = experiment_table(results).splitlines()
    assert before.endswith("| `synthetic` | 0.020 to 0.040 |")  # compared although of other scenes
    *_, shadow, traced = experiment_table(results, "workshop").splitlines()
    assert shadow.endswith("| `traced_shadow` | 0.100 to 0.100 |")
    assert traced.startswith("| `traced_shadow` | 1 | 0.300 | ")


@pytest.mark.parametrize(
    "text",
    [
        "render.none whole .2f",
        "render.frame none .2f",
        "cells render.frame render x:.1f",
        "caption none",
        "caption",
        "render.frame",
        "",
    ],
)
def test_a_place_of_a_template_without_a_result_is_refused(text: str) -> None:
    with pytest.raises(FigureError):
        filled(f"{{{{ {text} }}}}", RESULTS)


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [
        (0.523, ".2f", "0.52"),
        (12345, ",d", "12,345"),
        (0.35, ".0%", "35 %"),
        ([0.351, 0.404], ".2f", "0.35 to 0.40"),
        ([0.351, 0.352], ".2f", "0.35"),
        (0.002, "*1000:.1f", "2.0"),
        (-1.5, ".1f", "−1.5"),
        (None, ".2f", "–"),
        ("∞", ".1f", "∞"),
    ],
)
def test_a_figure_is_formatted_by_its_specification(value: object, spec: str, text: str) -> None:
    assert formatted(value, spec) == text


def test_a_specification_that_does_not_fit_the_figure_is_refused() -> None:
    with pytest.raises(FigureError, match=r"0\.5 cannot be written as ,d"):
        formatted(0.5, ",d")


def options(*words: str) -> tuple[argparse.ArgumentParser, argparse.Namespace]:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", nargs="?")
    parser.add_argument("--scene", type=Path, default=Path("scenes/workcell.yaml"))
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--ten", action="store_true")
    parser.add_argument("--out", type=Path)
    return parser, parser.parse_args(words)


@pytest.mark.parametrize(
    ("words", "configuration"),
    [
        ((), ""),
        (("--frames", "8", "--out", "a"), ""),
        (("rate", "--frames", "6", "--ten"), "rate-frames_6-ten"),
        (("--scene", "scenes/real.yaml"), "scene_real"),
        (("--frames", "1"), "frames_1"),
    ],
)
def test_a_configuration_has_the_arguments_that_change_figures(words: tuple[str, ...], configuration: str) -> None:
    assert configuration_of(*options(*words), ("out",)) == configuration


@pytest.fixture
def clean(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mock a checkout without uncommitted changes, for any state of the tested one."""
    monkeypatch.setattr(record, "refusal", lambda: None)
    monkeypatch.setattr(record, "RECORDS", True)


@pytest.mark.usefixtures("clean")
def test_a_run_is_recorded_with_command_machine_and_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["frame.py", "--frames", "3"])
    with recording("render.frame", *options("--frames", "3"), folder=tmp_path):
        figure(0.123456789, "s", "whole frame")
        figure([1, math.inf], "dB", "fast, EWA", "psnr")
        figure(math.nan, "", "none")
    ((name, found),) = read_recorded(tmp_path).items()
    assert name == "render.frame-frames_3" and found["configuration"] == "frames_3"
    assert found["command"] == "python -m benchmarks.render.frame --frames 3"
    assert found["figures"] == {"whole_frame": [0.123457, "s"], "fast_ewa.psnr": [[1, "∞"], "dB"], "none": [None, ""]}
    assert found["recorded"] == "run" and found["machine"]["cores"] and found["load"]["start"] is not None
    assert caption(found).startswith("`python -m benchmarks.render.frame --frames 3` on ")


@pytest.mark.usefixtures("clean")
def test_the_last_run_of_a_configuration_replaces_its_line_only(tmp_path: Path) -> None:
    path = tmp_path / "render.frame.jsonl"
    for value, words in enumerate([("rate",), ("--ten",), (), ("--frames", "3")]):
        with recording("render.frame", *options(*words), folder=tmp_path):
            figure(value, "s", "whole frame")
    before = path.read_text().splitlines()
    assert [json.loads(line)["configuration"] for line in before] == ["", "frames_3", "rate", "ten"]
    with recording("render.frame", *options("rate"), folder=tmp_path):
        figure(9, "s", "whole frame")
    after = path.read_text().splitlines()
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, True, False, True]
    assert read_recorded(tmp_path)["render.frame-rate"]["figures"] == {"whole_frame": [9, "s"]}


@pytest.mark.usefixtures("clean")
def test_a_run_that_fails_is_not_recorded(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), recording("render.frame", *options(), folder=tmp_path):
        figure(1, "s", "whole frame")
        raise RuntimeError
    figure(1, "s", "after the recording")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("clean")
def test_a_run_without_recording_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "RECORDS", False)
    monkeypatch.setattr(record, "refusal", lambda: "error: uncommitted changes")
    with recording("render.frame", *options(), folder=tmp_path):
        figure(1, "s", "whole frame")
    assert not list(tmp_path.iterdir())


def test_a_run_from_a_dirty_checkout_is_refused_after_it_has_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def git(*words: str) -> None:
        subprocess.run(["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b", *words], check=True)

    git("init", "--quiet")
    (tmp_path / "mitsplat").mkdir()
    (tmp_path / "mitsplat/quality.py").write_text("FAST = 1\n")
    (tmp_path / "README.md").write_text("Fast.\n")
    git("add", ".")
    git("commit", "--quiet", "-m", "first")
    (tmp_path / "README.md").write_text("Faster.\n")
    assert refusal(tmp_path) is None  # no figure depends on README
    (tmp_path / "mitsplat/quality.py").write_text("FAST = 2\n")
    (tmp_path / "mitsplat/new.py").touch()
    monkeypatch.setattr(record, "RECORDS", True)
    monkeypatch.setattr(record, "refusal", lambda: refusal(tmp_path))
    with pytest.raises(SystemExit) as ended, recording("render.frame", *options(), folder=tmp_path / "results"):
        sys.stdout.write("figures\n")
    assert str(ended.value) == (
        f"error: {tmp_path}: results are recorded only without uncommitted changes (got mitsplat/quality.py and 1 more)"
        "; commit them, or set MITSPLAT_RECORD=0 to print figures without recording"
    )
    assert capsys.readouterr().out.endswith("figures\n") and not (tmp_path / "results").exists()


def test_the_revision_is_unknown_outside_of_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert revision(tmp_path) == "unknown" and refusal(tmp_path) is None
    monkeypatch.setenv("PATH", "")
    assert revision() == "unknown" and refusal() is None


@pytest.mark.usefixtures("clean")
def test_a_result_that_cannot_be_written_does_not_fail_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    with recording("render.frame", *options(), folder=tmp_path / "file"):
        figure(1, "s", "whole frame")
    assert "the result was not recorded" in capsys.readouterr().err


def test_commands_that_need_only_a_checkout_are_run_again() -> None:
    chosen = {name for name, result in RESULTS.items() if "command" in result and again.recordable(result)}
    assert {"render.frame", "labels.cost", "render.chart-workcell", "scale.fuzz-minutes_8-seed_1000"} <= chosen
    assert not {name for name in chosen if "cuda" in name}
    assert not chosen & {
        "assets.photos-buddha-refine",
        "labels.train",
        "render.chart-plant-size_640x480",
        "scenes.build",
        "engine.plan",
    }
    assert set(again.IDLE) <= RESULTS.keys()
    words = again.command_of({"command": "python -m benchmarks.render.chart FILE --at 0.03"})
    assert words == [sys.executable, "-m", "benchmarks.render.chart", "FILE", "--order-tolerance", "0.03"]


def test_shown_commands_have_only_options_that_exist_today() -> None:
    """Options of benchmarks are looked up in the source of their folder: ``add_argument("--size")``."""
    known = typer.main.get_command(app).commands
    for result in read_recorded().values():
        program, *words = shlex.split(figures.present_command(result))
        options = {word.partition("=")[0] for word in words if word.startswith("--")}
        if program == "mitsplat":
            found = {option for param in known[words[0]].params for option in param.opts}
        else:
            source = "".join(path.read_text() for path in Path(*words[1].split(".")[:2]).rglob("*.py"))
            found = {option for option in options if f'"{option}"' in source}
        assert options <= found, result["command"]


def test_captions_mark_dirty_and_transcribed_results() -> None:
    result = {**RESULTS["labels.cost"], "dirty": True, "note": "So."}
    assert " with changes; the run took " in caption(result) and caption(result).endswith("So.")
    assert "not recorded anew since" in caption({**result, "recorded": "transcribed"})


def test_every_benchmark_records_its_figures() -> None:
    scripts = [path for path in record.ROOT.glob("benchmarks/*/*.py") if "__main__" in path.read_text()]
    assert len(scripts) > 25
    # Scripts for detector data and weights, sample meshes, Blender, clients and gausscam, starters of others, a chart.
    others = {"arranged.py", "meshes.py", "sample_meshes.py", "blender_scene.py", "client_readers.py"}
    others |= {"__main__.py", "chart.py", "live_gausscam.py", "blender_photos.py", "mask_weights.py"}
    assert {path.name for path in scripts if "with recording(" not in path.read_text()} == others


@pytest.mark.extended
def test_every_benchmark_can_be_imported() -> None:
    """Every imported name exists in the package. The imports run in a new process, as some change the environment.

    ``blender_scene.py`` and ``blender_photos.py`` run in the environment of Blender, ``live_gausscam.py`` in that of
    gausscam.
    """
    excluded = ("__main__.py", "blender_scene.py", "blender_photos.py", "live_gausscam.py")
    modules = [path for path in record.ROOT.glob("benchmarks/*/*.py") if path.name not in excluded]
    names = sorted(".".join(path.relative_to(record.ROOT).with_suffix("").parts) for path in modules)
    script = "import importlib, sys\nfor name in sys.argv[1:]:\n    importlib.import_module(name)"
    ended = subprocess.run([sys.executable, "-c", script, *names], cwd=record.ROOT, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_the_doctor_requires_the_measured_memory_and_disk() -> None:
    memory = {name: value / 1024 for name, (value, _) in RESULTS["scale.workers-budget"]["figures"].items()}
    peak, budget = memory["default_scene.peak"], memory["default_scene.budget"]
    assert peak < budget < doctor.NEEDED_MEMORY < budget + 0.5
    first_run = RESULTS["scale.first_run"]["figures"]["second.disk"][0]
    dataset = 1000 * figures.BYTES / 2**30
    assert first_run + dataset < doctor.NEEDED_DISK < 3 * (first_run + dataset)
