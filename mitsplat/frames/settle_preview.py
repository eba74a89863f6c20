"""Inspection of settled layouts: a table of certificates, and an animation of a drop."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from PIL import Image, ImageDraw
from rich.table import Table
from rich.text import Text

from mitsplat.frames.frame import Frame, render_frame
from mitsplat.labels.overlay import draw_labels
from mitsplat.physics.settle import replay_layout
from mitsplat.scene.layout import Layout
from mitsplat.scene.scene import Scene
from mitsplat.storage.files import storage_errors, write_file

_INTERVAL = 0.04  # between pictures of a drop [s]; GIF counts in hundredths
_PAUSE = 1500  # on the last picture [ms]
_MARK_TIME = 0.5  # for which an object that was dropped again is marked [s]


def certificate_table(layouts: Iterable[Layout]) -> Table:
    """Build a table of rest certificates with one row per layout."""
    table = Table()
    motion = "layout", "objects", "rest [s]", "speed [mm/s]", "spin [rad/s]", "motion in 1 s [mm]"
    for title in (*motion, "in colliders [mm]", "in objects [mm]", "gap [mm]", "draws"):
        table.add_column(Text(title), justify="right")  # plain text, where markup would remove [mm]
    table.add_column("refused")
    for layout in layouts:
        rest = layout.certificate
        lengths = rest.surface_motion, rest.collider_penetration, rest.pair_penetration, rest.support_gap
        table.add_row(
            *(str(layout.index), str(len(layout.instances)), f"{rest.time_to_rest:.2f}"),
            *(f"{rest.max_speed * 1e3:.3f}", f"{rest.max_spin:.4f}"),
            *(f"{length * 1e3:.3f}" for length in lengths),
            str(rest.attempts),
            Text(", ".join(f"{count} x {reason}" for reason, count in Counter(rest.refused).items())),
        )
    return table


def write_preview(scene: Scene, layout: Layout, path: Path) -> tuple[int, list[str]]:
    """Write the drop of a layout as an animated GIF from its first frame's camera.

    Objects that are dropped again jump to new start poses. For half a second from then on, they are coloured and named.

    Returns:
        The number of pictures, and a description of each object that is dropped again.

    Raises:
        InputError: If the file cannot be written.
        MissingResourceError: If the disk is full.
    """
    frame = layout.index * scene.spec.output.views
    names = {one.id: scene.assets[one.asset].name for one in layout.instances}
    marked: dict[int, float] = {}  # time until which an object is marked, by id
    pictures, again = [], []
    for moment in replay_layout(scene, layout, interval=_INTERVAL):
        for number in moment.dropped_again:
            marked[number] = moment.time + _MARK_TIME
            again.append(f"{names[number]} (object {number}) after {moment.time:.1f} s")
        ends = {} if moment.layout is layout else marked  # nothing is marked at rest
        shown = {number: names[number] for number, end in ends.items() if moment.time < end}
        picture = render_frame(scene, frame, layout=moment.layout, quality="fast")
        pictures.append(_mark(picture, shown))
    step = round(_INTERVAL * 1000)
    durations = [step] * (len(pictures) - 1) + [_PAUSE]

    def write(part: Path) -> None:
        pictures[0].save(part, "GIF", save_all=True, append_images=pictures[1:], duration=durations, loop=0)

    with storage_errors(path):
        write_file(path, write)
    return len(pictures), again


def _mark(frame: Frame, names: Mapping[int, str]) -> Image.Image:
    """Return the picture of a frame, in which objects of these ids are coloured and named as dropped again."""
    if not names:
        return Image.fromarray(frame.image)
    labels = replace(frame.labels, instances=tuple(one for one in frame.labels.instances if one.id in names))
    picture = Image.fromarray(draw_labels(frame.image, labels))
    text, size = f"dropped again: {', '.join(names.values())}", max(10, round(frame.image.shape[1] / 36))
    ImageDraw.Draw(picture).text(
        (size / 2, size / 2), text, "white", font_size=size, stroke_width=2, stroke_fill="black"
    )
    return picture
