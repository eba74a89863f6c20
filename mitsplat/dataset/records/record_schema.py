"""Validation of ``dataset.json`` and of the lines of ``manifest.jsonl``.

All content is checked when it is read, so that other code can rely on types, sizes and masks.
"""

from __future__ import annotations

import json
import re
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pycocotools import mask as coco_mask
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from mitsplat.arrays import evenly_spaced
from mitsplat.dataset.records.manifest import LONGEST_LINE, parse_line, read_lines
from mitsplat.errors import InputError
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.lens import Lens
from mitsplat.images.masks import decode_rle
from mitsplat.scene.spec.camera_spec import CameraSpec
from mitsplat.scene.spec.scene_spec import LabelRules, Output
from mitsplat.storage.field_types import Name, Positive, Unit
from mitsplat.storage.file_kinds import no_folder_with
from mitsplat.storage.files import JsonObject, Record, open_regular, read_json, splits_of
from mitsplat.storage.format_version import FORMAT_VERSIONS, check_format_version

Count = Annotated[int, Field(ge=0, lt=2**31)]
Pixels = Annotated[int, Field(ge=1, lt=2**31)]
InstanceId = Annotated[int, Field(ge=1, le=65535)]
Bounds = tuple[int, int, int, int]
Point = tuple[float, float, float]
Row = tuple[float, float, float, float]
Pose = tuple[Row, Row, Row, Row]

_INDEX = re.compile(rb'\{"index":([0-9]{1,10}),')


class _Stored(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class _Box(_Stored):
    size: Point
    position: Point
    rotate: Point


class _Shape(_Stored):
    name: str
    box: _Box | None = None


class _Entry(_Stored):
    asset: str | None = None
    pool: list[str] | str | None = None
    scale: float | tuple[float, float]


class _HoldOut(_Stored):
    assets: list[str] = []


class _Belt(_Stored):
    belt: str
    speed: float
    interval: float


class _Scene(_Stored):
    name: str
    seed: Annotated[int, Field(ge=0)]
    camera: CameraSpec
    labels: LabelRules
    output: Output
    objects: list[_Entry] = []
    hold_out: _HoldOut = _HoldOut()
    shapes: list[_Shape] = []
    conveyor: _Belt | None = None

    @field_validator("conveyor")
    @classmethod
    def _check_belt(cls, conveyor: _Belt | None, checked: ValidationInfo) -> _Belt | None:
        if conveyor is not None and not any(
            shape.name == conveyor.belt and shape.box is not None for shape in checked.data.get("shapes", ())
        ):
            raise ValueError(f"belt must be a box among the shapes (got {conveyor.belt})")
        return conveyor


class _Content(_Stored):
    mitsplat: str
    scene: _Scene
    classes: list[Name]
    keypoints: list[list[Name]]
    assets: list[Name]
    distractors: list[Count] = []
    centroids: list[Point] = []
    libraries: dict[str, str]
    device: Literal["cpu", "cuda"] = "cpu"
    given: bool = False


class _Camera(_Stored):
    width: Pixels
    height: Pixels
    intrinsics: tuple[Point, Point, Point]
    distortion: list[float]
    lens: Lens
    aperture_radius: Annotated[float, Field(ge=0)]
    focus_distance: Positive
    near: Positive
    world_from_camera: Pose


class _Instance(_Stored):
    id: InstanceId
    asset: Count
    class_index: Count
    class_name: Annotated[str, Field(alias="class")]
    box: Bounds
    area: Pixels
    amodal_box: Bounds
    amodal_area: Pixels
    silhouette_box: Bounds
    silhouette_area: Pixels
    depth_area: Count
    visible_fraction: Unit
    truncation: Unit
    polygon_iou: Unit
    agreement: Unit
    boundary_f1: Unit
    marks: list[str]
    keypoints: list[Point]
    world_from_object: Pose
    rle: str
    amodal_rle: str


class _Labels(_Stored):
    size: tuple[Pixels, Pixels]
    instances: list[_Instance]
    dropped: dict[str, Count]


class _Environment(_Stored):
    id: Annotated[int, Field(ge=1, le=65536)]
    area: Pixels
    box: Bounds


class _Drawn(_Stored):
    id: InstanceId
    entry: Count
    asset: Count
    name: str
    scale: Positive
    label: bool
    region: str | None = None


class _Appearance(_Stored):
    id: InstanceId
    entry: Count
    hue: float
    saturation: float
    value: float
    gain: Point
    roughness: Annotated[float, Field(gt=0, le=1)]
    specular: Unit
    wear: Unit
    wear_seed: Count


class _Light(_Stored):
    position: Point | None = None
    size: tuple[float, float] | None = None
    intensity: float | None = None
    radiance: float | None = None


class _Predicted(_Stored):
    """Predicted numbers of labelled objects in view, partly hidden, and cut by the border, used for view selection."""

    in_view: Count
    hidden: Count
    cut: Count


class _Motion(_Stored):
    exposure: Positive


class _Viewpoint(_Stored):
    """Drawn values of a camera, in the units of :class:`mitsplat.scene.planning.viewpoints.Viewpoint`."""

    motion: _Motion | None = None
    target: Point | None = None
    object: InstanceId | None = None
    attempt: Count = 0
    predicted: _Predicted | None = None


class _OrderError(_Stored):
    largest: Unit
    mean: Unit


class _DrawnEnvironment(_Stored):
    number: Count
    name: str


class _Finish(_Stored):
    kind: str
    colours: list[Point] = []
    scale: Positive
    rotate: float
    offset: tuple[float, float]
    image: str | None = None
    seed: Count


class _Backing(_Stored):
    image: str
    crop: Annotated[float, Field(gt=0, le=1)]
    place: tuple[Unit, Unit]
    rotate: float
    gain: Positive


class _Place(_Stored):
    environment: _DrawnEnvironment | None = None
    materials: dict[str, _Finish] = {}
    background: _Backing | None = None


class _Conveyor(_Stored):
    time: float


class _LeftOut(_Stored):
    id: InstanceId
    asset: Count
    name: str
    reason: str


class _Record(_Stored):
    index: Count
    layout: Count
    view: Count
    split: Literal["train", "val", "test"]
    files: dict[str, str]
    lights: list[_Light] = []
    camera: _Camera
    labels: _Labels
    environment: _Environment | None = None
    depth_scale: Positive | None = None
    depth_sensor_scale: Positive | None = None
    objects: list[_Drawn] | None = None
    appearance: list[_Appearance] | None = None
    viewpoint: _Viewpoint | None = None
    place: _Place | None = None
    conveyor: _Conveyor | None = None
    empty: bool = False
    left_out: list[_LeftOut] = []
    order_error: _OrderError | None = None
    next: Count | None = None


def read_content(root: Path) -> JsonObject:
    """Read ``dataset.json``, which contains everything that determines the bytes of a dataset.

    Raises:
        InputError: If the folder is no dataset of mitsplat, or one of a version without label audit or of a newer
            version.
    """
    try:
        content: JsonObject = read_json(root / "dataset.json")
    except (FileNotFoundError, NotADirectoryError):
        raise no_folder_with(root, "dataset.json", "a dataset of mitsplat") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{root}: must be a dataset of mitsplat (dataset.json: {reason})") from error
    check_format_version(content, FORMAT_VERSIONS["dataset.json"], root / "dataset.json")
    try:
        checked = _Content.model_validate_json(json.dumps(content))
    except ValidationError as error:
        reason = f"dataset.json: {_first_message(error)}"
        raise InputError(f"{root}: must be a dataset of this version of mitsplat ({reason})") from error
    if len(content["keypoints"]) != len(content["classes"]):
        raise InputError(
            f"{root / 'dataset.json'}: keypoints must have one list per class "
            f"(got {len(content['keypoints'])} lists for {len(content['classes'])} classes)"
        )
    if len(content.get("centroids", [])) not in (0, len(content["assets"])):
        raise InputError(
            f"{root / 'dataset.json'}: centroids must have one point per asset "
            f"(got {len(content['centroids'])} points for {len(content['assets'])} assets)"
        )
    if not (root / "manifest.jsonl").is_file():
        raise InputError(f"{root}: must be a dataset of mitsplat (it has no manifest.jsonl)")
    content["scene"] |= checked.scene.model_dump(mode="json", include={"camera", "labels", "output"})
    return content


class Records:
    """Readable records of a dataset's frames, by ascending index; memory use is 24 bytes per frame.

    Attributes:
        violations: File and description for each unreadable line, filled by iteration.
    """

    def __init__(self, root: Path, content: JsonObject) -> None:
        self._path, self._content = root / "manifest.jsonl", content
        self.violations: list[tuple[str, str]] = []
        indices, offsets, offset = array("q"), array("q"), 0
        with open_regular(self._path) as file:
            for line in read_lines(file):
                found = _INDEX.match(line)
                indices.append(int(found[1]) if found else -1)
                offsets.append(offset)
                offset += len(line)
        self._offsets = np.array(offsets, dtype=np.int64)
        self._indices = np.array(indices, dtype=np.int64)
        self._order = np.argsort(self._indices, kind="stable")

    def __len__(self) -> int:
        return len(self._offsets)

    def __iter__(self) -> Iterator[Record]:
        self.violations = []
        yield from self._read(self._order)

    def sample(self, count: int) -> Iterator[Record]:
        """Iterate over up to ``count`` evenly spread records; unreadable lines among them are skipped."""
        yield from self._read(self._order[evenly_spaced(len(self), count)])

    def of_frame(self, index: int) -> Iterator[Record]:
        """Iterate over the readable records of one frame index."""
        yield from self._read(self._order[self._indices[self._order] == index])

    def _read(self, numbers: npt.NDArray[np.intp]) -> Iterator[Record]:
        """Yield the readable records of these lines; other lines are violations."""
        with open_regular(self._path) as file:
            end = 0
            for number in map(int, numbers):
                if self._offsets[number] != end:
                    file.seek(self._offsets[number])
                line = file.readline(LONGEST_LINE)
                end = self._offsets[number] + len(line)
                try:
                    record = parse_line(line)
                    check_record(line, record, self._content)
                    _check_masks(record)
                except ValueError as error:
                    text = f"line {number + 1} is not the record of a frame ({error})"
                    self.violations.append(("manifest.jsonl", text))
                else:
                    yield record


def check_record(line: bytes, record: Record, content: JsonObject) -> None:
    """Refuse a record whose keys, types or values are not those of a frame; masks are not checked.

    Args:
        line: Line of the manifest.
        record: Parsed record of the line.
        content: Content of ``dataset.json``.

    Raises:
        ValueError: With the reason.
    """
    try:
        _Record.model_validate_json(line)
    except ValidationError as error:
        raise ValueError(_first_message(error)) from error
    for file in record["files"]:
        if not file or "\0" in file or file.startswith("/") or ".." in file.split("/"):
            raise ValueError(f"file names must be relative to the dataset and lie in its folder (got {file[:80]!r})")
    if not any(file.startswith("images/") for file in record["files"]):
        raise ValueError("files must list the frame's image")
    if record["split"] not in splits_of(content["scene"]["output"]):
        raise ValueError(f"split must be among the dataset's (got {record['split']})")
    camera = record["camera"]
    Camera.from_json(camera)  # raises if it is no camera
    if record["labels"]["size"] != [camera["width"], camera["height"]]:
        raise ValueError(f"labels.size must be the camera's (got {record['labels']['size']})")
    if record.get("environment", ()) is None:
        raise ValueError("environment must be a segment or absent (got null)")
    if record.get("depth_scale") is None and {"bop", "depth"} & set(content["scene"]["output"]["formats"]):
        raise ValueError("depth_scale must be stated")
    if record.get("depth_sensor_scale") is None and "depth-sensor" in content["scene"]["output"]["formats"]:
        raise ValueError("depth_sensor_scale must be stated")
    for label in record["labels"]["instances"]:
        name = f"instance {label['id']}"
        for key, among in (("class_index", content["classes"]), ("asset", content["assets"])):
            if label[key] >= len(among):
                raise ValueError(f"{name}: {key} must be below {len(among)} (got {label[key]})")
        if len(label["keypoints"]) not in (0, len(content["keypoints"][label["class_index"]])):
            raise ValueError(f"{name}: keypoints must be those of its class (got {len(label['keypoints'])})")


def _check_masks(record: Record) -> None:
    for label in record["labels"]["instances"]:
        for code, box in (("rle", "box"), ("amodal_rle", "amodal_box")):
            try:
                _check_mask(label[code], label[box], *record["labels"]["size"])
            except ValueError as error:
                raise ValueError(f"instance {label['id']}: {code}: {error}") from error


def _check_mask(code: str, box: list[int], width: int, height: int) -> None:
    x0, y0, x1, y1 = box
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise ValueError(f"its box must lie in the image (got {box})")
    mask = decode_rle({"size": [height, width], "counts": code})
    # The decoder leaves pixels without a run uninitialised; only a complete code equals the encoding of its mask.
    if not mask[y0:y1, x0:x1].any() or coco_mask.encode(mask)["counts"].decode() != code:
        raise ValueError(f"must be a complete run-length code of a mask in its box (got {code[:20]!r} for {box})")


def _first_message(error: ValidationError) -> str:
    found = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, found['loc']))}: {found['msg']}"
