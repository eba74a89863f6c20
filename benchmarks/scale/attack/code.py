"""Python files beside the input, in the current folder of the command, which must not be executed."""

from __future__ import annotations

import sys

from benchmarks.scale.attack.attack import ANY, FINE, REFUSED, Attack
from benchmarks.scale.attack.images import png_sky
from benchmarks.scale.attack.poses import colmap_capture
from benchmarks.scale.attack.samples import Place

_HOSTILE = """import os
try:
    os.close(os.open({witness!r} + __name__, os.O_CREAT))
except OSError:
    pass
raise ImportError("hostile")
"""
_LIBRARIES = (
    "mitsplat",
    "mitsuba",
    "drjit",
    "numpy",
    "cv2",
    "PIL",
    "trimesh",
    "pycolmap",
    "gaussforge",
    "warp",
    "newton",
)
_STARTUP = ("sitecustomize", "usercustomize")


def hostile_modules(place: Place) -> None:
    """Write modules that each write a file on import.

    Their names are those of the standard library, of libraries and of Python's start.
    """
    text = _HOSTILE.format(witness=f"{place.outside}/executed-")
    for name in (*sys.stdlib_module_names, *_LIBRARIES, *_STARTUP):
        place.write(f"{name}.py", text)
    for name in ("xml", "json", "multiprocessing", "importlib", "concurrent"):
        place.write(f"{name}/__init__.py", text)


def _scene(place: Place) -> None:
    hostile_modules(place)
    place.scene()


def _lit_by_image(place: Place) -> None:
    hostile_modules(place)
    png_sky(place.inside / "sky.png")
    place.scene(lights="[{kind: environment, image: sky.png}]")


def _textured(place: Place) -> None:
    hostile_modules(place)
    place.take("mesh.stl")
    place.scene(shapes="[{name: a, mesh: mesh.stl, visible: true}]")


def _xml(place: Place) -> None:
    hostile_modules(place)
    place.write(
        "a.xml",
        '<scene version="3.9.0"><integrator type="direct"/><sensor type="perspective"><film type="hdrfilm">'
        '<integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>'
        '<emitter type="constant"/></scene>',
    )


def _video(place: Place) -> None:
    hostile_modules(place)
    place.take("walk.avi")


def _colmap(place: Place) -> None:
    hostile_modules(place)
    colmap_capture(place)


def _splats(name: str) -> Attack:
    def build(place: Place) -> None:
        hostile_modules(place)
        place.take("nut")
        place.take(name, into="nut")
        description = place.inside / "nut/asset.yaml"
        description.write_text(description.read_text().replace("splats.ply", name))

    return Attack(
        f"code: check of an asset of {name}",
        "run Python files of the current folder in the decoder's process",
        build,
        [["mitsplat", "check", "nut"]],
        frozenset({0, 1}),
    )


def _dataset(place: Place) -> None:
    place.take_dataset()
    hostile_modules(place)


def _configuration(place: Place) -> None:
    """Write configuration files that libraries read from the current folder."""
    place.write("matplotlibrc", "backend: module://hostile\n")
    place.write("hostile.py", _HOSTILE.format(witness=f"{place.outside}/executed-"))
    for name in (".env", "pyvenv.cfg", "setup.cfg", "pyproject.toml", "python311._pth"):
        place.write(name, "import hostile\n")
    place.scene()


ATTACKS = (
    Attack(
        "code: render with two workers",
        "run Python files of the current folder in worker processes",
        _scene,
        [["mitsplat", "render", "scene.yaml", "-o", "made", "--workers", "2"]],
        FINE,
        seconds=120,
        mebibytes=4000,
        quick=False,
    ),
    Attack(
        "code: check of a scene lit by an image",
        "run Python files of the current folder where images are tried",
        _lit_by_image,
        [["mitsplat", "check", "scene.yaml"]],
        ANY,
        quick=False,
    ),
    Attack(
        "code: check of a scene with a mesh",
        "run Python files of the current folder where meshes are read",
        _textured,
        [["mitsplat", "check", "scene.yaml"]],
        ANY,
        quick=False,
    ),
    Attack(
        "code: mesh is baked",
        "run Python files of the current folder where meshes are read",
        _textured,
        [["mitsplat", "bake", "mesh.stl", "-o", "made", "--gaussians", "500"]],
        ANY,
        quick=False,
    ),
    Attack(
        "code: render of a Mitsuba scene",
        "run Python files of the current folder in Mitsuba's process",
        _xml,
        [["mitsplat", "render", "a.xml", "-o", "made.png"]],
        FINE,
    ),
    Attack(
        "code: doctor",
        "run Python files of the current folder in the trial's process",
        hostile_modules,
        [["mitsplat", "doctor"]],
        frozenset({0, 1}),
    ),
    Attack(
        "code: capture of a video",
        "run Python files of the current folder in the process that decodes",
        _video,
        [["mitsplat", "capture", "walk.avi", "-o", "made"]],
        ANY,
    ),
    Attack(
        "code: capture with a COLMAP model",
        "run Python files of the current folder in COLMAP's process",
        _colmap,
        [["mitsplat", "capture", "photos", "-o", "made", "--poses", "model"]],
        ANY,
    ),
    Attack(
        "code: audit",
        "run Python files of the current folder in the audit's processes",
        _dataset,
        [["mitsplat", "audit", "dataset"]],
        FINE,
        quick=False,
    ),
    Attack(
        "code: report",
        "run Python files of the current folder in the report's processes",
        _dataset,
        [["mitsplat", "report", "dataset"]],
        FINE,
        quick=False,
    ),
    _splats("a.spz"),
    _splats("a.sog"),
    _splats("a.ksplat"),
    Attack(
        "code: configuration of libraries",
        "run a module that a configuration file in the current folder names",
        _configuration,
        [["mitsplat", "chart", "scene.yaml", "-n", "1", "-o", "made"]],
        ANY,
        seconds=240,
        quick=False,
    ),
    Attack(
        "code: YAML tags",
        "run a function that a tag of a scene file names",
        lambda place: place.write("scene.yaml", f"name: !!python/object/apply:os.mkdir ['{place.outside}/made']\n"),
        [["mitsplat", "check", "scene.yaml"]],
        REFUSED,
    ),
    Attack(
        "code: pickled depth map",
        "run a function that an array file names",
        lambda place: (
            place.write(
                "depths/a.npy",
                b"\x93NUMPY\x01\x00\x46\x00{'descr': '|O', 'fortran_order': False, 'shape': (1,), }          \n"
                b"cos\nmkdir\n(S'made'\ntR.",
            )
            and _capture_folder(place)
        ),
        [["mitsplat", "fit", "capture", "-o", "made", "--depths", "depths", "--iterations", "1"]],
        REFUSED,
    ),
)


def _capture_folder(place: Place) -> None:
    from benchmarks.scale.attack.poses import capture_folder

    capture_folder(place)
