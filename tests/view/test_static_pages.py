"""Pages of assets, captures, datasets and splat files, and the filter of dataset images."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from mitsplat.cli import main
from mitsplat.dataset.records.manifest import Manifest
from mitsplat.errors import InputError
from mitsplat.view.dataset_index import DatasetIndex, Filter
from mitsplat.view.page import Address, Page, splat_arrays
from mitsplat.view.server import kind_of
from mitsplat.view.static_pages import CapturePage, DatasetPage, photo_picture, show_asset, show_splats
from tests.capture.isolation.balls import THINGS, capture_of_balls
from tests.conftest import KnownObject, box_asset


@pytest.fixture
def page() -> Iterator[Page]:
    page = Page("test", Address(port=0), gaussians=100)
    yield page
    page.close()


def labels_of(dataset: Path) -> dict[int, list[dict]]:
    return {record["index"]: record["labels"]["instances"] for record in Manifest(dataset / "manifest.jsonl")}


def longest(label: dict) -> int:
    x0, y0, x1, y1 = label["box"]
    return max(x1 - x0, y1 - y0)


def test_a_filter_finds_images_with_one_label_that_satisfies_all_conditions(clean):
    index, labels = DatasetIndex(clean), labels_of(clean)
    assert len(index) == len(labels) == 6
    assert index.find(Filter()) == sorted(labels)
    every = [label for found in labels.values() for label in found]
    middle = float(np.median([label["visible_fraction"] for label in every]))
    size = int(np.median([longest(label) for label in every]))
    for wanted in (
        Filter("nut"),
        Filter(None, (0, middle)),
        Filter(None, (0, 1), (size, np.inf)),
        Filter("bolt", (middle, 1), (0, size)),
    ):
        passed = [
            number
            for number, found in labels.items()
            if any(
                wanted.class_name in (None, label["class"])
                and wanted.visible[0] <= label["visible_fraction"] <= wanted.visible[1]
                and wanted.size[0] <= longest(label) <= wanted.size[1]
                for label in found
            )
        ]
        assert index.find(wanted) == passed
    assert index.find(Filter("no such class")) == []
    assert index.largest == max(map(longest, every))


def test_a_picture_has_the_labels_of_its_frame(clean):
    index = DatasetIndex(clean)
    number = next(number for number, found in labels_of(clean).items() if found)
    caption, plain = index.picture(number, "none")
    stored = cv2.imread(str(next((clean / "images").glob(f"*/{number:06d}.*"))))[..., ::-1]
    assert np.array_equal(plain, stored)
    assert caption.startswith(f"frame {number}, ")
    _, drawn = index.picture(number, "labels")
    label = labels_of(clean)[number][0]
    x0, y0, x1, y1 = label["box"]
    assert (drawn[y0:y1, x0:x1] != plain[y0:y1, x0:x1]).any()
    assert (index.picture(number, "silhouettes")[1] != plain).any()


def test_files_outside_of_a_dataset_are_not_shown(dataset):
    manifest = Manifest(dataset / "manifest.jsonl")
    records = list(manifest)
    (dataset / "manifest.jsonl").unlink()
    shutil.copy(dataset / next(name for name in records[0]["files"] if name.startswith("images/")), dataset.parent)
    changed = Manifest(dataset / "manifest.jsonl")
    for record in records:
        name = next(name for name in record["files"] if name.startswith("images/"))
        changed.append({**record, "files": {f"images/../../{Path(name).name}": "0"}})
    with pytest.raises(InputError, match="the record of frame 0 cannot be read"):
        DatasetIndex(dataset).picture(records[0]["index"])


def test_the_page_of_a_dataset_steps_through_filtered_images(page, clean):
    shown = DatasetPage(page, clean)
    assert len(shown.found) == 6
    shown._step(1)
    assert page._caption.content.startswith(f"frame {shown.found[1]}, ")
    shown._class.value = "nut"
    assert shown.found == tuple(DatasetIndex(clean).find(Filter("nut")))
    shown._visible.value = (0, 0)
    assert shown.found == ()
    assert page._caption.content == "no image passes the filter"
    shown._class.value = "../../etc/passwd"  # possible browser input
    assert shown.found == ()


def test_the_page_of_an_asset_shows_its_properties(page, tmp_path):
    box_asset("nut").save(tmp_path / "nut")
    show_asset(page, tmp_path / "nut")
    assert sorted(page._shown) == ["/meshes/nut", "/pieces/nut/0", "/splats/nut"]
    assert "12 Gaussians" in page._caption.content
    assert "0.02 × 0.03 × 0.01 m" in page._caption.content


def test_the_page_of_a_capture_shows_photos_with_their_masks(page, known_object: KnownObject, tmp_path):
    capture = known_object.capture
    folder = capture.photos[0].file.parents[1]
    shown = CapturePage(page, folder)
    assert sum(part.group == "cameras" for part in page._shown.values()) == len(capture.photos)
    view, frustum = page._server.initial_camera, page._handles["/cameras/0"]
    ahead = (view.look_at - view.position) / np.linalg.norm(view.look_at - view.position)
    for photo in capture.photos:  # the first view contains all cameras
        offset = photo.camera.centre - view.position
        assert np.degrees(np.arccos(offset @ ahead / np.linalg.norm(offset))) < 35
    half = np.tan(frustum.fov / 2)
    depth = frustum.scale / np.cbrt(half * half * frustum.aspect / 3)  # formula of viser's client
    assert depth == pytest.approx(page._shown["/cameras/0"].drawable.depth, rel=1e-5)
    shown._clicked(3)
    assert page._caption.content.startswith("03\\.png")
    darkened, whole = (photo_picture(capture.photos[3], masked=masked).astype(int) for masked in (True, False))
    outside = capture.photos[3].read().mask == 0
    assert np.array_equal(darkened[~outside], whole[~outside])
    assert darkened[outside] == pytest.approx(0.25 * whole[outside], abs=1)


def test_clicks_on_a_capture_pick_objects(page, tmp_path):
    capture_of_balls(tmp_path)
    shown = CapturePage(page, tmp_path / "capture")
    eye = np.array([0.5, -0.4, 0.5])

    def click(thing: int, says: str) -> None:
        shown._click.value = says
        x, y = THINGS[thing]
        shown._pointed(eye, np.array([x, y, 0.07]) - eye)

    click(0, "nothing")
    click(0, "as no option says")  # possible browser input
    assert shown._summary.content == ""
    assert "/cameras/0" in page._shown
    click(1, "marks the object")
    assert "/cameras/0" not in page._shown  # a click on a frustum would pick the point behind
    (pick,) = (text for _, text in shown._picks)
    assert shown._summary.content == f"```\n--pick {pick}\n```"
    assert page._caption.content.startswith(pick.partition(".")[0])  # its photo is shown with a cross
    assert (page._picture.image != 90).any()
    points = page._shown["/chosen/object"].drawable.points
    assert np.linalg.norm(points[:, :2] - THINGS[1], axis=1).max() < 0.05

    click(1, "excludes another object")
    assert "an object is selected by both --pick and --pick-not" in page._alert.content
    assert shown._summary.content == f"```\n--pick {pick}\n```" and "/chosen/object" in page._shown

    click(2, "removes an object from the environment")
    assert shown._summary.content.count("--remove") == 1 and not page._alert.visible
    points = page._shown["/chosen/removed"].drawable.points
    assert np.linalg.norm(points[:, :2] - THINGS[2], axis=1).max() < 0.05
    shown._pointed(eye, np.array([0.0, 0.0, 1.0]))
    assert "there is no point of the capture at this position" in page._alert.content
    shown._forget(all_of_them=True)
    assert shown._summary.content == "" and not [name for name in page._shown if name.startswith("/chosen")]
    shown._forget(all_of_them=False)  # no picks exist


def test_the_page_of_a_splat_file_shows_its_gaussians(page, tmp_path):
    box_asset("nut").splats.save(tmp_path / "nut.ply")
    show_splats(page, tmp_path / "nut.ply")
    assert list(page._shown) == ["/splats/file"]
    camera = page._server.initial_camera
    assert camera.up[1] < -0.5 and camera.position[1] < 0  # most files have -y up; view from above
    page.look_around("z")
    assert camera.up[2] > 0.5 and camera.position[2] > 0


def test_covariances_sent_to_viser_fit_half_floats():
    splats = box_asset("nut").splats
    arrays = splat_arrays(splats)
    halves = arrays["covariances"].astype(np.float16).astype(np.float64) * arrays["scale"] ** 2
    assert halves == pytest.approx(np.eye(3) * (splats.scales[:, :, None] ** 2), rel=2e-3, abs=1e-9)
    assert arrays["centers"] * arrays["scale"] == pytest.approx(splats.means, rel=1e-5)
    assert splat_arrays(splats.select(slice(0, 0)))["centers"].shape == (0, 3)


def test_the_kind_of_a_path_follows_from_its_contents(tmp_path):
    for name, kind in (("asset.yaml", "asset"), ("capture.json", "capture"), ("dataset.json", "dataset")):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / name).write_text(json.dumps({}))
        assert kind_of(tmp_path / kind) == kind
    for name, kind in (("a.yaml", "scene"), ("a.ply", "splats"), ("a.compressed.ply", "splats"), ("a.SPZ", "splats")):
        (tmp_path / name).touch()
        assert kind_of(tmp_path / name) == kind
    (tmp_path / "a.txt").touch()
    for path, rule in ((tmp_path / "a.txt", "must be a scene"), (tmp_path, "must be a folder with"), ("no", "no such")):
        with pytest.raises(InputError, match=rule):
            kind_of(Path(path))


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        (["no-such-path"], "no such file or folder"),
        ([".", "--gaussians", "0"], "--gaussians must be at least 1"),
        (["Makefile"], "must be a scene"),
    ],
)
def test_invalid_paths_of_the_view_command_are_refused_in_one_sentence(options, rule, capsys, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    with pytest.raises(SystemExit) as exit_:
        main(["view", *options])
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert rule in line
