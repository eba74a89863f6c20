"""Highlights that COLLADA states, equal to those of the same MTL file."""

from __future__ import annotations

from pathlib import Path

import pytest

from mitsplat.bake.mesh_parts import read_model
from tests.mesh_files.test_spellings import dae

pytest.importorskip("collada", reason="needs pycollada, which reads COLLADA")

SPECULAR = "<specular><color>0.5 0.3 0.4 1</color></specular>"
SHININESS = "<shininess><float>50</float></shininess>"
MIRROR = "<reflective><color>1 1 1 1</color></reflective><reflectivity><float>0.5</float></reflectivity>"


def write_obj(folder: Path, keys: str) -> Path:
    (folder / "a.mtl").write_text(f"newmtl a\nKd 1 0 0\n{keys}")
    (folder / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl a\nf 1 3 2\nf 1 2 4\n")
    return folder / "a.obj"


@pytest.mark.parametrize(
    ("shading", "effect", "keys"),
    [
        ("phong", SPECULAR + SHININESS, "Ks 0.5 0.3 0.4\nNs 50\n"),
        ("blinn", SPECULAR + SHININESS, "Ks 0.5 0.3 0.4\nNs 50\n"),
        ("phong", SPECULAR, "Ks 0.5 0.3 0.4\n"),
        ("phong", SHININESS, "Ns 50\n"),
        ("lambert", "", ""),
        ("lambert", MIRROR, ""),
    ],
)
def test_highlights_are_those_of_the_same_mtl_file(tmp_path: Path, shading: str, effect: str, keys: str) -> None:
    content = dae("<color>1 0 0 1</color>", effect=effect).replace("phong>", f"{shading}>")
    (tmp_path / "a.dae").write_text(content)
    (part,), (other,) = read_model(tmp_path / "a.dae").parts, read_model(write_obj(tmp_path, keys)).parts
    found = [(one.shiny, one.metallic, one.roughness, one.reflectance, one.specular) for one in (part, other)]
    assert found[0] == found[1]
    assert any("reflectivity" in text for text in part.warnings) == (effect == MIRROR)


def test_each_group_of_faces_has_the_highlight_of_its_material(tmp_path: Path) -> None:
    """Two instances of one geometry have other materials, and lines between them have none."""
    content = dae("<color>1 0 0 1</color>", effect=SPECULAR + SHININESS)
    matt = '<effect id="f"><profile_COMMON><technique sid="t"><lambert/></technique></profile_COMMON></effect>'
    content = content.replace("</library_effects>", matt + "</library_effects>")
    content = content.replace(
        "</library_materials>", '<material id="n"><instance_effect url="#f"/></material></library_materials>'
    )
    lines = '<lines count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1</p></lines>'
    content = content.replace('<triangles count="4"', lines + '<triangles count="4"')
    node = content[content.index("<node>") : content.index("</node>") + len("</node>")]
    content = content.replace(node, node.replace("#m", "#n") + node)
    (tmp_path / "a.dae").write_text(content)
    assert [part.shiny for part in read_model(tmp_path / "a.dae").parts] == [False, True]
