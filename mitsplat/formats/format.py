"""Base types of formats, and the files of one frame while they are written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from mitsplat.errors import InputError
from mitsplat.formats import maps
from mitsplat.storage.field_types import check_label_name
from mitsplat.storage.files import SPLITS, GrowingFile, JsonObject, Record, link_file, splits_of, write_file
from mitsplat.storage.json_stream import ListsFile

if TYPE_CHECKING:
    import trimesh

    from mitsplat.frames.frame import Frame
    from mitsplat.scene.scene import Scene
    from mitsplat.scene.spec.image_spec import DepthSensor


@dataclass(frozen=True, eq=False)
class Catalogue:
    """Classes, keypoints and assets that the labels of a scene refer to.

    Attributes:
        class_names: Names of the classes, by class index.
        keypoint_names: Names of the keypoints of every class.
        assets: Names of the assets, by position among the scene's assets.
        meshes: Proxy meshes of the assets [m].
        distractors: Positions of the assets that have no labels.
        drawn_objects: Manifest entry of each asset's instances, for a scene that draws its objects; empty otherwise.
        splits: Names of the dataset's splits.
        depth_sensor: Simulated sensor of the format ``depth-sensor``.
    """

    class_names: Sequence[str]
    keypoint_names: Sequence[Sequence[str]]
    assets: Sequence[str]
    meshes: Sequence[trimesh.Trimesh]
    distractors: Sequence[int] = ()
    drawn_objects: Sequence[JsonObject] = ()
    splits: Sequence[str] = SPLITS[:2]
    depth_sensor: DepthSensor | None = None

    @classmethod
    def of(cls, scene: Scene) -> Catalogue:
        """Create the catalogue of a scene, and check it against the requested formats.

        Raises:
            InputError: If assets of one class define different keypoints, or a format cannot represent the scene.
        """
        for name in scene.class_names:
            try:
                check_label_name(name)
            except ValueError as error:
                raise InputError(f"{scene.path}: class: {error}") from error
        points: dict[str, tuple[str, tuple[str, ...]]] = {}
        for position, asset in enumerate(scene.assets):
            names = tuple(asset.keypoints)
            if scene.class_index(position) is None:
                continue
            other, other_names = points.setdefault(asset.class_name, (asset.name, names))
            if other_names != names:
                raise InputError(
                    f"{scene.path}: assets of class {asset.class_name!r} must define the same keypoints "
                    f"(got {list(other_names)} in {other} and {list(names)} in {asset.name})"
                )
        keypoint_names = tuple(points[name][1] if name in points else () for name in scene.class_names)
        formats = scene.spec.output.formats
        if "yolo-pose" in formats and not any(keypoint_names):
            raise InputError(f"{scene.path}: output.formats: yolo-pose needs an asset with keypoints (got none)")
        lens = scene.spec.camera.intrinsics
        shown = f"{'fisheye ' if lens.lens == 'fisheye' else ''}{list(lens.distortion)}"
        if not (scene.spec.output.rectify or lens.is_pinhole):
            if "bop" in formats:
                raise InputError(
                    f"{scene.path}: output.formats: bop must have a camera without lens distortion (got {shown}): set "
                    "output.rectify: true for images of the pinhole camera"
                )
            if "colmap" in formats and len(lens.distortion) > 8:
                raise InputError(
                    f"{scene.path}: output.formats: colmap must have a lens without thin-prism distortion (got "
                    f"{shown}): set output.rectify: true for images of the pinhole camera"
                )
        return cls(
            scene.class_names,
            keypoint_names,
            assets=[asset.name for asset in scene.assets],
            meshes=[asset.mesh for asset in scene.assets if asset.mesh is not None],
            distractors=[position for position in range(len(scene.assets)) if scene.class_index(position) is None],
            drawn_objects=_draw_entries(scene),
            splits=splits_of(scene.spec.output.model_dump()),
            depth_sensor=scene.spec.depth_sensor,
        )

    @property
    def num_keypoints(self) -> int:
        """Largest number of keypoints of any class."""
        return max(map(len, self.keypoint_names), default=0)


def _draw_entries(scene: Scene) -> list[JsonObject]:
    """Return the manifest entry of each asset's instances, or an empty list.

    Entries are needed only if the scene file does not determine which objects are in a layout.
    """
    spec = scene.spec
    draws_objects = any(entry.pool is not None or len(entry.scales) > 1 or not entry.label for entry in spec.objects)
    if not draws_objects and not spec.regions:
        return []
    found: list[JsonObject] = []
    for position, entry in enumerate(scene.spec.objects):
        for scale in [scale for _ in entry.names for scale in entry.scales]:
            name = scene.assets[len(found)].name
            found.append({"entry": position, "asset": len(found), "name": name, "scale": scale, "label": entry.label})
    return found


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """Files of one frame.

    Attributes:
        root: Dataset folder.
        frame: Frame to write.
        catalogue: Classes, keypoints and assets that labels refer to.
        record: Line of the frame in the manifest, which lists the files.
        image: File of the frame's picture, relative to the root; it is written before any other file.
        ids: Instance ids of the label source, shape (H, W). Instances without a label are included, distractors are
            not.
    """

    root: Path
    frame: Frame
    catalogue: Catalogue
    record: Record
    image: str
    ids: npt.NDArray[np.integer] = field(repr=False)

    @property
    def number(self) -> str:
        """File name of the frame's files, without suffix."""
        return f"{self.frame.index:06d}"

    @property
    def name(self) -> str:
        """File name of the frame's files with the folder of its split, without suffix."""
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
        """Write a file atomically and list it in the record."""
        self.record["files"][file] = write_file(self.root / file, write)

    def add_bytes(self, file: str, content: bytes) -> None:
        """Write a file with the given content."""
        self.add(file, lambda path: path.write_bytes(content))

    def add_png(self, file: str, picture: npt.NDArray[np.unsignedinteger]) -> None:
        """Write a picture (H, W) or (H, W, C) as PNG."""
        self.add_bytes(file, maps.encode_png(picture))

    def add_depth(self, file: str) -> None:
        """Write the frame's depth picture; the record states its unit as ``depth_scale`` [mm]."""
        self.record["depth_scale"] = maps.depth_scale(self.frame.depth)
        self.add_png(file, self._depth)

    def add_image(self, file: str) -> None:
        """Add the frame's picture under a second name."""
        self.add(file, lambda path: link_file(self.root / self.image, path))


class AnnotationWriter:
    """Base class of writers of the files that describe a whole dataset.

    Args:
        files: Files that grow frame by frame.
    """

    def __init__(self, files: Iterable[GrowingFile | ListsFile] = ()) -> None:
        self.files = tuple(files)

    def add(self, record: Record) -> None:
        """Add a frame; frames come by ascending index."""
        raise NotImplementedError

    def commit(self) -> None:
        """Complete the files and give them their final names."""
        for file in self.files:
            file.commit()

    def discard(self) -> None:
        """Remove the files that do not have their final name yet."""
        for file in self.files:
            file.discard()


@dataclass(frozen=True)
class Format:
    """Label format.

    Attributes:
        entries: Names of its files and folders at the top level of the dataset folder.
        write: Function that writes the files of a frame, or None.
        create_writer: Function that creates the writer of the files that describe all frames, or None.
    """

    entries: tuple[str, ...]
    write: Callable[[FrameFiles], None] | None = None
    create_writer: Callable[[Path, Catalogue], AnnotationWriter] | None = None
