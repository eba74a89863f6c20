"""Hand-written XML scenes: accepted plugins and properties, errors, and the documented scene."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from mitsplat.asset import Asset
from mitsplat.cli import app
from mitsplat.errors import InputError
from mitsplat.frames.mitsuba_xml import _write_splats, describe_error, render_xml
from mitsplat.frames.untrusted_xml import check_xml
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.runtime.variant import ensure_variant
from tests.conftest import box_asset

ROOT = Path(__file__).parents[2]

SCENE = """<scene version="3.9.0">
    <integrator type="splat_proxy"/>
    <sensor type="perspective">
        <film type="hdrfilm"> <integer name="width" value="24"/> <integer name="height" value="16"/> </film>
        <transform name="to_world"> <lookat origin="0, 0, 0.1" target="0, 0, 0" up="0, 1, 0"/> </transform>
    </sensor>
{}
</scene>
"""

NUT = '<shape type="splats"> <string name="asset" value="nut"/> {} </shape>'

SPLAT_FILE = '<shape type="splats"> <string name="filename" value="{}"/> </shape>'

FILM = '<film type="hdrfilm"> <integer name="width" value="8"/> </film>'


def tuned(properties: str, text: str = SCENE.format("")) -> str:
    """Return a scene whose integrator has the given properties."""
    return text.replace('"splat_proxy"/>', f'"splat_proxy"> {properties} </integrator>')


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Create a folder with an asset in metres and one in millimetres."""
    box_asset("nut").save(tmp_path / "nut")
    box_asset("nut").save(tmp_path / "milli", splats="splats.spz")
    return tmp_path


def write(folder: Path, text: str) -> Path:
    (folder / "scene.xml").write_text(text)
    return folder / "scene.xml"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            SCENE.format(NUT.format('<float name="size" value="1"/>')),
            r":7: shape 'splats' takes no 'size'; it takes asset, filename, materials, metallic, proxy, units, "
            "to_world, instance, dynamic, capture_light, roughness, specular, colours, wear, wear_seed$",
        ),
        (
            SCENE.format('<shape type="sphere"> <string name="proxy" value="a"/> <float name="b" value="1"/> </shape>'),
            ":7: shape 'sphere' takes no 'proxy', 'b'$",
        ),
        (
            tuned('<float name="noise" value="1"/>'),
            ":2: integrator 'splat_proxy' takes no 'noise'; it takes quality, .*, max_depth, hide_emitters$",
        ),
        (
            f'<scene version="3.0.0">\n<sensor type="opencv_camera">{FILM} <float name="fov" value="1"/>'
            '<float name="fx" value="8"/> <float name="fy" value="8"/> </sensor> </scene>',
            ":2: sensor 'opencv_camera' takes no 'fov'; it takes fx, fy, cx, cy, distortion, lens, to_world, ",
        ),
        (
            SCENE.format("").replace('"perspective"', '"orthographic"'),
            r"scene.xml: integrator 'splat_proxy': the sensor must be 'opencv_camera', 'perspective' or 'thinlens' "
            r"\(got OrthographicCamera\)$",
        ),
        (
            tuned('<integer name="max_depth" value="1"/>'),
            r":2: integrator 'splat_proxy': 'max_depth' must be from 2 to 64 \(got 1\)$",
        ),
        (
            SCENE.format('<shape type="splats"/>').replace("splat_proxy", "path"),
            ":7: shape 'splats': 'asset' or 'filename' is missing$",
        ),
        (
            SCENE.format(NUT.format("")).replace("splat_proxy", "path"),
            r"scene.xml: shape 'splats' needs the integrator 'splat_proxy' \(got PathIntegrator\)$",
        ),
        (
            SCENE.format('<shape type="splats"> <string name="asset" value="bolt"/> </shape>'),
            ":7: shape 'splats': no such file: .*/bolt/asset.yaml$",
        ),
        (
            SCENE.format(SPLAT_FILE.format("milli/splats.spz")),
            ":7: shape 'splats': .*/milli/splats.spz is in the units and axes that .*/asset.yaml states: name the "
            "folder as 'asset', or give 'units'$",
        ),
        (
            SCENE.format(NUT.format('<float name="units" value="1"/>')),
            ":7: shape 'splats': 'asset' takes the place of 'filename', 'materials', 'proxy' and 'units'$",
        ),
        (SCENE.format('<shape type="splatz"/>'), r":7: no shape plugin is called 'splatz'; did you mean 'splats'\?$"),
        (SCENE.format('<shape type="sfere"/>'), r":7: no shape plugin is called 'sfere'; did you mean 'sphere'\?$"),
        (SCENE.format('<shape type="qqq"/>'), ":7: no shape plugin is called 'qqq'$"),
        (SCENE.format("").replace("splat_proxy", "splat_prox"), r":2: no integrator .* did you mean 'splat_proxy'\?$"),
        (SCENE.format('<shape type="ply"> <string name="filename" value="no.ply"/> </shape>'), ":7: .*file not found"),
        (SCENE.format('<shape type="sphere"> <float name="radius"/> </shape>'), ":7: missing required attribute"),
    ],
)  # fmt: skip
def test_each_fault_of_a_scene_is_describe_error_with_its_line(small: Path, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        render_xml(write(small, text), small / "out.png")
    assert "\n" not in str(caught.value) and str(caught.value).startswith(f"{small}/scene.xml")


def test_an_error_without_a_line_is_kept() -> None:
    assert describe_error(Path("a.xml"), "[scene.cpp:12] nothing works") == "a.xml: nothing works"
    assert describe_error(Path("a.xml"), "") == "a.xml: Mitsuba reported an error without a message"


@pytest.mark.usefixtures("files_tried")
def test_an_environment_map_with_negative_pixels_is_refused(small: Path) -> None:
    """Mitsuba's process took all memory."""
    mi.Bitmap(np.full((8, 16, 3), -1.0, dtype=np.float32)).write(str(small / "sky.exr"))
    sky = '<emitter type="envmap"> <string name="filename" value="sky.exr"/> </emitter>'
    path = write(small, SCENE.format(NUT.format("") + sky))
    with pytest.raises(InputError, match=r"sky\.exr: not a readable image \(its pixels must be finite and >= 0"):
        render_xml(path, small / "picture.png")


def test_a_camera_with_shear_is_refused(small: Path) -> None:
    sensor = (
        f'<sensor type="opencv_camera">{FILM} <float name="fx" value="8"/> <float name="fy" value="8"/> '
        '<transform name="to_world"> <scale value="2"/> </transform> </sensor>'
    )
    with pytest.raises(InputError, match="'to_world' must be a rotation and a translation"):
        render_xml(write(small, f'<scene version="3.0.0">{sensor}</scene>'), small / "out.png")


def test_an_asset_shape_has_metres_mesh_and_material(small: Path) -> None:
    ensure_variant()
    named = '<shape type="splats"> <string name="asset" value="{}"/> <integer name="instance" value="{}"/> </shape>'
    by_unit = (
        '<shape type="splats"> <string name="filename" value="milli/splats.spz"/> <float name="units" value="0.001"/>'
        '<string name="proxy" value="milli/mesh.ply"/> <integer name="instance" value="3"/>'
        '<string name="capture_light" value="scene"/> </shape>'
    )
    lines = named.format("nut", 1), named.format("milli", 2), named.format("nut", 0), by_unit
    path = write(small, SCENE.format("\n".join(lines)))
    shapes = sorted(mi.load_file(str(path)).shapes(), key=lambda shape: shape.instance)
    nut = Asset.load(small / "nut")
    for shape in shapes:
        at = shape.world_from_splats
        np.testing.assert_allclose(shape.splats.means @ at[:3, :3].T, nut.splats.means, atol=1e-5)
        np.testing.assert_allclose(shape.proxy.bounds @ at[:3, :3].T, nut.mesh.bounds, atol=1e-5)
    assert [s.capture_light for s in shapes] == ["uniform", "uniform", "uniform", "scene"]
    assert [s.specular for s in shapes] == pytest.approx([0, 0.04, 0.04, 0])


def test_an_asset_with_a_replaced_file_is_read_again(small: Path) -> None:
    """The other file is older, as after a copy that preserves times."""
    ensure_variant()
    description = {"type": "splats", "asset": str(small / "nut")}
    before = mi.load_dict(description).splats
    half = before.select(np.arange(len(before) // 2))
    half.save(small / "nut/splats.ply")
    os.utime(small / "nut/splats.ply", (1, 1))
    assert len(mi.load_dict(description).splats) == len(half)


def test_splats_have_the_materials_of_a_file_or_one_material(small: Path) -> None:
    ensure_variant()
    nut = replace(Asset.load(small / "nut"), name="shiny")
    varied = SplatMaterials.uniform(len(nut.splats), metallic=1.0, roughness=0.2)
    (small / "files").mkdir()
    files = _write_splats(replace(nut.splats, materials=varied), nut.mesh, small / "files", "shiny")
    shape = '<shape type="splats"> {} </shape>'
    strings = "".join(f'<string name="{name}" value="{value}"/>' for name, value in files.items())
    file = f'<string name="filename" value="{files["filename"]}"/>'
    uniform = f'{file} <float name="metallic" value="0.6"/> <float name="roughness" value="0.3"/>'
    path = write(
        small, SCENE.format(shape.format(strings + '<integer name="instance" value="1"/>') + shape.format(uniform))
    )
    one, other = sorted((s.splats.materials for s in mi.load_file(str(path)).shapes()), key=lambda m: m.metallic[0])
    np.testing.assert_allclose(np.stack([one.metallic, one.roughness, one.specular]).T, [[0.6, 0.3, 0.5]] * len(one))
    np.testing.assert_allclose(np.stack([other.metallic, other.roughness]).T, [[1, 0.2]] * len(other))
    for wrong in (strings + '<float name="metallic" value="1"/>', uniform.replace("0.6", "1.6")):
        with pytest.raises(RuntimeError, match=r"'metallic' (needs 'filename', and no|must be in)"):
            mi.load_file(str(write(small, SCENE.format(shape.format(wrong)))))


def test_an_asset_outside_of_the_scenes_folder_is_refused(small: Path) -> None:
    (small / "in").mkdir()
    text = SCENE.format('<shape type="splats"> <string name="asset" value="../nut"/> </shape>')
    with pytest.raises(InputError, match=r"scene\.xml:7: must not name a file outside of the scene's folder"):
        render_xml(write(small / "in", text), small / "out.png")
    check_xml(small / "in/scene.xml", allow_outside=True)


PARTS = """<scene version="3.9.0">
    <default name="radius" value="0.5"/> <default name="size" value="12"/> <default name="grey" value="0.5"/>
    <path value="maps"/>
    <integrator type="path"> <integer name="max_depth" value="3"/> </integrator>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="$size"/> <integer name="height" value="$size"/> <rfilter type="box"/>
        </film>
        <sampler type="independent"> <integer name="sample_count" value="1"/> </sampler>
        <transform name="to_world"> <lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/> </transform>
    </sensor>
    <include filename="parts/look.xml"/>
    <alias id="look" as="same"/>
    <shape type="sphere"> <float name="radius" value="$radius"/> <ref id="same"/> </shape>
    <shape type="ply"> <string name="filename" value="$kind_ball.ply"/> <ref id="look"/> </shape>
    <emitter type="envmap"> <string name="filename" value="sky.exr"/> </emitter>
    <emitter type="point"> <point name="position" x="$side" y="1" z="2"/> <rgb name="intensity" value="1"/> </emitter>
</scene>
"""

LOOK = """<scene version="3.9.0">
    <integer name="of_the_included_file" value="1"/>
    <include filename="deeper/names.xml"/>
    <bsdf type="diffuse" id="look">
        <texture type="bitmap" name="reflectance"> <string name="filename" value="parts/look.png"/> </texture>
    </bsdf>
</scene>
"""

NAMES = """<scene version="3.9.0">
    <default name="kind" value="small"/> <default name="side" value="1.5"/> <default name="radius" value="9"/>
    <emitter type="point"> <point name="position" value="3"/>
        <spectrum name="intensity" filename="flat.spd"/> </emitter>
</scene>
"""


def test_a_scene_with_includes_renders_as_mitsuba_renders_it(tmp_path: Path) -> None:
    """One sample per pixel: Mitsuba sums several in arbitrary order."""
    ensure_variant()
    for folder in ("maps", "parts/deeper"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "parts/look.xml").write_text(LOOK)
    # Mitsuba resolves spectra only in folders of files that include others.
    (tmp_path / "parts/deeper/names.xml").write_text(NAMES)
    (tmp_path / "parts/flat.spd").write_text("400 0.1\n500 0.2\n700 0.4\n")
    grid = np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3)
    mi.Bitmap(grid).write(str(tmp_path / "maps/sky.exr"))
    mi.Bitmap((grid * 255).astype(np.uint8)).write(str(tmp_path / "parts/look.png"))
    trimesh.creation.icosphere(1, 0.8).export(tmp_path / "maps/small_ball.ply")
    scene = write(tmp_path, PARTS)
    render_xml(scene, tmp_path / "ours.exr")
    alone = mi.load_file(str(scene))
    mi.Bitmap(np.array(alone.integrator().render(alone, alone.sensors()[0]))[..., :3]).write(
        str(tmp_path / "alone.exr")
    )
    ours, others = (np.array(mi.Bitmap(str(tmp_path / f"{name}.exr"))) for name in ("ours", "alone"))
    # On a GPU, pixels sum their samples in any order.
    np.testing.assert_allclose(ours, others, rtol=1e-5 if mi.variant().startswith("cuda") else 0)


def test_a_scene_with_many_lamps_gives_the_same_picture_again(small: Path) -> None:
    """By default, Mitsuba lists the parts of a file in arbitrary order, on which the noise of the light depends."""
    lamp = """<shape type="rectangle">
        <transform name="to_world"> <lookat origin="{}, {}, 1" target="0, 0, 0" up="0, 0, 1"/> </transform>
        <emitter type="area"> <rgb name="radiance" value="{}"/> </emitter>
    </shape>"""
    lamps = [lamp.format(0.3 * i - 1, 0.7 - 0.2 * i, 3 + i) for i in range(6)]
    ball = '<float name="radius" value="0.01"/> <bsdf type="roughconductor"/>'
    table = f'<shape type="rectangle"/> <shape type="sphere"> {ball} </shape>'
    scene = write(small, SCENE.format("\n".join([NUT.format('<integer name="instance" value="1"/>'), table, *lamps])))
    pictures = {render_xml(scene, small / f"{i}.exr").read_bytes() for i in range(4)}
    assert len(pictures) == 1


def test_an_error_in_an_included_file_names_its_line(small: Path) -> None:
    (small / "parts").mkdir()
    (small / "parts/more.xml").write_text(
        '<scene version="3.9.0">\n\n<shape type="sphere"> <float name="b"/> </shape></scene>'
    )
    scene = write(small, SCENE.format('<include filename="parts/more.xml"/>'))
    with pytest.raises(InputError, match=r'/parts/more\.xml:3: missing required attribute "value"'):
        render_xml(scene, small / "out.png")


@pytest.mark.parametrize("place", ["scene", pytest.param("here", marks=pytest.mark.extended)])
def test_native_plugins_in_the_scene_folder_are_not_loaded(small: Path, place: str) -> None:
    """Mitsuba searches the current folder and the scene's folder for plugins before its own."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler")
    code = '#include <stdio.h>\n__attribute__((constructor)) void f(void) { fclose(fopen("%s", "w")); }' % (
        small / "ran"
    )
    (small / "a.c").write_text(code)
    here = small / "here"
    for folder in (small, here) if place == "scene" else (here,):
        (folder / "plugins").mkdir(parents=True)
    library = (small if place == "scene" else here) / "plugins/sphere.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, small / "a.c"], check=True)
    scene = write(small, SCENE.format('<shape type="sphere"/>'))
    command = [Path(sys.executable).with_name("mitsplat"), "render", scene, "-o", small / "out.png"]
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not (small / "ran").exists()


@pytest.mark.extended
def test_the_documented_scene_renders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The image is 8 times smaller than documented, so that the test is fast."""
    (text,) = re.findall(r"```xml\n(.*?)```", (ROOT / "docs/xml_and_plugins.md").read_text(), re.DOTALL)
    for name in set(re.findall(r'name="asset" value="([^"]+)"', text)):
        shutil.copytree(ROOT / name, tmp_path / name)
    text = re.sub(r'name="(width|height)" value="(\d+)"', lambda m: f'name="{m[1]}" value="{int(m[2]) // 8}"', text)
    write(tmp_path, tuned('<integer name="lens_rings" value="1"/>', text))
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["render", str(tmp_path / "scene.xml"), "-o", str(tmp_path / "scene.png")])
    assert result.exit_code == 0, result.output
    picture = np.array(mi.Bitmap(str(tmp_path / "scene.png")), dtype=float)
    assert picture.shape == (45, 80, 3)
    parts = (slice(14, 24), slice(45, 54)), (slice(22, 28), slice(27, 34)), (slice(35, 45), slice(10, 70))
    gold, gear, mat = (picture[part].mean((0, 1)) for part in parts)
    assert gold[0] > 1.3 * gold[2] > 50
    assert mat[2] > 1.1 * mat[0] > 20
    assert np.ptp(gear) < 15
