"""Makes the pictures of the scene reference and of the gallery.

Run as ``python docs/pictures.py [--missing] [KEY or SCENE ...]``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

DOCS = Path(__file__).parent
SCENES = DOCS.parent / "scenes"
FOLDER = DOCS / "pictures" / "scene"
SIZE = (320, 200)
"""Of the reference's pictures [px]; those of the gallery are twice as large."""

GALLERY = (
    *("workcell.yaml", "bin_picking.yaml", "shelf.yaml", "conveyor.yaml", "stacks.yaml", "fisheye.yaml"),
    *("close_up.yaml", "moving_light.yaml", "benches.yaml"),
)
"""Scenes of the gallery, in its order; ``real.yaml``, whose assets are made first, and ``mirror_ball.xml`` follow."""

SHEETS = ("workcell.yaml", "benches.yaml", "bin_picking.yaml", "conveyor.yaml", "real.yaml")
"""Scenes of which the gallery also shows up to twelve frames, or a sequence of them."""


@dataclass(frozen=True)
class Picture:
    """One picture of a key of the scene file.

    Attributes:
        key: The key, such as ``settle.arrangement``.
        fragment: YAML that is put over the base scene.
        scene: What comes of that.
        file: Where the picture lies.
        frames: Frames shown, one or four.
        zoom: How many times larger its pixels are shown.
        labels: Whether labels are drawn.
    """

    key: str
    fragment: str
    scene: dict[str, Any]
    file: Path
    frames: tuple[int, ...]
    zoom: float
    labels: bool


def read_pictures() -> list[Picture]:
    """All pictures that ``pictures.yaml`` asks for, those of a key one after the other."""
    yaml = YAML(typ="safe")
    told = yaml.load((DOCS / "pictures.yaml").read_text())
    return [
        Picture(
            key=key,
            fragment=fragment,
            scene=_merged(told["bases"][entry["base"]], yaml.load(fragment)),
            file=FOLDER / f"{key.replace('[]', '').replace('.', '-')}-{number}.jpg",
            frames=tuple(entry.get("frames", (0,))),
            zoom=entry.get("zoom", 1),
            labels=entry.get("labels", False),
        )
        for key, entry in told["pictures"].items()
        for number, fragment in enumerate(entry["each"])
    ]


def _merged(base: Any, over: Any) -> Any:
    """``over`` put over ``base``; lists, and mappings of another ``kind``, are replaced."""
    if not isinstance(base, dict) or not isinstance(over, dict) or over.get("kind") not in (None, base.get("kind")):
        return over
    return base | {name: _merged(base.get(name), value) for name, value in over.items()}


def _render_key(picture: Picture, folder: Path) -> Any:
    import cv2
    import numpy as np

    import mitsplat as ms
    from mitsplat.labels import draw_labels

    yaml = YAML(typ="safe")
    width, height = (round(edge / picture.zoom) for edge in SIZE)
    several = len(picture.frames) > 1
    size = {"width": width // 2, "height": height // 2} if several else {"width": width, "height": height}
    yaml.dump(picture.scene | {"output": picture.scene["output"] | size}, folder / "scene.yaml")
    with ms.Renderer(ms.load_scene(folder / "scene.yaml", allow_outside=True)) as renderer:
        frames = [renderer.render(index) for index in picture.frames]
    images = [draw_labels(frame.image, frame.labels) if picture.labels else frame.image for frame in frames]
    image = np.vstack([np.hstack(images[:2]), np.hstack(images[2:])]) if several else images[0]
    return cv2.resize(image, SIZE, interpolation=cv2.INTER_NEAREST if picture.zoom > 1 else cv2.INTER_AREA)


def _make_places(folder: Path) -> None:
    """Images behind and on things, and a second cell: the workcell with red and blue exchanged."""
    import cv2
    import numpy as np

    from mitsplat.asset import Asset

    (folder / "photos").mkdir()
    for name in ("workcell", "bin_picking", "fisheye", "moving_light"):
        (folder / f"photos/{name}.jpg").symlink_to(FOLDER / f"gallery-{name}.jpg")
    bricks = np.full((256, 256, 3), (190, 190, 185), dtype=np.uint8)
    for row in range(4):
        for left in range(-64 * (row % 2), 256, 128):
            colour = tuple(map(int, np.array([60, 75, 150]) + 8 * ((left // 64 + row) % 3)))
            cv2.rectangle(bricks, (left + 3, 64 * row + 3), (left + 124, 64 * row + 60), colour, -1)
    cv2.imwrite(str(folder / "bricks.png"), bricks)
    cell = Asset.load(SCENES / "assets/workcell")
    splats = replace(cell.splats, sh=np.ascontiguousarray(cell.splats.sh[..., ::-1]))
    replace(cell, splats=splats).save(folder / "red_cell")


def _render_scene(name: str) -> Any:
    import mitsplat as ms

    overrides = {"output.width": 2 * SIZE[0], "output.height": 2 * SIZE[1]}
    return ms.render_frame(ms.load_scene(SCENES / name, overrides=overrides), 0).image


def _render_sheet(name: str) -> Any:
    """Up to twelve frames, four in a row: evenly spread, or the first ones of a video."""
    import numpy as np

    import mitsplat as ms

    scene = ms.load_scene(SCENES / name, overrides={"output.width": SIZE[0], "output.height": 180})
    last = 11 if scene.spec.conveyor else scene.num_frames - 1
    with ms.Renderer(scene) as renderer:
        images = [renderer.render(int(index)).image for index in np.unique(np.linspace(0, last, 12).astype(int))]
    return np.vstack([np.hstack(images[row : row + 4]) for row in range(0, len(images) - 3, 4)])


def _render_xml(name: str, folder: Path) -> Any:
    import cv2

    from mitsplat.frames.mitsuba_xml import render_xml

    return cv2.imread(str(render_xml(SCENES / name, folder / "picture.png")))[..., ::-1]


def _write_skies(folder: Path) -> None:
    """Two panoramas with a sun each, z up in the middle of the upper edge: at noon, and before the evening."""
    import mitsuba as mi
    import numpy as np

    folder.mkdir()
    for name, height, sun, zenith, horizon in (
        ("day", 55, (900, 850, 780), (0.25, 0.4, 0.8), (0.7, 0.75, 0.8)),
        ("evening", 15, (900, 420, 130), (0.15, 0.2, 0.4), (0.9, 0.5, 0.25)),
    ):
        up, around = np.meshgrid(np.linspace(90, -90, 128), np.linspace(-180, 180, 256), indexing="ij")
        share = np.clip(up / 90, 0, 1)[..., None] ** 0.5
        sky = share * zenith + (1 - share) * np.array(horizon)
        sky[up < 0] = 0.15
        beside = around * np.cos(np.radians(height))
        sky += np.exp(-0.5 * (np.hypot(up - height, beside) / 3) ** 2)[..., None] * 0.5 * np.array(sun)
        mi.Bitmap(sky.astype(np.float32)).write(str(folder / f"{name}.exr"))


def main() -> None:
    """Make the pictures that are asked for, or all."""
    import cv2
    import trimesh

    from mitsplat.errors import InputError

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="keys of the scene file, and files of the gallery; all if absent")
    parser.add_argument("--missing", action="store_true", help="keep what is there")
    options = parser.parse_args()
    wanted = set(options.names)
    FOLDER.mkdir(parents=True, exist_ok=True)
    work = {
        picture.file: (picture.key, lambda folder, it=picture: _render_key(it, folder)) for picture in read_pictures()
    }
    for name in GALLERY:
        work[FOLDER / f"gallery-{Path(name).stem}.jpg"] = (name, lambda _, it=name: _render_scene(it))
    for name in SHEETS:
        work[FOLDER / f"sheet-{Path(name).stem}.jpg"] = (f"sheet of {name}", lambda _, it=name: _render_sheet(it))
    work[FOLDER / "gallery-mirror_ball.jpg"] = (
        "mirror_ball.xml",
        lambda folder: _render_xml("mirror_ball.xml", folder),
    )
    if unknown := wanted - {name for name, _ in work.values()}:
        sys.exit(f"no such picture: {', '.join(sorted(unknown))}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "assets").symlink_to(SCENES / "assets")
        trimesh.creation.torus(0.05, 0.015).apply_translation((0, 0, 0.015)).export(folder / "ring.ply")
        _write_skies(folder / "skies")
        _make_places(folder)
        failed = []
        for file, (key, make) in work.items():
            if (wanted and key not in wanted) or (options.missing and file.exists()):
                continue
            start = time.perf_counter()
            try:
                image = make(folder)
            except InputError as error:
                failed.append(f"{file.name}: {error}")
                continue
            cv2.imwrite(str(file), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85, cv2.IMWRITE_JPEG_OPTIMIZE, 1])
            size, seconds = file.stat().st_size / 1000, time.perf_counter() - start
            print(f"{key}: {file.name}, {size:.0f} kB, {seconds:.0f} s", flush=True)
    extra = [f"{file.name} is no longer asked for" for file in sorted(set(FOLDER.glob("*.jpg")) - set(work))]
    sys.exit("\n".join(failed + extra) or None)


if __name__ == "__main__":
    main()
