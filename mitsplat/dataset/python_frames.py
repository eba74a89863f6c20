"""Dataset of frames that were made in Python, with the caller's own layouts, cameras and lights."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from mitsplat.arguments import check_type, path_of
from mitsplat.dataset.dataset_files import TIMINGS, hash_poses, layout_file
from mitsplat.dataset.dataset_folder import append_run, content_of, finish_folder, open_folder
from mitsplat.dataset.records.manifest import append_line
from mitsplat.dataset.write import DatasetSummary, FrameCounts
from mitsplat.errors import InputError
from mitsplat.formats.registry import Catalogue, write_frame
from mitsplat.frames.frame import Frame
from mitsplat.frames.sequence import with_successor
from mitsplat.runtime.device import current_device
from mitsplat.scene.scene import Scene
from mitsplat.scene.splits import Split, split_of
from mitsplat.storage.files import storage_errors, write_text


def write_frames(scene: Scene, out: str | Path, frames: Iterable[Frame], *, overwrite: bool = False) -> DatasetSummary:
    """Write frames that were made in Python as a dataset folder, in the formats of the scene.

    ::

        ms.write_frames(scene, "out/film", ms.render_frames(scene, layouts=simulate(), cameras=camera))

    Frames are numbered in the order of the iterable. Each frame counts as a layout of its own. Frames of equal poses,
    such as those of several cameras or of a moving camera, are of one split, which the number of different poses before
    them determines. Frames without objects count as different. The audit compares pictures, labels, layouts and cameras
    of such a dataset with each other, but not cameras with the scene. An interrupted run cannot be resumed. A frame has
    a file of its flow if this leads to the next frame of the iterable, as in a film of :func:`mitsplat.render_frames`.

    Args:
        scene: Scene of all frames; image size and formats are in ``scene.spec``.
        out: Folder; it is created if missing. It must be empty.
        frames: Frames of :func:`mitsplat.render_frames`, :func:`mitsplat.render_frame` or a :class:`mitsplat.Renderer`.
        overwrite: Remove a dataset that is already in the folder.

    Raises:
        InputError: If there are no frames, a frame does not have the scene's image size, or the folder holds other
            files. Also if flow is among the formats and the scene has a conveyor, whose views the flow relates.
    """
    Scene.check(scene)
    if not isinstance(frames, Iterable):
        raise InputError(f"frames must be a list or an iterator of frames (got {type(frames).__name__})")
    out, output = path_of(out, "out"), scene.spec.output
    if "flow" in output.formats and scene.spec.conveyor is not None:
        raise InputError(
            "output.formats: flow is not available for frames made in Python of a scene with a conveyor, because it "
            "relates views of one layout; save frame.flow instead"
        )
    # Each frame is a layout of its own.
    one_view = replace(scene, spec=scene.spec.model_copy(update={"output": output.model_copy(update={"views": 1})}))
    catalogue = Catalogue.of(scene)
    device = current_device().kind
    content = content_of(one_view, catalogue, device) | {"given": True}
    counts, splits = FrameCounts(), dict[str, Split]()
    with open_folder(out, content, scene.path, None, resume=False, overwrite=overwrite) as manifest:
        append_run(out, 1, device)
        pairs = with_successor(frames) if "flow" in output.formats else ((frame, None) for frame in frames)
        for index, (frame, following) in enumerate(pairs):
            check_type(frame, Frame, f"frame {index}", "render it by mitsplat.render_frame or mitsplat.render_frames")
            if frame.image.shape[:2] != (output.height, output.width):
                height, width = frame.image.shape[:2]
                raise InputError(
                    f"frame {index}: must be of the scene's {output.width}x{output.height} px (got {width}x{height})"
                )
            is_film = following is not None and _leads_to(frame, following)
            layout = replace(frame.layout, index=index).to_json()
            split = splits.setdefault(hash_poses(layout), split_of(len(splits), output))
            numbered = _numbered(frame, index, split, is_film=is_film)
            with storage_errors(out):
                write_text(out / layout_file(index), json.dumps(layout))
                record = write_frame(numbered, out, scene.spec, catalogue, original=frame)
                if is_film:
                    record["next"] = index + 1
            append_line(out / TIMINGS, {"index": index, **{k: round(v, 4) for k, v in frame.seconds.items()}})
            manifest.append(record)
        if not len(manifest):
            raise InputError("frames must have at least one frame (got none)")
        finish_folder(out, manifest, content, catalogue, counts.add)
        return counts.summary(out, rendered=len(manifest))


def _numbered(frame: Frame, index: int, split: Split, *, is_film: bool) -> Frame:
    """Return a frame with the plan of the only view of layout ``index``."""
    plan = replace(
        frame.plan,
        index=index,
        layout=index,
        view=0,
        split=split,
        next_camera=frame.plan.next_camera if is_film else None,
        # The camera's pose and lens contain all drawn values except the motion.
        viewpoint={name: value for name, value in frame.plan.viewpoint.items() if name == "motion"},
    )
    return replace(frame, plan=plan, layout=replace(frame.layout, index=index))


def _leads_to(frame: Frame, following: Frame) -> bool:
    """Return True if the flow of a frame leads to another frame: to its camera and its poses."""
    camera, layout = frame.plan.next_camera, frame.next_layout or frame.layout
    if camera is None or camera.to_json() != following.camera.to_json():
        return False
    return bool(layout.to_json()["instances"] == following.layout.to_json()["instances"])
