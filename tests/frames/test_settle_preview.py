"""Animation of a drop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from mitsplat.frames import settle_preview
from mitsplat.physics.settle import ReplayMoment, settle_layout
from mitsplat.scene.loading.scene_loading import load_scene


def test_an_object_that_is_dropped_again_is_marked_for_half_a_second(
    scene_data, write_scene, tmp_path: Path, monkeypatch
) -> None:
    """All moments have the same poses, so that only the mark differs. The layout at rest has none."""
    scene = load_scene(write_scene(scene_data), overrides={"output.width": 160, "output.height": 90})
    layout = settle_layout(scene, 0)
    number = layout.instances[0].id
    times = {0.0: (), 0.3: (number,), 0.7: (), 0.9: (), 1.0: (number,)}
    moments = [ReplayMoment(replace(layout), time, again) for time, again in times.items()]
    moments.append(ReplayMoment(layout, 1.1))  # at rest
    monkeypatch.setattr(settle_preview, "replay_layout", lambda *args, **options: iter(moments))
    name = f"{scene.assets[layout.instances[0].asset].name} (object {number})"
    path = tmp_path / "drop.gif"
    pictures, again = settle_preview.write_preview(scene, layout, path)
    assert (pictures, again) == (6, [f"{name} after 0.3 s", f"{name} after 1.0 s"])
    with Image.open(path) as film:
        shown = [np.array(frame.convert("RGB"), float) for frame in ImageSequence.Iterator(film)]
    # The file joins equal pictures: those of 0.3 and 0.7 s.
    assert [np.abs(picture - shown[0]).mean() > 2 for picture in shown] == [False, True, False, True, False]
