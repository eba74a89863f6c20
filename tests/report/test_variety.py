"""Statistics of draws, viewpoints, occlusion and light in the report, against manual counts."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools import mask as coco_mask
from scipy.spatial.transform import Rotation

from mitsplat.formats.coco import image_file
from mitsplat.geometry.camera_poses import look_at_pose
from mitsplat.pages.svg_charts import discs
from mitsplat.report import variety
from mitsplat.report.dataset_report import _FRACTIONS, _Statistics, write_report
from mitsplat.report.variety import MIN_VIEWS, RINGS, SECTORS, Variety, cell_of
from tests.cli.typed import run
from tests.manifests import records_of, store

CONTENT = {"classes": ["bolt", "nut"], "assets": ["long bolt", "nut"]}


def label(asset: int, *, box: tuple[int, int, int, int] = (0, 0, 4, 4), pose: Any = None, **stated: Any) -> Any:
    """Return an unoccluded instance in a box of an image of 20x10."""
    mask = np.zeros((10, 20), dtype=np.uint8, order="F")
    mask[box[1] : box[3], box[0] : box[2]] = 1
    code = coco_mask.encode(mask)["counts"].decode()
    own = np.eye(4) if pose is None else pose
    seen = {"class": CONTENT["classes"][asset], "asset": asset, "rle": code, "amodal_rle": code}
    seen |= {"visible_fraction": 1.0, "truncation": 0.0, "world_from_object": own.tolist()}
    return seen | stated


def record(*labels: Any, eye: Any = (0, -1, 1), split: str = "train", **stated: Any) -> dict[str, Any]:
    camera = {
        "world_from_camera": look_at_pose(eye, (0, 0, 0)).tolist(),
        "intrinsics": [[50.0, 0, 10], [0, 50.0, 5], [0, 0, 1]],
        "focus_distance": 1.0,
        "aperture_radius": 0.0,
    }
    return {"split": split, "camera": camera, "labels": {"instances": list(labels), "size": [20, 10]}} | stated


def counted(*records: dict[str, Any]) -> Variety:
    found = Variety(CONTENT)
    for one in records:
        found.add(one)
    return found


def numbers(page: str, caption: str) -> dict[str, str]:
    """Return the table below a chart."""
    figure = next(part for part in page.split("<figure>") if f"<figcaption>{caption}<" in part)
    return dict(re.findall(r'<th scope="row">([^<]+)</th><td>([^<]+)</td>', figure.split("</figure>")[0]))


def test_cells_have_equal_areas() -> None:
    directions = np.random.default_rng(0).standard_normal((9600, 3))
    counts = Counter(cell_of(direction) for direction in directions)
    assert len(counts) == 2 * RINGS * SECTORS
    assert all(abs(count - 200) < 5 * np.sqrt(200) for count in counts.values())
    assert {cell_of(np.array([0.1, 0.1, z]))[0] for z in (9, 0.01, -0.01, -9)} == {0, RINGS - 1, RINGS, 2 * RINGS - 1}


def test_view_directions_are_counted_in_object_coordinates() -> None:
    """A rotation of object and camera together changes nothing."""
    rng = np.random.default_rng(1)
    for turn in (np.eye(3), Rotation.random(rng=rng).as_matrix()):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, (0.1, 0.2, 0.3)
        eye = pose[:3, 3] + turn @ (0.3, 0.4, 2.0)
        page = counted(record(label(0, pose=pose), eye=eye)).sections()
        assert numbers(page, "View directions above objects") == {
            "long bolt": f"1 of {RINGS * SECTORS} directions, 1 views"
        }
        covered = f"{100 / (RINGS * SECTORS):.3g} %"
        assert numbers(page, "Covered view directions above objects") == {"long bolt": covered}
        assert numbers(page, "Covered view directions below objects") == {"long bolt": "0 %"}


def test_occlusion_counts_agree_with_masks(clean: Path) -> None:
    """Compares with masks of drawn frames, decoded and counted pixel by pixel."""
    expected = Counter[str]()
    for one in records_of(clean):
        labels = one["labels"]["instances"]
        masks = [
            [coco_mask.decode({"size": one["labels"]["size"][::-1], "counts": each[code]}) > 0 for each in labels]
            for code in ("amodal_rle", "rle")
        ]
        for a, whole, own in zip(labels, *masks, strict=True):
            kinds = {
                b["class"]
                for b, seen in zip(labels, masks[1], strict=True)
                if b is not a and (whole & ~own & seen).sum() > 0.05 * whole.sum()
            }
            expected.update(f"{kind} hides {a['class']}" for kind in kinds)
    assert len(expected) > 2
    page = write_report(clean, clean.parent / "variety.html")[0].read_text()
    found = numbers(page, "Most frequent pairs of occluder and occluded class")
    assert {name: int(count) for name, count in found.items()} == expected


def test_charts_of_labels_and_brightness_agree_with_the_files(clean: Path) -> None:
    """Counts are recomputed one by one from the manifest and the pictures."""
    records = records_of(clean)
    labels = [label for one in records for label in one["labels"]["instances"]]
    page = write_report(clean, clean.parent / "charts.html")[0].read_text()

    def counts(caption: str) -> dict[str, int]:
        return {name: int(count) for name, count in numbers(page, caption).items() if int(count)}

    assert counts("Instances by class") == Counter(label["class"] for label in labels)
    assert counts("Instances per image") == Counter(str(len(one["labels"]["instances"])) for one in records)
    for caption, key in (
        ("Visible fraction of instances", "visible_fraction"),
        ("Truncation of instances", "truncation"),
        ("Agreement of splats and proxies", "agreement"),
        ("Agreement of their boundaries", "boundary_f1"),
    ):
        bins = Counter(min(int(20 * label[key]), 19) for label in labels)
        assert counts(caption) == {f"{i / 20:.3g} to {(i + 1) / 20:.3g}": count for i, count in bins.items()}, caption
    greys = [cv2.imread(str(clean / image_file(one)), cv2.IMREAD_GRAYSCALE) for one in records]
    pixels = Counter(int(value) // 8 for grey in greys for value in grey.ravel())
    assert counts("Brightness of pixels") == {f"{8 * i} to {8 * i + 7}": count for i, count in pixels.items()}
    means = Counter(int(grey.mean() / 12.75) for grey in greys)
    shown = {f"{12.75 * i:.3g} to {12.75 * (i + 1):.3g}": count for i, count in means.items()}
    assert counts("Brightness of images") == shown


def test_maps_of_boxes_count_centres_and_sizes() -> None:
    """Cells have 1/24 of the width of the image and about the same height."""
    statistics = _Statistics((480, 240))
    boxes = [(20, 40, 100, 60), (21, 41, 101, 61), (460, 200, 480, 240)]
    entries = [{"box": box, "class": "nut", **dict.fromkeys(_FRACTIONS, 1.0)} for box in boxes]
    statistics.add({"split": "train", "labels": {"instances": entries}})
    places, sizes = np.zeros((12, 24)), np.zeros((12, 24))
    for x0, y0, x1, y1 in boxes:
        places[int((y0 + y1) / 2 / 20), int((x0 + x1) / 2 / 20)] += 1
        sizes[(y1 - y0) // 20, (x1 - x0) // 20] += 1
    np.testing.assert_array_equal(statistics.places._counts, places)
    np.testing.assert_array_equal(statistics.sizes._counts, sizes)


def test_every_draw_has_its_histogram() -> None:
    records = [
        record(
            draws={"exposure": value, "iso": 100.0, "backdrop": "oak" if value < 0.5 else "steel"},
            objects=[{"id": 1, "entry": 3, "scale": 1 + value}, {"id": 2, "entry": 3, "scale": 2.0}],
            lights=[{"kind": "point", "position": [value, 0, 1], "intensity": 2.0}],
        )
        for value in np.linspace(0, 1, 21)
    ]
    page = counted(*records).sections()
    exposure = numbers(page, "exposure")
    assert sum(map(int, exposure.values())) == 21 and exposure["0.95 to 1"] == "2"
    assert sum(map(int, numbers(page, "objects[3].scale").values())) == 42
    assert sum(map(int, numbers(page, "lights[0].position[0]").values())) == 21
    assert numbers(page, "backdrop") == {"oak": "10", "steel": "11"}
    same = dict(re.findall(r'<th scope="row">([^<]+)</th><td>([^<]+)</td>', page.split("Constant in all images")[1]))
    assert same["iso"] == "100" and same["lights[0].intensity"] == "2" and "exposure" not in same
    assert "objects[3].id" not in page


@pytest.mark.parametrize("eye", [(0, -1, 1), (0.6, -1, 0.4), (-2, 0.5, -1)])
@pytest.mark.parametrize("roll", [0, 10, -100])
def test_camera_angles_follow_from_its_position(eye: tuple[float, float, float], roll: float) -> None:
    """The camera looks at the origin, so its position in spherical coordinates gives the angles."""
    rolled = record(eye=eye)
    pose = np.array(rolled["camera"]["world_from_camera"])
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    rolled["camera"]["world_from_camera"] = pose.tolist()
    values = dict(variety._camera_values(rolled))
    x, y, z = eye
    assert values["camera elevation [degrees]"] == pytest.approx(np.degrees(np.arcsin(z / np.linalg.norm(eye))))
    assert values["camera azimuth [degrees]"] == pytest.approx(np.degrees(np.angle(complex(x, y))) % 360)
    assert values["camera roll [degrees]"] == pytest.approx(roll, abs=1e-6)
    assert [values[f"camera position {axis} [m]"] for axis in "xyz"] == pytest.approx(eye)


def test_samples_are_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variety, "_MAX_NUMBERS", 8)
    sample = variety._Sample()
    for value in range(100):
        sample.add(value)
    steps = np.diff(np.array(sample.values))
    assert len(sample.values) <= 8 and sample.values[0] == 0 and sample.values[-1] > 80
    assert set(steps) == {16.0}


class TestWarnings:
    def test_varied_datasets_get_no_warning(self) -> None:
        rng = np.random.default_rng(2)
        records = []
        for number in range(4 * MIN_VIEWS):
            poses = [np.eye(4), np.eye(4)]
            for pose in poses:
                pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
            hidden = {"visible_fraction": 0.8} if number % 4 == 0 else {"truncation": 0.1}
            lights = [{"position": [*rng.uniform(-1, 1, 2), 1.0], "intensity": 1.0}]
            labels = label(0, pose=poses[0], **hidden), label(1, pose=poses[1], **hidden)
            split = "val" if number % 5 == 0 else "train"
            records.append(record(*labels, split=split, lights=lights))
        found = counted(*records)
        assert found.warnings() == []
        assert "No warnings" in found.sections()

    def test_each_constant_property_gets_a_warning(self) -> None:
        lamp = [{"position": [-1, 0, 1], "intensity": 1.0}, {"position": [5, 0, 1], "intensity": 2.0}]
        records = [record(label(0), label(0), label(0), label(0), label(1), lights=lamp) for _ in range(30)]
        assert counted(*records, record(label(0), split="val")).warnings() == [
            "class bolt is never occluded",
            "class nut has 4.0 times fewer instances than bolt",
            "class nut has no instance in val",
            "class nut is never occluded",
            "only 0 of 151 instances are hidden by more than 5%",
            "no instance is cut off by the image's border",
            "long bolt is seen from 1 of the 24 directions above it",
            "light comes from the left in 30 of 30 images",
        ]

    def test_lights_are_weighted_by_their_irradiance(self) -> None:
        """A panel at 1 m is compared with a lamp at 10 m that is ten times as strong and gives a tenth of its light."""
        lamps = [
            {"position": [1, 0, 0], "radiance": 4.0, "size": [0.5, 0.5]},
            {"position": [-10, 0, 0], "intensity": 10.0},
            {"radiance": 5.0, "position": None},
        ]
        records = [record(label(0), lights=lamps) for _ in range(30)]
        assert "light comes from the right in 30 of 30 images" in counted(*records).warnings()

    def test_few_images_get_no_warning(self) -> None:
        assert counted(record(label(0), label(1))).warnings() == ["there are 2 instances, too few to learn from"]
        assert counted().warnings() == ["there are 0 instances, too few to learn from"]


def test_the_report_command_prints_the_warnings(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    records = records_of(dataset)
    for one in records:
        one["draws"]["odd"] = {"nested": [float("inf"), None, "<b>"]}  # draws are not validated
    store(dataset, records)
    assert run("report", dataset) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("report:") and all(line.startswith("look  ") for line in lines[:-1])
    assert "<b>" not in (dataset / "report.html").read_text()


def test_discs_show_cells_at_their_directions() -> None:
    """The cell around +x and above is drawn to the right of the middle and above it."""
    cells = np.zeros((2, 4), dtype=np.int64)
    cells[1, 0] = 3
    text = discs("c", {"nut": cells})
    cx, cy, radius = (float(re.search(rf'{key}="([\d.]+)"', text)[1]) for key in ("cx", "cy", "r"))  # type: ignore[index]
    path = re.search(r' d="M([\d.]+) ([\d.]+)A([\d.]+) .*?L([\d.]+) ([\d.]+)A([\d.]+)', text)
    assert path is not None
    inner_x, inner_y, inner, corner_x, corner_y, outer = map(float, path.groups())
    assert (inner_x, inner_y) == pytest.approx((cx + inner, cy), abs=0.1)
    assert (corner_x, corner_y) == pytest.approx((cx, cy - outer), abs=0.1)
    assert (inner**2 / outer**2, outer) == pytest.approx((0.5, radius), abs=0.01)
    assert discs("c", {}).count("nothing") == 1
