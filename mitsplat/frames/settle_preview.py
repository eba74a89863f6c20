"""Inspection of settled layouts: a table of certificates, and an animation of a drop."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from PIL import Image
from rich.table import Table

from mitsplat.frames.frame import render_frame
from mitsplat.physics.settle import replay_layout
from mitsplat.scene.layout import Layout
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import storage_errors, write_file

_INTERVAL = 0.04  # between pictures of a drop [s]; GIF counts in hundredths
_PAUSE = 1500  # on the last picture [ms]


def certificate_table(layouts: Iterable[Layout]) -> Table:
    """Build a table of rest certificates with one row per layout."""
    table = Table()
    for title in ("layout", "objects", "rest [s]", "speed [mm/s]", "spin [rad/s]", "motion in 1 s [mm]"):
        table.add_column(title, justify="right")
    for title in ("in colliders [mm]", "in objects [mm]", "gap [mm]", "draws"):
        table.add_column(title, justify="right")
    table.add_column("refused")
    for layout in layouts:
        rest = layout.certificate
        lengths = rest.surface_motion, rest.collider_penetration, rest.pair_penetration, rest.support_gap
        table.add_row(
            *(str(layout.index), str(len(layout.instances)), f"{rest.time_to_rest:.2f}"),
            *(f"{rest.max_speed * 1e3:.3f}", f"{rest.max_spin:.4f}"),
            *(f"{length * 1e3:.3f}" for length in lengths),
            str(rest.attempts),
            ", ".join(f"{count} x {reason}" for reason, count in Counter(rest.refused).items()),
        )
    return table


def write_preview(scene: Scene, layout: Layout, path: Path) -> int:
    """Write the drop of a layout as an animated GIF from its first frame's camera; return the number of pictures.

    Raises:
        InputError: If the file cannot be written.
        MissingResourceError: If the disk is full.
    """
    frame = layout.index * scene.spec.output.views
    pictures = [
        Image.fromarray(render_frame(scene, frame, layout=moment, quality="fast").image)
        for moment in replay_layout(scene, layout, interval=_INTERVAL)
    ]
    step = round(_INTERVAL * 1000)
    durations = [step] * (len(pictures) - 1) + [_PAUSE]
    film: dict[str, Any] = {"save_all": True, "append_images": pictures[1:], "duration": durations, "loop": 0}
    with storage_errors(path):
        write_file(path, lambda part: pictures[0].save(part, "GIF", **film))
    return len(pictures)
