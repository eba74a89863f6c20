"""Rays dropped by a GPU: detection in the kernels' code on any machine, and errors on Dr.Jit's warning."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from mitsplat.renderer.occluders.proxies import Proxies
from mitsplat.runtime.dropped_rays import DROPPED_RAYS, check_dropped_rays, record_dropped_rays
from mitsplat.runtime.variant import ensure_variant
from tests.gpu.cases import CASES
from tests.kernels import traced_scenes

TEXTS = [
    "jit_eval(): more than one OptiX pipeline was used within a single kernel, which is not supported. Please split "
    "your kernel into smaller parts (e.g. using `dr::eval()`). Disabling this ray tracing operation to avoid "
    "potential undefined behavior.",
    "jit_eval(): more than one OptiX shader binding table was used within a single kernel, which is not supported. "
    "Please split your kernel into smaller parts (e.g. using `dr::eval()`). Disabling this ray tracing operation to "
    "avoid potential undefined behavior.",
]
"""Messages of the library of Dr.Jit 1.5."""

LIBRARY = Path(dr.__file__).with_name("libdrjit-core.so")


@pytest.fixture(params=[ctypes.CDLL, ctypes.PyDLL])
def log(request):
    """Yield Dr.Jit's own log function, without and with Python's lock, while the callback is installed."""
    function = request.param(str(LIBRARY))["_Z7jit_log8LogLevelPKcz"]
    function.argtypes, function.restype = (ctypes.c_uint32, ctypes.c_char_p), None
    level = dr.log_level()
    record_dropped_rays()
    yield lambda text: function(dr.LogLevel.Warn.value, text.encode())
    dr.set_log_level(level)


@pytest.mark.parametrize("text", TEXTS)
def test_dropped_rays_are_an_error_once(log, text, capfd):
    log(text)
    log(text)
    with pytest.raises(RuntimeError, match=r"dropped rays \(2 times\): jit_eval\(\): more than one OptiX"):
        check_dropped_rays()
    check_dropped_rays()
    assert capfd.readouterr() == ("", "")


def test_other_messages_are_printed(log, capfd):
    log("something else")
    check_dropped_rays()
    assert "something else" in capfd.readouterr().err


def test_the_library_has_the_message_of_dropped_rays():
    """Detects a release of Dr.Jit with another message, which would otherwise go unnoticed."""
    library = LIBRARY.read_bytes()
    for text in TEXTS:
        assert DROPPED_RAYS in text.encode()
        assert text.encode() in library


def test_a_process_ends_with_the_callback_in_place():
    code = "import mitsuba as m; from mitsplat.runtime import dropped_rays as d; "
    code += "m.set_variant('llvm_ad_rgb'); d.record_dropped_rays(); m.Float(1)"
    done = subprocess.run([sys.executable, "-c", code], env=os.environ, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.cpu(reason="reads kernels in LLVM's language")
class TestKernels:
    @pytest.mark.parametrize("case", CASES)
    def test_every_kernel_traces_one_scene(self, monkeypatch, case):
        """Kernels are split as on CUDA."""
        build = Proxies.__init__

        def apart(self, *args):
            build(self, *args)
            self.separate_kernels = True

        monkeypatch.setattr(Proxies, "__init__", apart)
        with traced_scenes() as numbers:
            CASES[case]()
        assert max(numbers) == (0 if "gradients" in case or case == "silhouettes of splats" else 1)

    def test_two_scenes_are_counted(self):
        ensure_variant()
        scenes = [mi.load_dict({"type": "scene", "shape": {"type": kind}}) for kind in ("sphere", "cube")]
        ray = mi.Ray3f(mi.Point3f(dr.arange(mi.Float, 8), 0, -5), mi.Vector3f(0, 0, 1))
        with traced_scenes() as numbers:
            dr.eval(scenes[0].ray_test(ray) | scenes[1].ray_intersect_preliminary(ray).is_valid())
            dr.eval(scenes[0].ray_test(ray) | scenes[0].ray_test(mi.Ray3f(ray.o + 0.1, ray.d)))
        assert numbers == [2, 1]
