"""Hostile scenes and archives: no file outside is read, memory is bounded, and no code is run."""

import gzip
import json
import os
import resource
import struct
import sys
import time
import zipfile

import pytest
import trimesh

from benchmarks.scale.attack.__main__ import all_attacks
from benchmarks.scale.attack.attack import SECRET_COLOUR, SECRET_WORD, Attack, judge
from benchmarks.scale.attack.samples import Place, Samples
from mitsplat.asset import Asset
from mitsplat.bake.mesh_parts import read_model
from mitsplat.engine import scheduler
from mitsplat.errors import InputError
from mitsplat.frames import mitsuba_xml as xml_scene
from mitsplat.frames.untrusted_xml import check_xml
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry import untrusted_meshes
from mitsplat.mesh_files.mesh_reading import read_mesh
from mitsplat.scene.loading.scene_loading import load_scene
from tests.cli.typed import run
from tests.conftest import box_asset
from tests.engine.jobs import Dies

pytestmark = pytest.mark.usefixtures("files_tried")


class TestScenes:
    @pytest.mark.parametrize(
        "name", ["../elsewhere", "{folder}", "assets/link", "assets/../../elsewhere", "assets/loop"]
    )
    @pytest.mark.parametrize("key", ["environment", "objects", "shapes", "lights"])
    def test_files_outside_of_the_scene_folder_are_refused(self, scene_data, write_scene, tmp_path, name, key):
        elsewhere = tmp_path.with_name(f"{tmp_path.name}-elsewhere")
        box_asset("nut").save(elsewhere)
        path = write_scene(scene_data)
        name = name.replace("../elsewhere", f"../{elsewhere.name}").replace("{folder}", str(elsewhere))
        (tmp_path / "assets/link").symlink_to(elsewhere)
        (tmp_path / "assets/loop").symlink_to(tmp_path / "assets/loop")
        if key == "objects":
            scene_data["objects"] = [{"asset": name}]
        elif key == "shapes":
            scene_data["shapes"] = [{"name": "a", "mesh": name}]
        elif key == "lights":
            scene_data["lights"] = [{"kind": "environment", "image": name}]
        else:
            scene_data["environment"] = name
        path = write_scene(scene_data)
        place = {"objects": r"objects\[0\]\.asset", "shapes": r"shapes\[0\]\.mesh", "lights": r"lights\[0\]\.image"}
        with pytest.raises(
            InputError, match=rf"scene\.yaml:\d+: {place.get(key, key)}: must be inside the scene's folder"
        ):
            load_scene(path)
        if key == "objects" and "loop" not in name:
            assert load_scene(path, allow_outside=True).assets[0].name == "nut"

    def test_files_outside_of_the_asset_folder_are_refused(self, tmp_path):
        box_asset("nut").save(tmp_path / "nut")
        (tmp_path / "secret.ply").write_bytes((tmp_path / "nut/splats.ply").read_bytes())
        text = (tmp_path / "nut/asset.yaml").read_text()
        (tmp_path / "nut/asset.yaml").write_text(text.replace("splats.ply", "../secret.ply"))
        with pytest.raises(InputError, match=r"asset\.yaml:\d+: splats: must be a file inside .*nut \(got \.\./secret"):
            Asset.load(tmp_path / "nut")

    @pytest.mark.parametrize("opening", ["[", "{", "[ ", "- "])
    def test_deep_nesting_is_refused_in_bounded_time(self, tmp_path, opening):
        """ruamel.yaml would take time quadratic in the depth, 6 s for 2,000 brackets."""
        path = tmp_path / "scene.yaml"
        path.write_text(opening * 2000)
        begun = time.process_time()
        with pytest.raises(InputError, match="must not nest deeper than 32 levels"):
            load_scene(path)
        assert time.process_time() - begun < 1

    @pytest.mark.parametrize("key", ["asset", "pool"])
    def test_long_names_are_refused_in_bounded_time(self, scene_data, write_scene, key):
        """Resolving long names would take time quadratic in the length."""
        scene_data["objects"] = [{key: "*/" * 200_000}]
        path = write_scene(scene_data)
        begun = time.process_time()
        with pytest.raises(InputError, match="must be inside the scene's folder") as raised:
            load_scene(path)
        assert time.process_time() - begun < 5 and len(str(raised.value)) < 1000

    def test_aliases_that_multiply_are_refused(self, tmp_path):
        """The attack is "billion laughs": ten levels of ten aliases each."""
        levels = ["a0: &a0 [x]\n"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)]
        (tmp_path / "scene.yaml").write_text("".join(levels))
        with pytest.raises(InputError, match=r"scene\.yaml: must not hold more than 200000 values"):
            load_scene(tmp_path / "scene.yaml")

    @pytest.mark.parametrize(
        "text", ["name: !!python/object/apply:os.system ['touch pwned']", "name: !!python/name:os"]
    )
    def test_yaml_tags_run_no_code(self, tmp_path, text, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "scene.yaml").write_text(text)
        with pytest.raises(InputError, match="must not have a YAML tag"):
            load_scene(tmp_path / "scene.yaml")
        assert not (tmp_path / "pwned").exists()

    def test_a_named_pipe_is_refused(self, tmp_path):
        """Opening a named pipe would block for ever."""
        for name in ("scene.yaml", "a.ply", "a.xml"):
            os.mkfifo(tmp_path / name)
        for read in (lambda: load_scene(tmp_path / "scene.yaml"), lambda: Splats.load(tmp_path / "a.ply"),
                     lambda: check_xml(tmp_path / "a.xml")):  # fmt: skip
            with pytest.raises(InputError, match="must be a file"):
                read()


XML = '<scene version="3.9.0">{}</scene>'


class TestXml:
    @pytest.fixture
    def scene(self, tmp_path):
        (tmp_path / "in").mkdir()
        (tmp_path / "in/mesh.ply").write_text("")
        (tmp_path / "secret.xml").write_text(XML.format(""))
        (tmp_path / "in/link.xml").symlink_to(tmp_path / "secret.xml")
        os.mkfifo(tmp_path / "in/pipe")
        return tmp_path / "in/scene.xml"

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (
                '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>' + XML.format("&b;"),
                "must not have a document type",
            ),
            (
                '<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;">]>' + XML.format("&c;"),
                "must not have a document type",
            ),
            (XML.format('<include filename="../secret.xml"/>'), "include must be inside the scene's folder"),
            (XML.format('<include filename="link.xml"/>'), "include must be inside the scene's folder"),
            (XML.format('<include filename="/etc/passwd"/>'), "include must be inside the scene's folder"),
            (XML.format('<include filename="$file"/>'), "undefined parameter: .file"),
            (XML.format('<path value=".."/>'), "path must be inside the scene's folder"),
            (
                XML.format('<shape type="ply"><string name="filename" value="../secret.xml"/></shape>'),
                "must not name a file",
            ),
            (XML.format('<shape type="x"><string name="other" value="/etc/passwd"/></shape>'), "must not name a file"),
            (
                XML.format('<default name="f" value="/etc/passwd"/><string name="a" value="$f"/>'),
                "must not name a file",
            ),
            (
                XML.format('<default name="f" value="/etc"/><string name="a" value="$f/passwd"/>'),
                "(put together|name a file)",
            ),
            (
                XML.format('<default name="d" value=".."/><string name="a" value="$d/secret.xml"/>'),
                "(put together|name a file)",
            ),
            (XML.format('<string name="a" value="$elsewhere/secret.xml"/>'), "undefined parameter: .elsewhere"),
            (XML.format('<include filename="scene.xml"/>'), "must not include files on more than 15 levels"),
            (XML.format('<shape type="../evil"/>'), "type must be the name of a plugin"),
            (
                XML.format('<bsdf type="conductor"><string name="material" value="../x"/></bsdf>'),
                "must not name a file",
            ),
            (XML.format('<shape type="ply"><string name="filename" value="pipe"/></shape>'), "must name a file or"),
            (XML.format('<default name="a" value="b"><include filename="c"/></default>'), "<default> must hold no"),
            (XML.format('<shape type="a"><path value="."/></shape>'), "path must be directly in the first element"),
            (XML.format('<path value="no"/>'), "path: no such folder"),
            (XML.format('<include filename="no.xml"/>'), "include: no such file"),
            (XML.format('<default name="a"/>'), 'missing required attribute "value" in <default>'),
            ('<include version="3.9.0" filename="link.xml"/>', "must begin with <scene>"),
            (XML.format('<spectrum name="a" filename="../secret.xml"/>'), "spectrum must be inside"),
            (XML.format('<rgb name="a" value="../secret.xml"/>'), "must not name a file"),
            (XML.format("<a>" * 100 + "</a>" * 100), "must not nest deeper than 64"),
            (XML.format("<a>"), "not XML"),
            ("", "not XML"),
        ],
    )
    def test_hostile_xml_is_refused(self, scene, text, message):
        scene.write_text(text)
        with pytest.raises(InputError, match=rf"scene\.xml:\d+: .*{message}"):
            check_xml(scene)

    def test_included_files_are_checked(self, scene):
        scene.write_text(XML.format('<include filename="b.xml"/>'))
        (scene.parent / "b.xml").write_text(XML.format('<string name="filename" value="mesh.ply"/>'))
        check_xml(scene)
        (scene.parent / "b.xml").write_text(XML.format('<include filename="../secret.xml"/>'))
        with pytest.raises(InputError, match=r"b\.xml:1: include must be inside"):
            check_xml(scene)
        check_xml(scene, allow_outside=True)

    def test_includes_that_multiply_are_refused(self, scene):
        for number in range(10):
            (scene.parent / f"{number}.xml").write_text(XML.format(f'<include filename="{number + 1}.xml"/>' * 2))
        (scene.parent / "10.xml").write_text(XML.format(""))
        scene.write_text(XML.format('<include filename="0.xml"/>'))
        with pytest.raises(InputError, match=r"scene\.xml: must not include more than 100 files"):
            check_xml(scene)

    def test_parameters_that_multiply_are_refused(self, scene):
        levels = ['<default name="a0" value="xxxxxxxxxx"/>']
        levels += [f'<default name="a{i}" value="{f"$a{i - 1}" * 10}"/>' for i in range(1, 10)]
        scene.write_text(XML.format("\n".join(levels)))
        with pytest.raises(InputError, match=r"scene\.xml:7: text must not be longer than 1048576 characters"):
            check_xml(scene)

    def test_a_relative_scene_is_confined_to_its_folder(self, scene, monkeypatch):
        monkeypatch.chdir(scene.parents[1])
        scene.write_text(XML.format('<shape type="ply"><string name="filename" value="../secret.xml"/></shape>'))
        with pytest.raises(InputError, match=r"in/scene\.xml:1: must not name a file outside of the scene's folder"):
            check_xml(scene.relative_to(scene.parents[1]))

    @pytest.mark.parametrize(
        "text",
        [
            '<path value="sub/deep"/> <shape type="ply"><string name="filename" value="../../../secret.xml"/></shape>',
            '<path value="sub"/> <shape type="ply"><string name="filename" value="ok.ply"/></shape>',
            '<shape type="ply"><string name="filename" value="ok.ply"/></shape> <path value="sub"/>',
            '<shape type="a"><bsdf type="b"><string name="filename" value="../secret.xml"/></bsdf></shape>',
            '<path value="sub"/> <spectrum name="a" filename="ok.ply"/>',
            '<default name="d" value="../.."/><path value="sub"/><include filename="$d/secret.xml"/>',
        ],
    )
    def test_search_paths_outside_of_the_scene_folder_are_refused(self, scene, text):
        (scene.parent / "sub/deep").mkdir(parents=True)
        (scene.parent / "sub/ok.ply").symlink_to(scene.parents[1] / "secret.xml")
        scene.write_text(XML.format(text))
        with pytest.raises(InputError, match=r"scene\.xml:1: .*(outside of|inside) the scene's folder"):
            check_xml(scene)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ('<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]>' + XML.format("&b;"), "must not have a document type"),
            (XML.format('<include filename="../../secret.xml"/>'), "include must be inside"),
            (XML.format('<shape type="ply"><string name="filename" value="{}"/></shape>'), "must not name a file"),
        ],
    )
    def test_files_included_by_a_search_path_are_checked(self, scene, text, message):
        (scene.parent / "sub").mkdir()
        (scene.parent / "sub/inner.xml").write_text(text.replace("{}", str(scene.parents[1] / "secret.xml")))
        scene.write_text(XML.format('<path value="sub"/>\n<include filename="inner.xml"/>'))
        with pytest.raises(InputError, match=rf"sub/inner\.xml:1: {message}"):
            check_xml(scene)

    def test_mitsuba_gets_absolute_paths_without_links(self, scene):
        """A link that changes after the check does not change the files that are read."""
        (scene.parent / "sub").mkdir()
        (scene.parent / "sub/good.ply").write_text("")
        (scene.parent / "ok.ply").symlink_to("sub/good.ply")
        scene.write_text(XML.format('\n<shape type="ply"><string name="filename" value="ok.ply"/></shape>'))
        (text,) = check_xml(scene).texts
        assert text.splitlines()[1].startswith('<shape type="ply"><string name="filename" value=')
        assert f'"{(scene.parent / "sub/good.ply").resolve()}"' in text and "ok.ply" not in text

    def test_xml_is_checked_before_mitsuba_reads_it(self, scene, capsys, monkeypatch):
        monkeypatch.setattr(xml_scene, "run_in_process", None)
        scene.write_text('<!DOCTYPE a><scene version="3.9.0"/>')
        with pytest.raises(InputError, match="must not have a document type"):
            xml_scene.render_xml(scene, scene.parent / "out.png")

    def test_a_crash_of_mitsuba_is_reported_in_one_sentence(self, scene, capsys, monkeypatch):
        """A killed process stands in for a crash of a native reader. Tests of the engine repeat lost frames."""
        monkeypatch.setattr(scheduler, "MAX_LOSSES", 1)
        monkeypatch.setattr(xml_scene, "_RenderOne", Dies)
        assert run("render", scene) == 2
        assert "scene.xml: Mitsuba's process ended at a file that the scene names" in capsys.readouterr().err


class TestImages:
    """Images of environment lights, which Mitsuba first reads in a process of its own."""

    @pytest.fixture
    def scene(self, scene_data, write_scene, tmp_path):
        import mitsuba as mi
        import numpy as np

        mi.set_variant("llvm_ad_rgb")
        mi.Bitmap(np.ones((8, 16, 3), np.float32)).write(str(tmp_path / "sky.exr"))
        scene_data["lights"] = [{"kind": "environment", "image": "sky.exr"}]
        return write_scene(scene_data)

    def test_a_valid_image_of_a_light_is_accepted(self, scene):
        assert [path.name for path in load_scene(scene).images.values()] == ["sky.exr"]

    @pytest.mark.parametrize(
        "damage", [lambda data: data[:200], lambda data: b"", lambda data: data.replace(b"channels", b"chan")]
    )
    def test_a_damaged_image_of_a_light_is_refused(self, scene, tmp_path, damage):
        path = tmp_path / "sky.exr"
        path.write_bytes(damage(path.read_bytes()))
        with pytest.raises(
            InputError, match=r"scene\.yaml:\d+: lights\[0\]\.image: .*sky\.exr: not a readable image \("
        ) as caught:
            load_scene(scene)
        assert "\n" not in str(caught.value)

    def test_an_image_header_that_states_too_many_pixels_is_refused(self, scene, tmp_path):
        """The EXR has a data window of 2^30 pixels in width and 2^20 in height."""
        path = tmp_path / "sky.exr"
        data = path.read_bytes()
        window = struct.pack("<iiii", 0, 0, 15, 7)
        assert data.count(window) >= 1
        path.write_bytes(data.replace(window, struct.pack("<iiii", 0, 0, (1 << 30) - 1, (1 << 20) - 1)))
        with pytest.raises(InputError, match="not a readable image"):
            load_scene(scene)


class TestArchives:
    """Compressed files that expand on reading. This process's peak memory shows that nothing was allocated."""

    @pytest.fixture(autouse=True)
    def peak(self):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        yield
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300e3

    def test_an_spz_bomb_is_refused(self, tmp_path):
        with gzip.open(tmp_path / "a.spz", "wb") as file:
            for _ in range(100):
                file.write(bytes(1 << 20))
        with pytest.raises(
            InputError, match=r"a\.spz: \d+ compressed bytes must not decompress to more than \d+ bytes \(got more\)"
        ):
            Splats.load(tmp_path / "a.spz")

    @pytest.mark.parametrize("name", ["../a", "/etc/a", "x/../../a", "..\\a"])
    def test_a_sog_path_outside_of_the_archive_is_refused(self, tmp_path, name):
        with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
            archive.writestr(name, b"x")
        with pytest.raises(InputError, match=r"a\.sog: an archive must not hold files outside of it"):
            Splats.load(tmp_path / "a.sog")

    def test_a_damaged_sog_entry_is_refused(self, tmp_path):
        with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
            archive.writestr("meta.json", "{ meant }")
        data = (tmp_path / "a.sog").read_bytes()
        (tmp_path / "a.sog").write_bytes(data.replace(b"meant", b"other"))
        with pytest.raises(InputError, match=r"a\.sog: not a valid sog file \(meta\.json in it is damaged\)"):
            Splats.load(tmp_path / "a.sog")

    def test_a_sog_bomb_is_refused(self, tmp_path):
        with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("meta.json", bytes(64 << 20))
        with pytest.raises(
            InputError, match=r"a\.sog: \d+ compressed bytes must not decompress to more than \d+ in 64 files"
        ):
            Splats.load(tmp_path / "a.sog")

    def test_invalid_archives_are_refused(self, tmp_path):
        for name, data in (("a.sog", b"PK\3\4rubbish"), ("a.spz", b"\x1f\x8b rubbish")):
            (tmp_path / name).write_bytes(data)
            with pytest.raises(InputError, match=rf"{name}: not a valid"):
                Splats.load(tmp_path / name)

    def test_a_header_that_states_billions_of_gaussians_is_refused(self, tmp_path):
        box_asset("nut").splats.save(tmp_path / "a.ply")
        data = (tmp_path / "a.ply").read_bytes()
        (tmp_path / "a.ply").write_bytes(data.replace(b"vertex 12\n", b"vertex 99999999999\n"))
        with pytest.raises(InputError, match="the PLY header states 99999999999 Gaussians"):
            Splats.load(tmp_path / "a.ply")


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    return Samples(tmp_path_factory.mktemp("samples"))


class TestAttacks:
    """A few attacks of ``python -m benchmarks.scale.attack``, and the detection of successful attacks."""

    @pytest.fixture
    def place(self, samples, tmp_path):
        return Place.make(tmp_path / "place", samples, SECRET_COLOUR, SECRET_WORD)

    @pytest.mark.parametrize(
        "name",
        [
            "splats: SPZ bomb",
            "yaml: aliases that multiply",
            pytest.param("exr: panorama, deep", marks=pytest.mark.extended),
            pytest.param("xml: absolute path", marks=pytest.mark.extended),
        ],
    )
    def test_a_known_attack_has_no_effect(self, place, name):
        (attack,) = (attack for attack in all_attacks() if attack.name == name)
        assert judge(attack, place).faults == ()

    def test_attack_names_are_unique(self):
        names = [attack.name for attack in all_attacks()]
        assert len(set(names)) == len(names)

    @pytest.mark.parametrize(
        ("script", "fault"),
        [
            ("true", None),
            ("echo 'mitsplat: a.ply: not a PLY file' >&2; exit 2", None),
            ("exit 2", "does not end in a sentence"),
            ("exit 70", "exits with status 70"),
            ("kill -SEGV $$", "exits with status -11"),
            ("echo 'Traceback (most recent call last):' >&2", "prints a traceback"),
            ("touch {outside}/made", "outside/made was changed"),
            ("echo > {outside}/folder/keep.txt", "outside/folder/keep.txt was changed"),
            ("rm {outside}/secret.jpg", "outside/secret.jpg was changed"),
            ("cat {outside}/secret.txt", "prints text of a file outside"),
            ("cp {outside}/secret.png made.png", "made.png shows what lies outside"),
            ("cat {outside}/secret.yaml > made.txt", "made.txt shows what lies outside"),
            ("echo >> kept", "kept was changed"),
            ("n=ma; touch ${n}de", "made was made, which no command names"),
            ("touch made", None),
            ("sleep 60", "did not end within"),
            ("sleep 60 & exit 0", "leaves 1 processes"),
            ("{python} -c 'a = bytearray(80 << 20); a[::4096] = a[::4096]; input()' < pipe", "takes more than 60 MiB"),
        ],
    )
    def test_each_effect_of_an_attack_is_a_fault(self, place, script, fault):
        def build(place):
            place.write("kept", "a")
            os.mkfifo(place.inside / "pipe")

        command = ("sh", "-c", script.replace("{python}", sys.executable).replace("< pipe", "<> pipe"))
        seconds = 0.5 if fault == "did not end within" else 5
        attack = Attack("a", "b", build, [command], seconds=seconds, mebibytes=60, keep=("kept",))
        faults = judge(attack, place).faults
        assert (fault is None and faults == ()) or any(fault in found for found in faults), faults


class TestMeshes:
    """Meshes that expand on reading. This process's peak memory shows that they were not read here."""

    @pytest.fixture(autouse=True)
    def peak(self):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        yield
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300e3

    @pytest.mark.parametrize("name", ["m.zip", "m.ZIP", "m.tar.gz", "m.bz2"])
    def test_archives_are_refused_as_meshes(self, scene_data, write_scene, tmp_path, name):
        (tmp_path / name).write_bytes(b"PK")
        scene_data["shapes"] = [{"name": "a", "mesh": name}]
        with pytest.raises(
            InputError, match=r"scene\.yaml:\d+: shapes\[0\]\.mesh: .* must be a mesh file, not an archive"
        ):
            load_scene(write_scene(scene_data))
        with pytest.raises(InputError, match="must be a mesh file, not an archive"):
            read_model(tmp_path / name)

    @pytest.mark.parametrize("read", [read_mesh, read_model])
    def test_a_count_of_vertices_without_data_is_refused(self, tmp_path, read):
        """The file states positions of 10^10 vertices without a buffer. By the glTF specification these are zeros."""
        accessor = {"componentType": 5126, "count": 10**10, "type": "VEC3"}
        mesh = {"primitives": [{"attributes": {"POSITION": 0}}]}
        document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        empty, path = {"buffers": [], "bufferViews": []}, tmp_path / "a.gltf"
        path.write_text(json.dumps({**document, "meshes": [mesh], "accessors": [accessor], **empty}))
        with pytest.raises(
            InputError, match=r"a\.gltf: not a mesh file that can be read \(reading it takes more memory"
        ):
            read(path)

    def test_a_3mf_bomb_is_refused(self, tmp_path):
        path = tmp_path / "a.3mf"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("3D/3dmodel.model", "w") as file:
            file.write(b"<model><resources><object id='1'><mesh><vertices>")
            for _ in range(100):
                file.write(b"<vertex x='0' y='0' z='0'/>" * 40000)
            file.write(b"</vertices></mesh></object></resources></model>")
        with pytest.raises(InputError, match=r"a\.3mf: not a mesh that can be read \(.* a factor of more than 100"):
            read_mesh(path)

    def test_a_gltf_buffer_outside_of_the_folder_is_not_read(self, tmp_path):
        (tmp_path / "in").mkdir()
        files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box()))
        for name, data in files.items():
            (tmp_path / "in" / name.replace("model.gltf", "a.gltf")).write_bytes(data)
        buffers = [name for name in files if name != "model.gltf"]
        read_mesh(tmp_path / "in/a.gltf")
        for name in buffers:
            (tmp_path / "in" / name).rename(tmp_path / f"outside_{name}")
        text = (tmp_path / "in/a.gltf").read_text()
        for uri in ("../outside_", f"{tmp_path}/outside_"):
            changed = text
            for name in buffers:
                changed = changed.replace(name, uri + name)
            (tmp_path / "in/a.gltf").write_text(changed)
            with pytest.raises(InputError, match="is outside of its folder"):
                read_mesh(tmp_path / "in/a.gltf")

    @pytest.mark.parametrize("name", ["a.stl", "a.obj", "a.glb"])
    def test_a_mesh_file_of_gigabytes_is_not_read(self, tmp_path, name):
        size = 84 + 50 * (1 << 25)
        (tmp_path / name).write_bytes(bytes(80) + struct.pack("<I", 1 << 25))
        os.truncate(tmp_path / name, size)
        with pytest.raises(
            InputError, match=rf"{name}: must be a mesh file of at most 1073741824 bytes \(got {size}\)"
        ):
            read_mesh(tmp_path / name)

    def test_plain_triangles_are_read_without_a_child_process(self, tmp_path, monkeypatch):
        monkeypatch.setattr(untrusted_meshes, "run_bounded", None)
        box = trimesh.creation.box()
        for name in ("a.ply", "a.stl"):
            box.export(tmp_path / name)
            assert len(read_mesh(tmp_path / name).faces) == 12
        (tmp_path / "a.stl").write_bytes((tmp_path / "a.stl").read_bytes() + b"x")
        with pytest.raises(TypeError):
            read_mesh(tmp_path / "a.stl")
