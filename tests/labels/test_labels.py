"""Labels: filter rules, exclusive masks, and outlines read back as Ultralytics reads them."""

import io
import json
import zlib
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image
from pycocotools import mask as coco_mask
from scipy import ndimage

from mitsplat.formats.maps import encode_mask_png
from mitsplat.formats.yolo import yolo_lines
from mitsplat.images.masks import Silhouette, bounds_of_ids, encode_mask, without_fragments
from mitsplat.labels.labels import LabelRules, Labels, Truth, label_instances
from mitsplat.labels.polygons import fill_polygon, outline, pixel_polygons


@dataclass(frozen=True)
class Seen:
    """The fields of mitsplat.scene.layout.Instance that labels use."""

    id: int
    class_index: int | None
    world_from_object: np.ndarray
    asset: int = 0


CLASSES = ("bolt", "nut")
ROUNDED = 4
"""Pixels that may differ if a resampled point lies on a corner, in the middle of a diagonal step."""


def truth_of(instance_map, second=None, alone=None):
    """Return the ground truth of a frame.

    Each silhouette equals the visible mask unless ``alone`` gives another.
    """
    ids = np.asarray(instance_map)
    silhouettes = {int(i): Silhouette.cropped(ids == i, 0, 0) for i in np.unique(ids[ids > 0])}
    silhouettes |= {i: Silhouette.cropped(mask, x, y) for i, (mask, x, y) in (alone or {}).items()}
    return Truth(ids, ids if second is None else np.asarray(second), silhouettes, np.ones(ids.shape))


def label(instance_map, second=None, alone=None, **limits):
    ids = range(1, max([int(np.max(instance_map, initial=0)), *(alone or {})]) + 1)
    instances = [Seen(i, (i - 1) % len(CLASSES), np.diag([1.0, 1.0, 1.0, 1.0])) for i in ids]
    return label_instances(truth_of(instance_map, second, alone), instances, CLASSES, LabelRules(**limits))


def read_yolo(text, width, height):
    """Return the boxes and masks of a label file as Ultralytics 8.4 computes them at the image's own size.

    Follows ultralytics/data: utils.verify_image_label (float32), dataset.update_labels_info with ops.resample_segments,
    instance.Instances.denormalize and utils.polygon2mask.
    """
    rows = [line.split() for line in text.strip().splitlines()]
    classes = [int(row[0]) for row in rows]
    segments = [np.array(row[1:], dtype=np.float32).reshape(-1, 2) for row in rows]
    assert all(len(row) > 6 for row in rows), "a row of 5 or fewer numbers reads as a box"
    assert all(segment.min() >= 0 and segment.max() <= 1 for segment in segments)
    boxes = [
        np.concatenate([segment.min(axis=0), segment.max(axis=0)]) * (width, height, width, height)
        for segment in segments
    ]
    size = max([1000, *(len(segment) + 1 for segment in segments)])
    pixels = [resample(segment, size) * np.array([width, height], dtype=np.float32) for segment in segments]
    return classes, boxes, [fill_polygon(points, width, height) for points in pixels]


def resample(segment, n):
    """Resample an outline like ultralytics.utils.ops.resample_segments."""
    if len(segment) == n:
        return segment
    closed = np.concatenate((segment, segment[:1]))
    x = np.linspace(0, len(closed) - 1, n - len(closed) if len(closed) < n else n)
    xp = np.arange(len(closed))
    x = np.insert(x, np.searchsorted(x, xp), xp) if len(closed) < n else x
    return np.stack([np.interp(x, xp, closed[:, i]) for i in range(2)], axis=1).astype(np.float32)


def through_yolo(instance_map, **limits):
    """Return (label, labelled mask of the whole image, box and mask as read back) of each instance."""
    height, width = np.shape(instance_map)
    labels = label(instance_map, **limits)
    classes, boxes, masks = read_yolo(yolo_lines(labels), width, height)
    assert classes == [entry.class_index for entry in labels.instances]
    return [
        (entry, whole(entry, (height, width)), box, mask)
        for entry, box, mask in zip(labels.instances, boxes, masks, strict=True)
    ]


def whole(entry, shape):
    mask = np.zeros(shape, dtype=bool)
    x0, y0, x1, y1 = entry.box
    mask[y0:y1, x0:x1] = entry.mask
    return mask


def disc(shape, centre, radius, value=1, into=None):
    canvas = np.zeros(shape, dtype=np.int32) if into is None else into
    return cv2.circle(canvas, centre, radius, value, cv2.FILLED)


def blob_mask(seed, size, smoothing, share):
    noise = np.random.default_rng(seed).normal(size=(size, size + 5))
    field = cv2.GaussianBlur(noise, (0, 0), smoothing) if smoothing > 0.6 else noise
    return field > np.quantile(field, 1 - share)


class TestRules:
    def test_a_fragment_below_the_limit_is_dropped_and_at_the_limit_kept(self):
        ids = np.zeros((20, 30), dtype=np.uint16)
        ids[2:12, 2:12] = 1
        ids[2:4, 20:24] = 1  # 8 px
        assert label(ids, min_fragment=8).instances[0].area == 108
        labels = label(ids, min_fragment=9)
        assert labels.instances[0].area == 100
        assert labels.instances[0].box == (2, 2, 12, 12)
        assert {reason: count for reason, count in labels.dropped.items() if count} == {"fragments": 1}

    def test_parts_that_touch_at_a_corner_are_one_part(self):
        ids = np.zeros((12, 12), dtype=np.uint16)
        ids[2:5, 2:5] = ids[5:8, 5:8] = 1
        assert label(ids, min_fragment=18, min_pixels=1).instances[0].area == 18

    def test_an_instance_below_the_limit_is_dropped_and_at_the_limit_kept(self):
        ids = np.zeros((12, 12), dtype=np.uint16)
        ids[2:6, 2:6] = 1  # 16 px
        assert label(ids, min_pixels=16).instances[0].area == 16
        assert label(ids, min_pixels=17).dropped["small"] == 1

    def test_fragments_are_dropped_before_an_instance_is_measured(self):
        ids = np.zeros((12, 40), dtype=np.uint16)
        ids[2, 0:35:5] = 1
        ids[5:8, 2:7] = 1
        labels = label(ids, min_pixels=16, min_fragment=8)
        assert not labels.instances
        assert {reason: count for reason, count in labels.dropped.items() if count} == {"fragments": 7, "small": 1}

    def test_an_instance_without_pixels_is_hidden_or_outside(self):
        ids = np.zeros((12, 12), dtype=np.uint16)
        ids[2:8, 2:8] = 3
        block = np.ones((3, 3), dtype=bool)
        outside = [(12, 4), (14, 4), (-5, 4), (4, 14), (4, -5)]
        labels = label(ids, alone={1: (block, 4, 4)} | {i: (block, *corner) for i, corner in enumerate(outside, 4)})
        assert [entry.id for entry in labels.instances] == [3]
        assert (labels.dropped["hidden"], labels.dropped["outside"]) == (1, len(outside) + 1)  # 2 is nowhere

    def test_visible_fraction_and_truncation_are_shares_of_the_silhouette(self):
        """A 10 x 10 square reaches 4 px over the left border; 2 of its 6 columns in the image are hidden."""
        ids = np.zeros((20, 30), dtype=np.uint16)
        ids[5:15, 0:4] = 1
        (entry,) = label(ids, alone={1: (np.ones((10, 10), dtype=bool), -4, 5)}).instances
        assert entry.visible_fraction == 40 / 60
        assert entry.truncation == pytest.approx(0.4)
        assert (entry.amodal.box, entry.silhouette_box, entry.silhouette_area) == ((0, 5, 6, 15), (-4, 5, 6, 15), 100)

    @pytest.mark.parametrize(
        ("x", "y", "inside"),
        [(-4, 5, (0, 5, 6, 15)), (24, 5, (24, 5, 30, 15)), (5, -4, (5, 0, 15, 6)), (5, 14, (5, 14, 15, 20))],
    )
    def test_a_silhouette_is_cut_at_every_border(self, x, y, inside):
        """Each 10 x 10 square reaches 4 px over one border; the rest of it is visible."""
        ids = np.zeros((20, 30), dtype=np.uint16)
        ids[inside[1] : inside[3], inside[0] : inside[2]] = 1
        (entry,) = label(ids, alone={1: (np.ones((10, 10), dtype=bool), x, y)}).instances
        assert (entry.amodal.box, entry.silhouette_box) == (inside, (x, y, x + 10, y + 10))
        assert entry.truncation == pytest.approx(0.4)

    def test_pixels_of_a_silhouette_without_a_depth_are_not_counted(self):
        """A 10 x 10 square is hidden in half of its columns; a 3 x 3 corner of it has no depth."""
        ids = np.zeros((20, 30), dtype=np.uint16)
        ids[5:15, 5:10] = 1
        truth = truth_of(ids, alone={1: (np.ones((10, 10), dtype=bool), 5, 5)})
        truth.depth[5:8, 5:8] = 0
        (entry,) = label_instances(truth, [Seen(1, 0, np.eye(4))], CLASSES, LabelRules()).instances
        assert entry.depth_area == 100 - 9

    def test_a_mask_that_only_touches_the_border_is_not_truncated(self):
        ids = np.zeros((20, 30), dtype=np.uint16)
        ids[0:6, 10:16] = 1
        assert label(ids).instances[0].truncation == 0

    def test_fragments_of_a_silhouette_do_not_hide_anything(self):
        ids = np.zeros((20, 30), dtype=np.uint16)
        ids[5:15, 5:15] = 1
        alone = ids == 1
        alone[2, 20:24] = True  # a floater; rule 1 also removes it from the mask
        assert label(ids, alone={1: (alone, 0, 0)}).instances[0].visible_fraction == 1

    @pytest.mark.parametrize("action", ["mark", "drop"])
    def test_instances_below_a_threshold_are_marked_or_dropped_and_counted(self, action):
        ids = np.zeros((20, 40), dtype=np.uint16)
        ids[5:15, 0:4] = 1
        ids[5:15, 10:20] = 2
        ids[5:15, 25:35] = 3
        second = ids.copy()
        second[5:15, 14:20] = 0
        alone = {1: (np.ones((10, 10), dtype=bool), 0, 5)}
        labels = label(ids, second, alone, min_visible=0.41, min_agreement=0.41, below_threshold=action)
        expected = {1: ("occluded",), 2: ("disagreeing",), 3: ()}
        if action == "mark":
            assert {entry.id: entry.marks for entry in labels.instances} == expected
        else:
            assert [entry.id for entry in labels.instances] == [3]
        counts = int(action == "drop")
        assert (labels.dropped["occluded"], labels.dropped["disagreeing"]) == (counts, counts)
        kept = label(ids, second, alone, min_visible=0.4, min_agreement=0.4, below_threshold="drop")
        assert [entry.id for entry in kept.instances] == [1, 2, 3]

    def test_agreement_of_shifted_masks_equals_its_closed_form(self):
        """Two 20 x 20 squares, one 3 px to the right of the other, have an IoU of 17/23.

        Only the parallel edges are within 2 px.
        """
        ids = np.zeros((40, 60), dtype=np.uint16)
        ids[10:30, 10:30] = 1
        (entry,) = label(ids, np.roll(ids, 3, axis=1)).instances
        assert entry.agreement == pytest.approx(17 / 23)
        assert 0.4 < entry.boundary_f1 < 0.6
        (entry,) = label(ids, np.roll(ids, 2, axis=1)).instances
        assert entry.boundary_f1 == 1
        (entry,) = label(ids, np.zeros_like(ids)).instances
        assert (entry.agreement, entry.boundary_f1) == (0, 0)

    def test_an_id_of_no_instance_is_refused(self):
        with pytest.raises(ValueError, match=r"must be those of instances, or 0 \(got 3\)"):
            label_instances(truth_of(np.full((4, 4), 3)), [], CLASSES, LabelRules())

    def test_a_map_without_integers_is_refused(self):
        with pytest.raises(ValueError, match="2-D integer arrays"):
            label_instances(truth_of(np.zeros((4, 4))), [], CLASSES, LabelRules())

    def test_ids_have_sixteen_bits(self):
        ids = np.zeros((20, 20), dtype=np.uint16)
        ids[4:12, 4:12] = 65535
        labels = label_instances(truth_of(ids), [Seen(65535, 1, np.eye(4))], CLASSES, LabelRules())
        assert (labels.instances[0].id, labels.instances[0].area) == (65535, 64)


class TestOutline:
    def test_a_rectangle_is_read_back_exactly_with_its_box(self):
        ids = np.zeros((20, 30), dtype=np.uint16)
        ids[5:15, 10:25] = 1
        [(_, mask, box, back)] = through_yolo(ids)
        np.testing.assert_array_equal(back, mask)
        np.testing.assert_allclose(box, (10, 5, 25, 15), atol=0.03)

    @pytest.mark.parametrize(
        "pixels", [[(5, 5)], [(5, 5), (6, 5)], [(5, 5), (6, 6)], [(0, 0)], [(x, 4) for x in range(9)]]
    )
    def test_masks_without_inner_pixels_are_read_back_exactly(self, pixels):
        ids = np.zeros((10, 10), dtype=np.uint16)
        for x, y in pixels:
            ids[y, x] = 1
        [(_, mask, _, back)] = through_yolo(ids, min_pixels=1, min_fragment=1)
        np.testing.assert_array_equal(back, mask)

    def test_a_ring_around_another_instance_is_read_back(self):
        ids = disc((120, 160), (80, 60), 45)
        disc(None, (80, 60), 25, 0, ids)
        disc(None, (82, 61), 12, 2, ids)
        for entry, mask, _, back in through_yolo(ids):
            np.testing.assert_array_equal(back, mask)
            assert entry.polygon_iou == 1.0

    def test_masks_with_many_holes_are_read_back(self):
        ids = np.ones((41, 61), dtype=np.uint16)
        ids[1:-1:2, 1:-1:2] = 0
        ids[10:20, 20:40] = 0
        [(_, mask, _, back)] = through_yolo(ids)
        np.testing.assert_array_equal(back, mask)

    def test_a_mask_cut_by_every_border_is_read_back_exactly(self):
        ids = disc((60, 60), (30, 30), 38)
        [(_, mask, box, back)] = through_yolo(ids)
        np.testing.assert_array_equal(back, mask)
        np.testing.assert_allclose(box, (0, 0, 60, 60), atol=0.03)

    def test_touching_instances_are_read_back_separately(self):
        ids = np.zeros((40, 60), dtype=np.uint16)
        ids[10:30, 10:30] = 1
        ids[10:30, 30:50] = 2
        read = [back for *_, back in through_yolo(ids)]
        assert not (read[0] & read[1]).any()

    def test_parts_are_joined_over_the_fewest_pixels(self):
        """The reader fills the bridge between two parts: it is exactly as wide as the gap and adds nothing else."""
        ids = np.zeros((60, 100), dtype=np.uint16)
        ids[10:50, 10:40] = 1
        ids[20:30, 47:80] = 1  # 7 px apart, nearest in the middle of an edge
        ids[52:58, 12:20] = 1  # 2 px apart
        [(entry, mask, _, back)] = through_yolo(ids)
        assert not (mask & ~back).any()
        assert np.count_nonzero(back & ~mask) == 7 + 2
        assert entry.polygon_iou == np.count_nonzero(mask) / np.count_nonzero(back)

    def test_a_part_inside_a_hole_is_read_back(self):
        ids = disc((120, 160), (80, 60), 45)
        disc(None, (80, 60), 25, 0, ids)
        disc(None, (80, 60), 15, 1, ids)
        [(entry, mask, _, back)] = through_yolo(ids)
        assert not (mask & ~back).any()
        assert entry.polygon_iou > 0.99

    @settings(max_examples=150, deadline=None)
    @given(st.integers(0, 2**32), st.integers(4, 60), st.floats(0.5, 5.0), st.floats(0.05, 0.95))
    @example(55, 55, 3.5, 0.05078125)
    def test_random_masks_are_read_back_up_to_bridges(self, seed, size, smoothing, share):
        mask = blob_mask(seed, size, smoothing, share)
        for entry, labelled, box, back in through_yolo(mask.astype(np.uint16), min_pixels=1, min_fragment=1):
            parts = cv2.connectedComponents(labelled.astype(np.uint8), connectivity=8)[0] - 1
            exact = fill_polygon(entry.polygon, mask.shape[1], mask.shape[0])
            assert not (labelled & ~exact).any()
            if parts == 1:
                np.testing.assert_array_equal(exact, labelled)
            # Bridges between parts are additional long diagonals, outside of all parts.
            assert np.count_nonzero((back ^ exact) & labelled) <= ROUNDED
            assert np.count_nonzero(back ^ exact) <= ROUNDED + parts - 1
            np.testing.assert_allclose(box, entry.box, atol=0.03)

    @settings(max_examples=30, deadline=None)
    @given(st.integers(0, 2**32), st.sampled_from([(1280, 720), (1920, 1080), (333, 4001), (16384, 100)]))
    def test_normalised_positions_keep_their_pixels_as_text(self, seed, size):
        width, height = size
        blob = blob_mask(seed, 40, 3.0, 0.5)
        ids = np.zeros((height, width), dtype=np.uint16)
        left, top = np.random.default_rng(seed).integers(0, (width - 45, height - 40), endpoint=True)
        ids[top : top + 40, left : left + 45] = cv2.connectedComponents(blob.astype(np.uint8))[1] == 1
        for _, mask, _, back in through_yolo(ids):
            assert np.count_nonzero(back ^ mask) <= ROUNDED

    def test_half_size_keeps_the_area_within_half_a_pixel_per_side(self):
        mask = disc((400, 400), (200, 200), 150).astype(bool)
        half = fill_polygon(outline(mask) / 2, 200, 200)
        exact = np.count_nonzero(mask) / 4
        assert exact <= np.count_nonzero(half) <= exact + 0.5 * np.pi * 150


def test_instance_masks_are_disjoint_and_cover_the_map():
    rng = np.random.default_rng(5)
    ids = np.zeros((200, 300), dtype=np.int32)
    for value in range(1, 121):
        disc(None, tuple(int(v) for v in rng.integers(0, (300, 200))), int(rng.integers(5, 20)), value, ids)
    labels = label(ids, min_pixels=1, min_fragment=1)
    total = sum(whole(entry, ids.shape).astype(int) for entry in labels.instances)
    np.testing.assert_array_equal(total, ids > 0)


@pytest.mark.parametrize(
    "box", [(0, 0, 40, 30), (5, 3, 20, 17), (30, 20, 40, 30), (0, 29, 40, 30), (39, 0, 40, 30), (3, 0, 9, 30)]
)
@pytest.mark.parametrize("share", [0.3, 0.9, 1.0])
def test_run_lengths_agree_with_pycocotools(box, share):
    x0, y0, x1, y1 = box
    mask = np.random.default_rng(x0 + y1).random((y1 - y0, x1 - x0)) <= share
    canvas = np.zeros((30, 40), dtype=np.uint8, order="F")
    canvas[y0:y1, x0:x1] = mask
    assert encode_mask(mask, box, (40, 30)) == coco_mask.encode(canvas)["counts"].decode()


@given(st.integers(0, 2**32 - 1), st.integers(1, 25), st.integers(1, 25), st.integers(1, 5))
@settings(max_examples=60, deadline=None)
def test_bounds_of_ids_agree_with_scipy(seed, height, width, count):
    ids = np.random.default_rng(seed).integers(0, count + 1, (height, width)).astype(np.uint16)
    ids[ids == count] = 40000  # ids have gaps
    expected = {
        number: (columns.start, rows.start, columns.stop, rows.stop)
        for number, bounds in enumerate(ndimage.find_objects(ids.astype(np.int32)), start=1)
        if bounds is not None
        for rows, columns in [bounds]
    }
    assert bounds_of_ids(ids) == expected
    assert list(bounds_of_ids(ids)) == sorted(expected)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.2, 0.5, 0.8]), st.integers(0, 40))
@settings(max_examples=60, deadline=None)
def test_fragments_are_the_parts_below_the_limit(seed, share, least):
    mask = np.random.default_rng(seed).random((9, 12)) < share
    kept, removed = without_fragments(mask, least)
    parts, count = ndimage.label(mask, structure=np.ones((3, 3)))
    large = [number for number in range(1, count + 1) if (parts == number).sum() >= least]
    assert np.array_equal(kept, np.isin(parts, large) & mask)
    assert removed == count - len(large)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (300, 2), (41, 700)])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_masks_written_as_png_are_read_by_opencv_and_pillow(size, share):
    """OpenCV (libpng) and Pillow both verify every checksum."""
    width, height = size
    rng = np.random.default_rng(width)
    for _ in range(8):
        (x0, x1), (y0, y1) = (sorted(rng.choice(extent + 1, 2, replace=False).tolist()) for extent in size)
        mask = rng.random((y1 - y0, x1 - x0)) < share
        data = encode_mask_png(mask, (x0, y0, x1, y1), size)
        canvas = np.zeros((height, width), dtype=np.uint8)
        canvas[y0:y1, x0:x1] = 255 * mask
        back = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(back, canvas)
        with Image.open(io.BytesIO(data)) as picture:
            assert picture.mode == "L"
            np.testing.assert_array_equal(np.asarray(picture), canvas)
        Image.open(io.BytesIO(data)).verify()
        # Both ignore rows beyond the last one. Between the header (33 bytes) and IEND (12) is one chunk IDAT.
        rows = zlib.decompress(data[33 + 8 : -12 - 4])
        assert rows == np.pad(canvas, ((0, 0), (1, 0))).tobytes()


def test_json_keeps_the_labels():
    ids = disc((50, 70), (30, 20), 15)
    disc(None, (60, 40), 9, 2, ids)
    labels = label(ids)
    back = Labels.from_json(json.loads(json.dumps(labels.to_json())))
    assert back.to_json() == labels.to_json()
    for one, other in zip(back.instances, labels.instances, strict=True):
        np.testing.assert_array_equal(one.mask, other.mask)
        np.testing.assert_array_equal(one.world_from_object, other.world_from_object)


def test_a_distractor_occludes_and_has_no_label():
    """An object without a class occludes half of a square."""
    ids = np.zeros((40, 40), dtype=np.uint16)
    ids[10:30, 10:20], ids[5:35, 20:35] = 1, 2
    square = np.ones((20, 20), dtype=bool)
    instances = [Seen(1, 0, np.eye(4)), Seen(2, None, np.eye(4)), Seen(3, None, np.eye(4))]
    labels = label_instances(truth_of(ids, alone={1: (square, 10, 10)}), instances, CLASSES, LabelRules())
    (found,) = labels.instances
    assert (found.id, found.visible_fraction, found.marks) == (1, 0.5, ())
    assert not any(labels.dropped.values())


@settings(max_examples=300)
@given(st.integers(1, 14), st.integers(1, 14), st.integers(0, 2**32 - 1), st.sampled_from([0.3, 0.5, 0.8]))
def test_pycocotools_restores_masks_from_polygons_of_pixel_edges(height, width, seed, share):
    mask = np.random.default_rng(seed).random((height, width)) < share
    polygons = pixel_polygons(mask)
    assert len(polygons) == ndimage.label(mask)[1]  # parts are connected by edges
    if polygons:
        code = coco_mask.merge(coco_mask.frPyObjects([p.ravel().tolist() for p in polygons], height, width))
        np.testing.assert_array_equal(coco_mask.decode(code) > 0, mask)


def test_a_ring_with_a_core_is_two_polygons_with_the_area_of_the_mask():
    mask = np.zeros((60, 80), dtype=np.uint8)
    for radius, value in ((25, 1), (15, 0), (6, 1)):
        cv2.circle(mask, (40, 30), radius, value, -1)
    polygons = pixel_polygons(mask > 0)
    x, y = zip(*(polygon.T for polygon in polygons), strict=True)
    areas = [abs(np.dot(u, np.roll(v, 1)) - np.dot(v, np.roll(u, 1))) / 2 for u, v in zip(x, y, strict=True)]
    assert len(polygons) == 2 and sum(areas) == mask.sum()


def test_the_truncation_counts_pixels_beyond_the_range_of_masks():
    everything = np.ones((12, 30), dtype=bool)
    ids = np.ones((4, 10), dtype=np.uint16)
    truth = Truth(ids, ids, {1: Silhouette((-10, -4, 20, 8), everything, beyond=640.0)}, ids)
    (found,) = label_instances(truth, [Seen(1, 0, np.eye(4))], CLASSES, LabelRules()).instances
    assert (found.silhouette_area, found.truncation) == (360, 1 - 40 / 1000)
    labels = Labels(10, 4, (found,), {})
    assert Labels.from_json(labels.to_json()).instances[0].truncation == found.truncation
