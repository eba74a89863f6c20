"""Audit of per-pixel maps against each other, and against masks, cameras and poses."""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import OpenEXR

from mitsplat.arrays import AnyArray, BoolArray, Float64Array
from mitsplat.audit.conveyor_motion import BeltMotion
from mitsplat.audit.dataset_check import DatasetCheck, Violations
from mitsplat.audit.decoded_frame import DecodedFrame
from mitsplat.audit.picture_check import read_16_bits
from mitsplat.images.exr_header import check_exr_header
from mitsplat.storage.files import JsonObject, read_regular

_FLOW_TOLERANCE = 0.02
"""Tolerance of optical flow for single precision and lens models [px]."""
_MAX_FLOW = 1e9
"""Magnitude of components above which a pixel has no flow."""
_MAX_DEPTH_ERROR = 0.25
"""Maximum median error of measured depth, relative to true depth; useful sensors are better."""
_MIN_INSTANCES = 6
"""Minimum number of instances of an asset for a conclusion."""
_MAX_TRUNCATION = 0.2
"""Maximum truncation of silhouettes whose centre is used; stronger truncation shifts the centre."""
_MAX_OFFSET, _MAX_DEPTH_OFFSET = 1.0, 0.2
"""Maximum offset of silhouettes from their poses, in half their size, and of depths, relative to depth.

Values of rendered scenes were up to 0.09 and 0.04. With inverted cameras, silhouettes were off by 2 to 30.
"""


class LayersCheck(DatasetCheck):
    """Check of ``depth/``, ``normals/``, ``flow/`` and ``layers/``, frame by frame."""

    def __init__(self, content: JsonObject) -> None:
        self._belt = BeltMotion(content)
        # Depth and flow are those of the splats. Masks of proxies also have pixels that show what is behind the splats.
        self._has_exact_masks = content["scene"]["labels"]["source"] == "splats"
        self._last: tuple[DecodedFrame, Float64Array, float] | None = None

    def check(self, frame: DecodedFrame) -> Violations:
        """Check the frame's maps against each other, and the flow from the previous frame to this one."""
        channels = dict[str, npt.NDArray[np.generic]]()
        layers = f"layers/{frame.split}/{frame.index:06d}.exr"
        if "exr" in frame.formats and (frame.root / layers).is_file():
            channels, error = _read_exr(frame.root / layers)
            yield from ((layers, text) for text in _check_channels(frame, channels, error))
        depth, step = None, 0.0
        if "Z" in channels and channels["Z"].shape == frame.size[::-1]:
            depth = channels["Z"].astype(np.float64)
        for file in _depth_files(frame):
            stored = read_16_bits(frame.root / file, frame.size[::-1])
            if stored is None:
                continue
            unit = frame.record["depth_scale"] / 1000
            if depth is None:
                depth, step = stored * unit, unit
            elif wrong := np.count_nonzero(np.abs(stored * unit - np.minimum(depth, 65535 * unit)) > 1.01 * unit):
                yield file, f"{wrong} pixels have another depth than in {layers if step == 0 else 'depth/'}"
        yield from _check_sensed(frame, depth)
        normals = f"normals/{frame.split}/{frame.index:06d}.png"
        if normals in frame.record["files"]:
            yield from ((normals, text) for text in _check_normals(frame, normals, channels))
        if self._last is not None:
            yield from self._check_flow(frame, *self._last)
        self._last = None if depth is None else (frame, depth, step)

    def _check_flow(self, frame: DecodedFrame, before: DecodedFrame, depth: Float64Array, step: float) -> Violations:
        """Compare the flow of the previous frame with that computed from its depth, both cameras and the poses."""
        file = f"flow/{before.split}/{before.index:06d}.flo"
        expected = "next" in before.record or frame.record["layout"] == before.record["layout"]
        if frame.index != before.index + 1 or not expected:
            return
        if file not in before.record["files"] or not (before.root / file).is_file():
            return
        flow = _read_flow(before.root / file, before.size)
        if flow is None:
            yield file, "cannot be read as optical flow of the frame's size"
            return
        check = _FlowCheck(before, frame, depth, step, flow)
        motions = list(self._motions(before, frame))
        wrong, rest = np.zeros(depth.size, dtype=bool), check.known.copy()
        for seen, motion in motions:
            chosen = check.known & seen.ravel()
            if motion is None or self._has_exact_masks:
                rest &= ~chosen
                if motion is not None and chosen.any():
                    wrong[chosen] = check.contradicts(motion, chosen)
        # The other pixels may show static parts, a belt, or instances that move.
        run = np.eye(4)
        run[:3, 3] = self._belt.between(before, frame)
        is_removed = not self._has_exact_masks and any(motion is None for _, motion in motions)
        wrong[rest] = not (is_removed or _has_unlabelled_motion(before))
        for motion in (np.eye(4), run, *(motion for _, motion in motions if motion is not None)):
            left = wrong & rest
            if left.any():
                wrong[left] = check.contradicts(motion, left)
        if count := np.count_nonzero(wrong):
            yield file, f"{count} pixels have a flow that contradicts depth and cameras"

    def _motions(self, before: DecodedFrame, frame: DecodedFrame) -> Iterator[tuple[BoolArray, Float64Array | None]]:
        """Yield the pixels (H, W) of labelled instances, and their motion in the world until the next frame.

        The motion is None if the instance has no label in the next frame.
        """
        width, height = before.size
        if "next" in before.record:
            after = {instance.id: instance.pose for instance in frame.instances}
            for instance in before.instances:
                is_known = instance.id in after
                motion = after[instance.id] @ np.linalg.inv(instance.pose) if is_known else None
                yield before.full_mask(instance), motion
            return
        for carried in (True, False):
            motion, seen = np.eye(4), np.zeros((height, width), dtype=bool)
            motion[:3, 3] = self._belt.between(before, frame) if carried else 0.0
            for instance in before.instances:
                if self._belt.carries(instance.entry["asset"], instance.pose) == carried:
                    seen |= before.full_mask(instance)
            yield seen, motion


class _FlowCheck:
    """Comparison of optical flow with the projected motion of the pixels' points.

    Args:
        before: Frame of the flow.
        after: Frame to which the flow leads.
        depth: Depth of ``before`` [m], shape (H, W).
        step: Quantisation step of the depth [m].
        flow: Stored flow [px], shape (H, W, 2).

    Attributes:
        known: Mask of the pixels with a depth, row by row, shape (H * W,).
    """

    def __init__(
        self, before: DecodedFrame, after: DecodedFrame, depth: Float64Array, step: float, flow: AnyArray
    ) -> None:
        height, width = depth.shape
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        self._before, self._after, self._depth, self._step = before, after, depth.ravel(), step
        self._pixels = np.stack([x.ravel(), y.ravel()], axis=1)
        self._rays = np.column_stack([before.ray_slopes(self._pixels), np.ones(len(self._pixels))])
        self._flow = flow.reshape(-1, 2)
        self._is_stated: BoolArray = np.asarray((np.abs(self._flow) < _MAX_FLOW).all(axis=1))
        self.known: BoolArray = self._depth > step

    def contradicts(self, motion: Float64Array, chosen: BoolArray) -> BoolArray:
        """Return a mask of the chosen pixels (H * W,) whose flow differs from that of points with a motion (4, 4).

        The points move in the world. A flow may be absent where the lens of the next camera has no ray.
        """
        turn = self._after.camera_from_world @ motion @ self._before.world_from_camera
        start, z, half = self._pixels[chosen], self._depth[chosen], self._step / 2

        def moved(z: Float64Array) -> Float64Array:
            return self._rays[chosen] * z[:, None] @ turn[:3, :3].T + turn[:3, 3]

        def project(points: Float64Array) -> Float64Array:
            return self._after.project(np.where(points[:, 2:] <= 0, (0, 0, 1), points))

        end = moved(z)
        expected = project(end) - start
        depth_effect = np.abs(project(moved(z + half)) - project(moved(z - half))).max(axis=1)
        tolerance = _FLOW_TOLERANCE + depth_effect + 1e-5 * np.abs(expected).max(axis=1)
        is_stated = self._is_stated[chosen]
        differs = np.abs(self._flow[chosen] - expected).max(axis=1) > tolerance
        in_front = end[:, 2] > self._after.record["camera"]["near"] + self._step
        is_far = ~(np.abs(expected) < 0.99 * _MAX_FLOW).all(axis=1)
        wrong: BoolArray = in_front & np.where(is_stated, differs, ~is_far)
        unknown = np.flatnonzero(wrong & ~is_stated)
        wrong[unknown[self._after.has_no_pixel(end[unknown])]] = False
        return wrong


def _read_flow(path: Path, size: tuple[int, int]) -> AnyArray | None:
    """Read optical flow in Middlebury's format, shape (H, W, 2); return None if it is not of this width and height.

    OpenCV crashes on negative sizes in the header.
    """
    width, height = size
    header = b"PIEH" + struct.pack("<ii", width, height)
    length = 2 * width * height
    try:
        data = read_regular(path, len(header) + 4 * length)
    except (OSError, ValueError):
        return None
    if not data.startswith(header) or len(data) < len(header) + 4 * length:
        return None
    return np.frombuffer(data, "<f4", length, len(header)).reshape(height, width, 2)


def _has_unlabelled_motion(frame: DecodedFrame) -> bool:
    """Return True if instances without a label may move until the next frame."""
    dropped = {reason: count for reason, count in frame.record["labels"]["dropped"].items() if reason != "fragments"}
    unlabelled = any(not drawn["label"] for drawn in frame.record.get("objects") or ())
    return "next" in frame.record and (any(dropped.values()) or unlabelled)


class PlacementCheck(DatasetCheck):
    """Check over the whole dataset that poses and cameras agree with the positions and depths of silhouettes.

    The position of an asset's geometry in its own coordinates is not stored. However, one point of the asset projects
    to the centre of all its silhouettes, at about the depth of its pixels. Sums over the dataset give the least-squares
    point and its residual.
    """

    def __init__(self) -> None:
        self._places, self._depths = defaultdict[int, _PointFit](_PointFit), defaultdict[int, _PointFit](_PointFit)

    def check(self, frame: DecodedFrame) -> Violations:
        """Add the frame's instances to the sums."""
        depth = None
        if (file := next(iter(_depth_files(frame)), None)) is not None:
            depth = read_16_bits(frame.root / file, frame.size[::-1])
        for label in frame.instances:
            asset, pose = label.entry["asset"], frame.camera_from_world @ label.pose
            rotation, shift = pose[:3, :3], pose[:3, 3]
            away = max(abs(float(shift[2])), 1e-6)
            x0, y0, x1, y1 = label.entry["silhouette_box"]
            if label.entry["truncation"] <= _MAX_TRUNCATION:
                slopes = frame.ray_slopes(np.array([[(x0 + x1) / 2, (y0 + y1) / 2]]))[0]
                reach = away * max(x1 - x0, y1 - y0) / 2 / frame.intrinsics[0, 0]
                rows = rotation[:2] - np.outer(slopes, rotation[2])
                self._places[asset].add(rows / reach, (slopes * shift[2] - shift[:2]) / reach)
            if depth is not None:
                left, top, right, bottom = label.box
                seen = float(np.median(depth[top:bottom, left:right][label.mask])) * frame.record["depth_scale"] / 1000
                unit = max(away, seen)
                self._depths[asset].add(rotation[2:] / unit, (seen - shift[2:]) / unit)
        yield from ()

    def finish(self) -> Violations:
        """Yield the violations after all frames were added."""
        for asset, fit in sorted(self._places.items()):
            if fit.count >= 2 * _MIN_INSTANCES and fit.rms > _MAX_OFFSET:
                yield (
                    "manifest.jsonl",
                    f"silhouettes of asset {asset} are {fit.rms / 2:.1f} times their size away from its poses",
                )
        for asset, fit in sorted(self._depths.items()):
            if fit.count >= _MIN_INSTANCES and fit.rms > _MAX_DEPTH_OFFSET:
                yield (
                    "manifest.jsonl",
                    f"depths of asset {asset} differ from its poses by {fit.rms:.0%} of its distance",
                )


class _PointFit:
    """Least-squares solution p of ``rows @ p = values``, from accumulated sums."""

    def __init__(self) -> None:
        self._square, self._product, self._total, self.count = np.zeros((3, 3)), np.zeros(3), 0.0, 0

    def add(self, rows: Float64Array, values: Float64Array) -> None:
        """Add equations."""
        self._square += rows.T @ rows
        self._product += rows.T @ values
        self._total += float(values @ values)
        self.count += len(values)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals; infinite if the sums overflow, as for invalid poses."""
        if not (np.isfinite(self._square).all() and np.isfinite(self._product).all()):
            return np.inf
        point = np.linalg.lstsq(self._square, self._product, rcond=1e-12)[0]
        return float(np.sqrt(max(0.0, self._total - float(self._product @ point)) / max(1, self.count)))


def _depth_files(frame: DecodedFrame) -> list[str]:
    """Return the existing depth pictures of the frame."""
    name = f"{frame.index:06d}.png"
    files = [f"depth/{frame.split}/{name}", f"{frame.bop_folder}/depth/{name}"]
    return [file for file in files if file in frame.record["files"] and (frame.root / file).is_file()]


def _check_sensed(frame: DecodedFrame, depth: Float64Array | None) -> Violations:
    """Check the size of measured depth, and its median error where the true depth is known."""
    file = f"depth-sensor/{frame.split}/{frame.index:06d}.png"
    if file not in frame.record["files"] or not (frame.root / file).is_file():
        return
    stored = read_16_bits(frame.root / file, frame.size[::-1])
    if stored is None:
        yield file, "cannot be read as a 16-bit grey image of the frame's size"
    elif depth is not None and (both := (stored > 0) & (depth > 0)).any():
        measured = stored[both] * frame.record["depth_sensor_scale"] / 1000
        error = float(np.median(np.abs(measured - depth[both]) / depth[both]))
        if error > _MAX_DEPTH_ERROR:
            yield file, f"depths have a median error of {error:.0%}"


def _read_exr(path: Path) -> tuple[dict[str, npt.NDArray[np.generic]], str]:
    """Return channels by name, and the read error, which is empty if there is none."""
    try:
        check_exr_header(path)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: np.array(channel.pixels) for name, channel in file.channels().items()}, ""
    except Exception as error:  # noqa: BLE001 - OpenEXR raises various types
        return {}, f"cannot be read as OpenEXR ({error})"


def _check_channels(frame: DecodedFrame, channels: Mapping[str, npt.NDArray[np.generic]], error: str) -> list[str]:
    if error:
        return [error]
    required = {*"RGBAZ", "instance", "proxy_instance", "normal.X", "normal.Y", "normal.Z"}
    if missing := required - channels.keys():
        return [f"has no channel {min(missing)}"]
    if any(values.shape != frame.size[::-1] for values in channels.values()):
        return ["is not of the frame's size"]
    source = "instance" if frame.content["scene"]["labels"]["source"] == "splats" else "proxy_instance"
    wrong = np.count_nonzero((channels[source] != frame.ids) & (frame.ids > 0))
    return [f"{wrong} pixels of the channel {source} differ from the masks"] if wrong else []


def _check_normals(frame: DecodedFrame, file: str, channels: Mapping[str, npt.NDArray[np.generic]]) -> list[str]:
    """Compare the normal map with the exact normals in ``layers/``, if the dataset has them."""
    picture = read_16_bits(frame.root / file, (*frame.size[::-1], 3)) if (frame.root / file).is_file() else None
    if picture is None:
        return ["cannot be read as a 16-bit colour image of the frame's size"]
    if any(f"normal.{axis}" not in channels for axis in "XYZ"):
        return []
    normals = np.stack([channels[f"normal.{axis}"] for axis in "XYZ"], axis=-1).astype(np.float64)
    if normals.shape != picture.shape:
        return []
    known = normals.any(axis=-1, keepdims=True)
    expected = np.where(known, 65535 * (np.clip(normals, -1, 1) + 1) / 2, 0)
    wrong = np.count_nonzero((np.abs(picture[..., ::-1] - expected) > 1).any(axis=-1))
    return [f"{wrong} pixels differ from the normals in layers/"] if wrong else []
