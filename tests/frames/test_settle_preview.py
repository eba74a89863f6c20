"""Animation of a drop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from mitsplat.frames import settle_preview
from mitsplat.physics.settle import ReplayMoment, settle_layout
from mitsplat.scene.loading.scene_loading import load_scene


def test_an_object_that_is_dropped_again_is_marked_for_half_a_second(
    scene_data, write_scene, tmp_path: Path, monkeypatch
) -> None:
    """All moments have the same poses, so that only the mark differs."""
    scene = load_scene(write_scene(scene_data), overrides={"output.width": 160, "output.height": 90})
    layout = settle_layout(scene, 0)
    number = layout.instances[0].id
    moments = [ReplayMoment(layout, 0.0), ReplayMoment(layout, 0.3, (number,)), ReplayMoment(layout, 0.7)]
    moments += [ReplayMoment(layout, 0.9)]
    monkeypatch.setattr(settle_preview, "replay_layout", lambda *args, **options: iter(moments))
    name = scene.assets[layout.instances[0].asset].name
    path = tmp_path / "drop.gif"
    assert settle_preview.write_preview(scene, layout, path) == (4, [f"{name} (object {number}) after 0.3 s"])
    with Image.open(path) as film:
        plain, *marked, last = [np.array(frame.convert("RGB"), float) for frame in ImageSequence.Iterator(film)]
    assert np.abs(plain - last).mean() < 1
    for picture in marked:
        assert np.abs(picture - plain).mean() > 2
