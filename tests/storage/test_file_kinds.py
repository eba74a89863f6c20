"""Files of another kind than a command reads: all commands name the kind with the same words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from mitsplat.capture.video.decoding import open_video
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gltf_splats.splat_reading import read_gltf_splats
from mitsplat.mesh_files.mesh_reading import read_mesh_file
from mitsplat.scene.loading.scene_loading import load_scene


def read_video(path: Path) -> None:
    with open_video(path):
        pass


READERS: tuple[Callable[[Path], object], ...] = (load_scene, read_mesh_file, Splats.load, read_video)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.fbx", "a file of a 3D program; export it as .glb"),
        ("a.blend", "a file of a 3D program; export it as .glb"),
        ("a.usdz", "a USD stage; `mitsplat import` reads its splats"),
        ("a.ckpt", "a checkpoint of a training; export its splats as .ply"),
        ("a.7z", "an archive; unpack it"),
        ("a.jpg", "an image"),
    ],
)
@pytest.mark.parametrize("read", READERS)
def test_the_kind_of_a_file_is_named_alike(
    tmp_path: Path, name: str, kind: str, read: Callable[[Path], object]
) -> None:
    (tmp_path / name).write_bytes(b"content")
    with pytest.raises(InputError) as error:
        read(tmp_path / name)
    assert str(error.value).startswith(f"{tmp_path / name}: ") and kind in str(error.value)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"<!DOCTYPE html><html>", "is a web page in place of the file: the download failed"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a Git LFS pointer in place of the file"),
        (b"", "the file is empty"),
    ],
)
@pytest.mark.parametrize(
    ("read", "name"),
    [
        (load_scene, "a.yaml"),
        (read_mesh_file, "a.glb"),
        (read_mesh_file, "a.stl"),
        (read_gltf_splats, "a.glb"),
        (Splats.load, "a.ply"),
        (Splats.load, "a.spz"),
    ],
)
def test_failed_downloads_are_named_alike(
    tmp_path: Path, content: bytes, sentence: str, read: Callable[[Path], object], name: str
) -> None:
    if not content and name == "a.yaml":
        sentence = "must be a mapping of keys to values (got nothing)"
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as error:
        read(tmp_path / name)
    assert str(error.value).startswith(f"{tmp_path / name}: {sentence}")


def test_a_mesh_in_place_of_splats_has_a_remedy(tmp_path: Path) -> None:
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    text = f"ply\nformat ascii 1.0\nelement vertex 3\n{names}{faces}end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(InputError, match=r"\(missing\): it is a mesh, which `mitsplat bake` reads"):
        Splats.load(tmp_path / "a.ply")
