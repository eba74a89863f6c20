"""What a format is, and the files of one frame while they are written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from mitsplat.errors import InputError
from mitsplat.formats import maps
from mitsplat.storage.field_types import plain
from mitsplat.storage.files import SPLITS, Record, link_file, splits_of, write_file

if TYPE_CHECKING:
    import trimesh

    from mitsplat.frames.frame import Frame
    from mitsplat.scene.scene import Scene
    from mitsplat.scene.spec.image_spec import DepthSensor


_ONE_POSE = frozenset(("bop", "colmap", "flow"))
"""Formats that say by one pose of the camera where all that an image shows is."""


@dataclass(frozen=True, eq=False)
class Catalogue:
    """What the labels of a scene refer to.

    Attributes:
        class_names: By class index.
        keypoint_names: Keypoints of every class.
        assets: Names, by position among the scene's assets.
        meshes: Their proxy meshes [m].
        distractors: Positions of the assets that are in no label.
        drawn: Of a scene that draws its objects, what the manifest states of an instance of each asset; else empty.
        splits: Names of the dataset's splits.
        depth_sensor: What measures the depth of the format ``depth-sensor``.
    """

    class_names: Sequence[str]
    keypoint_names: Sequence[Sequence[str]]
    assets: Sequence[str]
    meshes: Sequence[trimesh.Trimesh]
    distractors: Sequence[int] = ()
    drawn: Sequence[Mapping[str, Any]] = ()
    splits: Sequence[str] = SPLITS[:2]
    depth_sensor: DepthSensor | None = None

    @classmethod
    def of(cls, scene: Scene) -> Catalogue:
        """The catalogue of a scene, checked against the formats that it asks for.

        Raises:
            InputError: If assets of one class name different keypoints, or a format cannot show what the scene has.
        """
        for name in scene.class_names:
            try:
                plain(name)
            except ValueError as error:
                raise InputError(f"{scene.path}: class: {error}") from error
        points: dict[str, tuple[str, tuple[str, ...]]] = {}
        kinds = [scene.class_index(position) for position in range(len(scene.assets))]
        for asset, kind in zip(scene.assets, kinds, strict=True):
            if kind is None:
                continue
            names = tuple(asset.keypoints)
            other, known = points.setdefault(asset.class_name, (asset.name, names))
            if known != names:
                raise InputError(
                    f"{scene.path}: assets of class {asset.class_name!r} must name the same keypoints "
                    f"(got {list(known)} in {other} and {list(names)} in {asset.name})"
                )
        keypoint_names = tuple(points[name][1] if name in points else () for name in scene.class_names)
        formats = scene.spec.output.formats
        if "yolo-pose" in formats and not any(keypoint_names):
            raise InputError(f"{scene.path}: output.formats: yolo-pose needs an asset with keypoints (got none)")
        for camera in (scene.spec.camera, *scene.spec.cameras):
            if "bop" in formats and any(camera.intrinsics.distortion):
                raise InputError(
                    f"{scene.path}: output.formats: bop must have a camera without lens distortion "
                    f"(got {list(camera.intrinsics.distortion)})"
                )
            if camera.motion is not None and camera.motion.readout[1] and (one := _ONE_POSE.intersection(formats)):
                raise InputError(
                    f"{scene.path}: output.formats: {min(one)} must have a camera whose rows are exposed at once, with "
                    f"one pose (got camera.motion.readout {list(camera.motion.readout)})"
                )
        meshes = [asset.mesh for asset in scene.assets if asset.mesh is not None]
        distractors = [position for position, kind in enumerate(kinds) if kind is None]
        assets = [asset.name for asset in scene.assets]
        splits = splits_of(scene.spec.output.model_dump())
        return cls(
            scene.class_names,
            keypoint_names,
            assets,
            meshes,
            distractors,
            _drawn(scene),
            splits,
            scene.spec.depth_sensor,
        )

    @property
    def num_keypoints(self) -> int:
        """Keypoints of the class that has most."""
        return max(map(len, self.keypoint_names), default=0)


def _drawn(scene: Scene) -> list[dict[str, Any]]:
    """What the manifest states of each asset's instances, if the scene file leaves open which ones lie in a layout."""
    spec = scene.spec
    told = any(entry.pool is not None or len(entry.scales) > 1 or not entry.label for entry in spec.objects)
    if not told and not spec.regions:
        return []
    found: list[dict[str, Any]] = []
    for position, entry in enumerate(scene.spec.objects):
        for scale in [scale for _ in entry.names for scale in entry.scales]:
            name = scene.assets[len(found)].name
            found.append({"entry": position, "asset": len(found), "name": name, "scale": scale, "label": entry.label})
    return found


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """The files of one frame below ``root``; ``record`` is its line of the manifest, which lists them.

    Attributes:
        frame: What is written.
        image: The frame's picture, relative to the root, which is there before any other file.
        ids: Ids of the instances that labels are of, shape (H, W), those without a label included, but no distractors.
    """

    root: Path
    frame: Frame
    catalogue: Catalogue
    record: Record
    image: str
    ids: npt.NDArray[np.integer[Any]] = field(repr=False)

    @property
    def number(self) -> str:
        """How the frame's files are called."""
        return f"{self.frame.index:06d}"

    @property
    def name(self) -> str:
        """The same in the folder of its split."""
        return f"{self.frame.plan.split}/{self.number}"

    @property
    def image_name(self) -> str:
        """File name of the picture."""
        return Path(self.image).name

    @cached_property
    def labelled(self) -> npt.NDArray[np.uint16]:
        """Ids of the labelled instances, shape (H, W)."""
        return maps.instance_picture(self.frame.labels)

    @cached_property
    def _depth(self) -> npt.NDArray[np.uint16]:
        return maps.depth_picture(self.frame.depth)

    def add(self, file: str, write: Callable[[Path], object]) -> None:
        """Write a file whole or not at all, and list it."""
        self.record["files"][file] = write_file(self.root / file, write)

    def add_bytes(self, file: str, content: bytes) -> None:
        """Write a file of this content."""
        self.add(file, lambda path: path.write_bytes(content))

    def add_png(self, file: str, picture: npt.NDArray[Any]) -> None:
        """Write a picture without loss."""
        self.add_bytes(file, maps.encode_png(picture))

    def add_depth(self, file: str) -> None:
        """Write the frame's depth as a picture, in units that the record states as ``depth_scale`` [mm]."""
        self.record["depth_scale"] = maps.depth_scale(self.frame.depth)
        self.add_png(file, self._depth)

    def add_image(self, file: str) -> None:
        """Give the frame's picture a second name."""
        self.add(file, lambda path: link_file(self.root / self.image, path))


class Describer(Protocol):
    """Writes files that describe a whole dataset, frame by frame; they get their names when they are kept."""

    def add(self, record: Record) -> None:
        """Describe a frame; frames come by ascending index."""

    def keep(self) -> None:
        """End the files, and give them their names."""

    def discard(self) -> None:
        """Remove what was not kept."""


@dataclass(frozen=True)
class Format:
    """A label format.

    Attributes:
        entries: Names of its files and folders in the dataset's own folder.
        write: Writes the files of a frame.
        describe: Makes what writes the files that describe all frames.
    """

    entries: tuple[str, ...]
    write: Callable[[FrameFiles], None] | None = None
    describe: Callable[[Path, Catalogue], Describer] | None = None
