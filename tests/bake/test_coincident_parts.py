"""Parts of a mesh that have faces in one plane, so that it is random which one shows."""

from __future__ import annotations

import pytest
import trimesh

from mitsplat.bake.mesh_parts import read_model

RED, BLUE = (200, 0, 0, 255), (0, 0, 200, 255)


def painted(mesh: trimesh.Trimesh, colour: tuple[int, ...]) -> trimesh.Trimesh:
    mesh.visual.face_colors = colour
    return mesh


@pytest.mark.parametrize(
    ("lift", "beside", "colour", "is_named"),
    [
        (0.0, 0.0, BLUE, True),
        (0.0002, 0.0, BLUE, False),  # protrudes from the other part
        (0.0, 0.05, BLUE, False),  # touches it at its side, with flush tops
        (0.0, 0.0, RED, False),  # looks like it
        (-0.001, 0.0, BLUE, False),  # is inside it
    ],
)
def test_parts_in_one_plane_are_named(lift: float, beside: float, colour: tuple[int, ...], is_named: bool) -> None:
    """A plate ends at the upper side of a block."""
    block = painted(trimesh.creation.box((0.06, 0.06, 0.02)), RED)
    plate = painted(trimesh.creation.box((0.04, 0.04, 0.002)), colour)
    plate.apply_translation((beside, 0.0, 0.01 - 0.001 + lift))
    scene = trimesh.Scene({"block": block, "plate": plate})
    warnings = [text for text in read_model(scene).warnings if "faces in one plane" in text]
    assert len(warnings) == is_named
    if is_named:
        assert "parts 'block' and 'plate'" in warnings[0] and "0.01] m" in warnings[0]
