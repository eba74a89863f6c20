"""Endless frames for PyTorch: frames per worker, reproducibility, and targets equal to the labels."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from mitsplat.errors import InputError
from mitsplat.frames.frame import render_frame
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.scene import Scene
from mitsplat.scene.splits import split_of
from tests.conftest import WriteScene

torch = pytest.importorskip("torch", reason="the extra torch is not installed")
from mitsplat.frames.torch_dataset import FrameStream, sample_of  # noqa: E402 - needs torch


@pytest.fixture
def scene(scene_data: dict[str, Any], write_scene: WriteScene) -> Scene:
    scene_data["output"] = {"width": 64, "height": 48, "layouts": 1, "views": 2, "validation": 0}
    scene_data["objects"] = [{"asset": "assets/nut", "scale": 6.0}]
    return load_scene(write_scene(scene_data))


def test_a_target_equals_the_labels(scene: Scene) -> None:
    frame = render_frame(scene, 0, quality="fast")
    image, target = sample_of(frame)
    assert image.shape == (3, 48, 64)
    assert np.array_equal((255 * image).round().byte().permute(1, 2, 0).numpy(), frame.image)
    for number, label in enumerate(frame.labels.instances):
        y, x = np.nonzero(target["masks"][number].numpy())
        assert target["boxes"][number].tolist() == [x.min(), y.min(), x.max() + 1, y.max() + 1]
        assert target["labels"][number] == label.class_index + 1
        assert target["area"][number] == len(x)
    assert len(frame.labels.instances)


def test_workers_share_the_layouts_of_an_endless_scene(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sets the worker information of a DataLoader in this process.

    Two worker processes would only compile kernels again.
    """
    from torch.utils.data._utils.worker import WorkerInfo

    found = {}
    for number in (0, 1):
        info = WorkerInfo(id=number, num_workers=2, seed=0, dataset=None)
        monkeypatch.setattr("mitsplat.frames.torch_dataset.get_worker_info", lambda info=info: info)
        taken = list(itertools.islice(FrameStream(scene, quality="fast"), 3))
        found[number] = [int(target["image_id"]) for _, target in taken]
    assert found == {0: [0, 1, 4], 1: [2, 3, 6]}


def test_layouts_of_other_splits_are_left_out(scene_data: dict[str, Any], write_scene: WriteScene) -> None:
    """Objects that are held out, and images for evaluation, must not be learnt."""
    scene_data["output"] = {"width": 16, "height": 12, "validation": 0.25, "test": 0.25}
    scene = load_scene(write_scene(scene_data))
    views = scene.spec.output.views
    frames = itertools.islice(FrameStream(scene, quality="fast"), 0, 6 * views, views)
    layouts = [int(target["image_id"]) // views for _, target in frames]
    assert layouts == [k for k in range(layouts[-1] + 1) if split_of(k, scene.spec.output) == "train"]
    assert layouts[-1] > 5
    scene_data["output"]["validation"] = 0.75
    with pytest.raises(InputError, match=r"must leave layouts for training \(got 0\.75 and 0\.25\)"):
        FrameStream(load_scene(write_scene(scene_data)))


def test_batches_are_lists(scene: Scene) -> None:
    loader = torch.utils.data.DataLoader(FrameStream(scene, quality="fast"), 2, collate_fn=FrameStream.collate)
    images, targets = next(iter(loader))
    assert [image.shape for image in images] == [(3, 48, 64)] * 2
    assert [int(target["image_id"]) for target in targets] == [0, 1]
