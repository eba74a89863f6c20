"""Evaluation reports for given detections."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsplat.detector.detector_evaluation import Evaluation, coco_truth, evaluate_detector, write_evaluation
from mitsplat.detector.detector_report import worst_images
from mitsplat.detector.labelled_sets.labelled_set import LabelledSet
from mitsplat.detector.labelled_sets.set_reading import read_set
from mitsplat.detector.scores import Confusion, DetectionMatches
from mitsplat.errors import InputError
from tests.conftest import contents
from tests.detector.painted import write_coco, write_yolo


def guesses(found: LabelledSet, seed: int = 0) -> list[dict[str, Any]]:
    """Return the labels as detections, some of them shifted, of another class, of low score, or omitted."""
    rng, detections = np.random.default_rng(seed), []
    for annotation in coco_truth(found, masks=True)["annotations"]:
        x, y, w, h = annotation["bbox"]
        kind = annotation["category_id"]
        if rng.random() < 0.15:
            continue
        detections.append(
            {
                "image_id": annotation["image_id"],
                "category_id": 3 - kind if rng.random() < 0.2 else kind,
                "bbox": [x + float(rng.normal(0, 2)), y + float(rng.normal(0, 2)), w, h],
                "score": round(float(rng.uniform(0.1, 1)), 4),
                "segmentation": annotation["segmentation"],
            }
        )
    return detections


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> tuple[LabelledSet, Evaluation]:
    folder = tmp_path_factory.mktemp("judged")
    found = read_set(write_yolo(folder / "cell", {"val": 12}, first=100), "val")
    about = {"run": "runs/<cell>", "size": 96, "versions": {"mitsplat": "0"}}
    return found, write_evaluation(found, guesses(found), folder / "out", masks=True, about=about)


def test_stored_results_follow_from_stored_truth_and_detections(judged: tuple[LabelledSet, Evaluation]) -> None:
    found, evaluation = judged
    files = {path.name for path in evaluation.path.iterdir()}
    assert files == {"results.json", "detections.json", "truth.json", "report.html"}
    truth, detections, results = (
        json.loads((evaluation.path / f"{name}.json").read_text()) for name in ("truth", "detections", "results")
    )
    assert results == evaluation.results and detections == guesses(found)
    assert [image["file_name"] for image in truth["images"]] == [sample.name for sample in found.samples]
    for key, kind in (("box", "bbox"), ("mask", "segm")):
        score = DetectionMatches(truth, detections, kind).average_precision()  # type: ignore[arg-type]
        assert 0 < score.map50_95 < score.map50 < 1 or key == "mask"
        assert results[key]["map50_95"] == round(score.map50_95, 5)
        assert results[key]["classes"]["disc"]["ap50"] == round(score.classes["disc"][1], 5)
    matrix = np.array(results["confusion"]["matrix"])
    labelled = results["data"]["instances"]
    assert matrix[:-1].sum(axis=1).tolist() == [labelled["disc"], labelled["box"]]


def test_the_report_is_complete_and_shows_the_worst_images(judged: tuple[LabelledSet, Evaluation]) -> None:
    _, evaluation = judged
    page = evaluation.page.read_text()
    for heading in ("Summary", "Classes", "Charts", "Confusion", "Worst images"):
        assert f">{heading}</h2>" in page
    assert "runs/&lt;cell&gt;" in page and "<cell>" not in page
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources and all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert len(sources) % 2 == 0 and 2 <= len(sources) <= 16
    assert f"{evaluation.results['box']['map50_95']:.3f}" in page
    assert page.count("<polyline") == 2 * 3  # boxes and masks: the mean and two classes
    assert 'class="mask"' in page and 'class="box"' in page


def test_images_with_most_errors_come_first() -> None:
    errors = {1: (3, 0, 0, 0), 2: (1, 1, 0, 0), 3: (0, 1, 0, 0), 4: (2, 0, 0, 2), 5: (0, 1, 1, 1)}
    assert worst_images(Confusion(np.zeros((1, 1), dtype=np.int64), errors)) == [5, 3, 4, 2]


def test_a_folder_with_other_files_is_not_written(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    record = {"settings": {"size": 64}, "classes": ["disc", "box"], "masks": True, "finished": {"steps": 1}}
    (run / "run.json").write_text(json.dumps(record))
    (run / "weights.pt").touch()
    data = write_yolo(tmp_path / "cell", {"val": 1})
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/thesis.tex").touch()
    before = contents(tmp_path)
    for out, rule in (
        (data, "must not contain the evaluated images"),
        (tmp_path, "must not contain the evaluated images"),
        (tmp_path / "thesis", r"must contain only an evaluation \(got thesis.tex\)"),
    ):
        with pytest.raises(InputError, match=f"{out}: {rule}"):
            evaluate_detector(run, data, out)
    assert contents(tmp_path) == before


def test_boxes_without_masks_are_evaluated_as_boxes(tmp_path: Path) -> None:
    found = read_set(write_yolo(tmp_path / "cell", {"val": 3}, boxes=True), "val")
    detections = [
        {key: annotation[key] for key in ("image_id", "category_id", "bbox")} | {"score": 0.9}
        for annotation in coco_truth(found, masks=False)["annotations"]
    ]
    evaluation = write_evaluation(found, detections, tmp_path / "out", masks=False, about={})
    assert evaluation.results["box"]["map50_95"] == 1.0 and "mask" not in evaluation.results
    assert "All detections are correct." in evaluation.page.read_text()


def test_no_detections_give_a_result_of_zero(tmp_path: Path) -> None:
    found = read_set(write_yolo(tmp_path / "cell", {"val": 2}), "val")
    evaluation = write_evaluation(found, [], tmp_path / "out", masks=True, about={})
    assert evaluation.results["mask"] == {
        "map50_95": 0.0,
        "map50": 0.0,
        "classes": {name: {"ap50_95": 0.0, "ap50": 0.0} for name in evaluation.results["mask"]["classes"]},
    }


def test_crowds_that_are_not_detected_are_no_error(tmp_path: Path) -> None:
    found = read_set(write_coco(tmp_path / "crowds", 2, form="compressed", crowd=True), "all")
    results = write_evaluation(found, [], tmp_path / "out", masks=True, about={}).results
    assert results["box"]["map50_95"] is None and results["box"]["classes"] == {}
    assert np.array(results["confusion"]["matrix"]).sum() == 0
