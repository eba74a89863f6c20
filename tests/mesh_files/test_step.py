"""STEP: sizes, names, colours and facets are compared with those of solids that the tests write themselves."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.bake.mesh_parts import read_model
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.images.colour import encode_srgb
from mitsplat.mesh_files.step import CLOSEST_VIEW, read_step, separate_parts
from mitsplat.runtime.child_process import ChildResult
from tests.mesh_files.step import Step

ORANGE, BLUE = (1.0, 0.5, 0.25), (0.0, 0.0, 1.0)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run OpenCASCADE in this process, which starts no child per test."""

    def run(function: Any, *arguments: str | Path, **_: Any) -> ChildResult:
        output = io.BytesIO()
        function(output, b"", *map(str, arguments))
        return ChildResult(0, output.getvalue(), "")

    monkeypatch.setattr("mitsplat.mesh_files.step.run_bounded", run)


def assembly(path: Path, unit: str = "mm", schema: str = "AP214") -> Path:
    """Write a block with two equal pins, one of which lies, whose curved sides are blue."""
    step = Step(unit, schema)
    block, pin = step.box((10.0, 20.0, 30.0)), step.cylinder(5.0, 40.0)
    step.paint(block[0], ORANGE)
    step.paint(pin[1][2], BLUE)
    whole, parts = step.product("frame"), (step.product("block", block), step.product("pin no. 1", pin))
    step.place(whole, parts[0], (0.0, 0.0, 0.0))
    step.place(whole, parts[1], (50.0, 0.0, 0.0))
    step.place(whole, parts[1], (0.0, 50.0, 0.0), Rotation.from_euler("x", 90, degrees=True))
    return step.save(path)


@pytest.mark.parametrize(
    ("unit", "metres", "schema"), [("mm", 1e-3, "AP203"), ("inch", 0.0254, "AP214"), ("m", 1.0, "AP242")]
)
def test_units_poses_names_and_colours_are_those_of_the_file(
    in_process: None, tmp_path: Path, unit: str, metres: float, schema: str
) -> None:
    block, standing, lying = read_model(assembly(tmp_path / "a.stp", unit, schema)).parts
    assert block.name == "block" and standing.name == "pin no. 1"
    np.testing.assert_allclose(block.mesh.bounds, metres * np.array([(0, 0, 0), (10, 20, 30)]), atol=1e-6 * metres)
    np.testing.assert_allclose(standing.mesh.bounds[:, 2], metres * np.array([0, 40]), atol=1e-5 * metres)
    np.testing.assert_allclose(lying.mesh.bounds[:, 1], metres * np.array([10, 50]), atol=1e-5 * metres)
    np.testing.assert_allclose(encode_srgb(block.colours), np.broadcast_to(ORANGE, (12, 3, 3)), atol=1e-5)
    assert not block.shiny  # a colour states nothing about metalness
    side = np.abs(standing.mesh.face_normals[:, 2]) < 0.5
    np.testing.assert_allclose(standing.colours[side], np.broadcast_to(BLUE, (side.sum(), 3, 3)), atol=1e-5)
    assert np.ptp(standing.colours[~side]) == 0


def test_a_solid_of_several_colours_is_closed(in_process: None, tmp_path: Path) -> None:
    _, pin, _ = read_model(assembly(tmp_path / "a.step")).parts
    assert pin.mesh.is_watertight and not pin.double_sided
    assert pin.mesh.volume == pytest.approx(np.pi * 0.005**2 * 0.04, rel=0.01)


@pytest.mark.parametrize("tolerance", [None, 1.0, 0.001])
def test_facets_are_within_the_tolerance(in_process: None, tmp_path: Path, tolerance: float | None) -> None:
    """By default, the tolerance is half a pixel where the longest extent has CLOSEST_VIEW pixels."""
    step = Step()
    step.product("pin", step.cylinder(50.0, 20.0))
    file = read_step(step.save(tmp_path / "a.step"), tolerance=tolerance)
    expected = tolerance or 0.5 * 100.0 / CLOSEST_VIEW
    assert file.tolerance == pytest.approx(expected, rel=1e-3)
    (part,) = file.parts
    mesh = trimesh.Trimesh(trimesh.transform_points(part.vertices, part.transform), part.faces)
    side = mesh.faces[np.abs(mesh.face_normals[:, 2]) < 0.5]
    middles = mesh.vertices[np.concatenate([side[:, :2], side[:, 1:]])].mean(axis=1)
    error = 50.0 - np.linalg.norm(middles[:, :2], axis=1).min()
    assert error < 1.01 * expected + 1e-5
    if tolerance != 1.0:  # there, the angle between facets is the narrower limit
        assert error > 0.2 * expected


def test_equal_parts_are_found_and_the_smallest_defines_the_tolerance(in_process: None, tmp_path: Path) -> None:
    file = read_step(assembly(tmp_path / "a.step"), separate=True)
    assert file.tolerance == pytest.approx(0.5 * 30.0 / CLOSEST_VIEW)
    parts = separate_parts(file)
    assert {name: count for name, (_, count) in parts.items()} == {"block": 1, "pin_no._1": 2}
    (pin,) = read_model(parts["pin_no._1"][0]).parts
    np.testing.assert_allclose(pin.mesh.bounds[:, 2], [0.0, 0.04], atol=1e-7)


def test_a_painted_copy_is_not_equal(in_process: None, tmp_path: Path) -> None:
    step, names = Step(), ("a", "A")
    boxes = [step.box((1.0, 2.0, 3.0)) for _ in names]
    step.paint(boxes[0][0], BLUE)
    whole = step.product("both")
    for name, box in zip(names, boxes, strict=True):
        step.place(whole, step.product(name, box), (0.0, 0.0, 0.0))
    assert list(separate_parts(read_step(step.save(tmp_path / "a.step")))) == ["a", "A_2"]


def test_files_that_cannot_be_read_are_refused_in_one_sentence(
    in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = assembly(tmp_path / "a.step")
    text = path.read_text()
    for content, message in (
        (text.replace("#9=", "#9=DOCUMENT_FILE('/etc/passwd','','',#8,'',$);#9999="), "(got /etc/passwd): export the"),
        (text[:400], "its text is damaged, or it has no surfaces"),
        (Step().save(path).read_text(), "its text is damaged, or it has no surfaces"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match=re.escape(message)):
            read_step(path)
    with pytest.raises(InputError, match="the tolerance must be finite and > 0 mm"):
        read_step(path, tolerance=0.0)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MissingResourceError, match=r"pip install 'mitsplat\[step\]'"):
        read_step(path)


def test_a_process_of_its_own_reads_the_file(tmp_path: Path) -> None:
    (tmp_path / "a.step").write_text("ISO-10303-21;\nHEADER;\n")
    with pytest.raises(InputError) as raised:
        read_step(tmp_path / "a.step")
    assert str(raised.value) == (
        f"{tmp_path}/a.step: not a STEP file that can be read (its text is damaged, or it has no surfaces)"
    )
    assert len(read_step(assembly(tmp_path / "b.step")).parts) == 3
