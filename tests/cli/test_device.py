"""Option ``--device`` of all commands that render."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh

from mitsplat.cli import main
from mitsplat.errors import InputError
from mitsplat.frames import frame
from mitsplat.runtime import device as devices
from tests.cli.typed import Calls, run


class TestDevice:
    """Commands with ``--device`` on a machine with or without a GPU."""

    @pytest.fixture
    def lacking(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(devices, "visible_gpus", lambda: devices.MissingPrerequisite("there is none", "buy one"))

    @pytest.mark.usefixtures("lacking")
    def test_auto_prints_the_chosen_device_and_the_reason(
        self, scene_path: Path, write_dataset: Calls, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert run("render", scene_path, "--device", "auto", "--any-device") == 0
        assert "device: cpu, because there is none\n" in capsys.readouterr().err
        assert (write_dataset.kwargs["device"].kind, write_dataset.kwargs["any_device"]) == ("cpu", True)
        assert run("render", scene_path, "--device", "auto", "--json") == 0
        assert all(json.loads(line) for line in capsys.readouterr().err.splitlines())

    @pytest.mark.usefixtures("lacking")
    @pytest.mark.parametrize("name", ["cuda", "cuda:1", "tpu"])
    def test_a_missing_device_is_refused_by_every_command_that_renders(
        self, scene_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
    ) -> None:
        """The refusal is one sentence, given before anything is written."""
        ball = tmp_path / "ball.ply"
        trimesh.creation.icosphere().export(ball)
        words = (
            "device must be cpu, cuda"
            if name == "tpu"
            else f"{name} cannot be used, because there is none: buy one, or"
        )
        commands: list[list[object]] = [
            ["render", scene_path, "-o", tmp_path / "out"],
            ["render", tmp_path / "one.xml", "-o", tmp_path / "out"],
            ["chart", scene_path, "-o", tmp_path / "out.png"],
            ["preview", scene_path, "-o", tmp_path / "out.png"],
            ["bake", ball, "-o", tmp_path / "out"],
            ["asset", tmp_path, "-o", tmp_path / "out"],
            ["mesh", tmp_path, tmp_path, "-o", tmp_path / "out"],
        ]
        for command in commands:
            assert run(*command, "--device", name) == (2 if name == "tpu" else 3), command
            assert words in capsys.readouterr().err, command
        assert not list(tmp_path.glob("out*"))

    def test_commands_select_the_device_before_they_render(
        self, scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, fit_capture: Calls
    ) -> None:
        taken: list[str] = []
        monkeypatch.setattr(devices, "choose_variant", taken.append)
        monkeypatch.setattr(devices, "visible_gpus", lambda: (devices.Gpu("One", 2**40, 0, "", ""),))
        monkeypatch.setattr(frame, "render_frame", Calls(error=InputError("rendered")))
        assert run("preview", scene_path, "-o", tmp_path / "a.png", "--device", "cuda") == 2
        assert taken == ["cuda_ad_rgb"]
        assert run("fit", "capture", "-o", tmp_path / "fit", "--device", "auto") == 0
        assert run("fit", "capture", "-o", tmp_path / "fit") == 0
        assert taken == ["cuda_ad_rgb", "cuda_ad_rgb", "llvm_ad_rgb"]

    def test_another_gpu_is_selected_by_restarting_the_process(
        self, scene_path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """Only the command line restarts the process. A caller in Python gets a sentence with the variable to set."""
        gpus = tuple(devices.Gpu("One", 2**40, number, str(number), f"GPU-{number}") for number in range(2))
        monkeypatch.setattr(devices, "visible_gpus", lambda: gpus)
        monkeypatch.delenv(devices.GPU_NUMBER, raising=False)
        command = ["preview", str(scene_path), "-o", str(tmp_path / "a.png"), "--device", "cuda:1"]
        assert run(*command) == 2
        assert "set CUDA_VISIBLE_DEVICES=GPU-1 before" in capsys.readouterr().err
        begun = Calls(error=SystemExit(0))
        monkeypatch.setenv("PYTHONSAFEPATH", "1")  # set by main
        monkeypatch.setattr("mitsplat.cli.os.execve", begun)
        monkeypatch.setattr("sys.argv", ["mitsplat", *command])
        monkeypatch.setattr("sys.orig_argv", ["python", "/bin/mitsplat", *command])
        with pytest.raises(SystemExit):
            main()
        assert begun.args[1][1:] == ["-P", "/bin/mitsplat", *command]
        assert {"CUDA_VISIBLE_DEVICES": "GPU-1", "MITSPLAT_GPU": "1"}.items() <= begun.args[2].items()
