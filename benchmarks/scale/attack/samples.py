"""Folder of an attack, and valid files as the basis of attacks."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.scale.fuzz import make_samples

ROOT = Path(__file__).resolve().parents[3]

SCENE = """name: nuts
objects:
  - {asset: nut, count: 1}
region: {min: [-0.05, -0.05, 0.02], max: [0.05, 0.05, 0.1]}
shapes:
  - {name: table, box: {size: [1, 1, 0.1], position: [0, 0, -0.05]}, visible: true}
camera: {kind: orbit, target: [0, 0, 0], radius: 0.2, height: 0.2}
lights:
  - {kind: area, position: [0.5, 0, 1]}
output: {width: 64, height: 48, layouts: 1, views: 2, formats: [yolo, coco]}
seed: 7
"""
"""A small scene, rendered in seconds."""


class Samples:
    """Valid files of every kind below a folder; the dataset is rendered on demand.

    Args:
        folder: Their folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        make_samples(folder)
        (folder / "scene.yaml").write_text(SCENE)

    @property
    def finished(self) -> Path:
        """Return the folder of the valid scene and its dataset of two frames."""
        return self.folder / "finished"

    def render_dataset(self) -> None:
        """Render the valid scene."""
        home = self.finished
        home.mkdir()
        shutil.copytree(self.folder / "nut", home / "nut")
        (home / "scene.yaml").write_text(SCENE)
        program = str(Path(sys.executable).with_name("mitsplat"))
        command = [program, "render", "scene.yaml", "-o", "dataset", "--workers", "1"]
        done = subprocess.run(command, cwd=home, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"the valid dataset could not be rendered: {done.stderr}")


@dataclass(frozen=True)
class Place:
    """Folders of one attack.

    Attributes:
        root: Parent of the others.
        inside: Current folder of the commands, with their input.
        outside: Files that no command may read, change or add to.
        valid: Folder of valid files.
    """

    root: Path
    inside: Path
    outside: Path
    valid: Samples

    @classmethod
    def make(cls, root: Path, valid: Samples, colour: tuple[int, int, int], word: str) -> Place:
        """Create the folders, with an image of one colour and texts with a word outside."""
        place = cls(root, root / "inside", root / "outside", valid)
        for folder in (place.inside, place.outside, place.outside / "folder"):
            folder.mkdir(parents=True)
        pixels = np.full((48, 64, 3), colour, np.uint8)
        Image.fromarray(pixels).save(place.outside / "secret.png")
        Image.fromarray(pixels).save(place.outside / "secret.jpg")
        for name in ("secret.txt", "secret.yaml", "folder/keep.txt"):
            (place.outside / name).write_text(f"secret: {word}\n")
        return place

    @property
    def samples(self) -> Path:
        """Return the folder of the valid files."""
        return self.valid.folder

    def take(self, *names: str, into: str = "") -> Path:
        """Copy valid files or folders here; return the last of them."""
        target = self.inside / into
        target.mkdir(parents=True, exist_ok=True)
        for name in names:
            source = self.samples / name
            if source.is_dir():
                shutil.copytree(source, target / source.name)
            else:
                shutil.copy(source, target)
        return target / Path(names[-1]).name

    def take_dataset(self) -> Path:
        """Copy the finished dataset and its scene; return the dataset's folder."""
        shutil.copytree(self.valid.finished, self.inside, dirs_exist_ok=True)
        return self.inside / "dataset"

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a new file below ``inside``."""
        path = self.inside / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    def scene(self, **changes: str) -> Path:
        """Write the valid scene and its asset, with lines of given keys replaced or added."""
        if not (self.inside / "nut").exists():
            self.take("nut")
        lines = SCENE.splitlines()
        for key, value in changes.items():
            start = next((i for i, line in enumerate(lines) if line.startswith(f"{key}:")), len(lines))
            stop = next((i for i in range(start + 1, len(lines)) if not lines[i].startswith(" ")), len(lines))
            lines[start:stop] = [f"{key}: {value}"]
        return self.write("scene.yaml", "\n".join(lines) + "\n")


Build = Callable[[Place], str]
"""Function that makes an input in a place and returns its name."""


def file_of(name: str, make: Callable[[], str | bytes]) -> Build:
    """Return a function that writes a file of the content that ``make`` returns."""

    def build(place: Place) -> str:
        place.write(name, make())
        return name

    return build
