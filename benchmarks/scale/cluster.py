"""Ray cluster of machines without shared files, one killed and one added during the run: same bytes, no lost frame.

    python -m benchmarks.scale.cluster [--frames 40] [--views 5]

Every machine is a set of namespaces on this one (``unshare``, which needs root) with its own processes, home, cache and
Ray folder, and an empty ``/tmp``, so that it cannot open the scene, the dataset or the caller's caches in ``/tmp``. Two
machines exist from the start. After a quarter of the run one is killed (SIGKILL to the first process of its namespace);
after half of it a third joins. The result is compared with a run of this process alone, byte by byte.
"""

from __future__ import annotations

import argparse
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from benchmarks.record import figure, recording
from benchmarks.scale.faults import ROOT, SCENE, hashes

LIGHTS = """
lights:
  - {kind: area, position: [0.5, 0, 1]}
  - {kind: environment, image: sky.png}
"""
MACHINE = """
set -e
mount -t tmpfs tmpfs /tmp
mkdir -p {home}/.cache
cp -r ~/.drjit {home}/ || true
cp -r ~/.cache/warp {home}/.cache/ || true
for path in {hidden}; do test ! -e $path; done
export HOME={home} XDG_CACHE_HOME={home}/.cache RAY_TMPDIR=/tmp/ray_{name} TMPDIR=/tmp
unset WARP_CACHE_PATH
exec {ray} start --address {address} --num-cpus 1 --resources '{{"machine": 1}}' --block --disable-usage-stats \
    --object-store-memory 200000000 --dashboard-agent-listen-port 0 --min-worker-port 0 --max-worker-port 0
"""
"""Starts Ray in its own namespaces. Compiled kernels are copied, as on a machine that has rendered before."""


def free_port() -> int:
    """Return a free port."""
    with socket.socket() as opened:
        opened.bind(("127.0.0.1", 0))
        return int(opened.getsockname()[1])


class Machines:
    """Machines of a cluster."""

    def __init__(self, address: str, folder: Path) -> None:
        self.address, self.folder = address, folder
        self.started: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start another machine."""
        name = f"machine{len(self.started) + 1}"
        ray = Path(sys.executable).parent / "ray"
        script = MACHINE.format(home=f"/tmp/home_{name}", name=name, hidden=self.folder, ray=ray, address=self.address)
        command = ["unshare", "--mount", "--pid", "--fork", "--mount-proc", "--kill-child", "sh", "-c", script]
        with (self.folder / f"{name}.log").open("wb") as log:
            self.started.append(subprocess.Popen(command, stdout=log, stderr=log))

    def kill(self, number: int) -> None:
        """End all processes of a machine at once."""
        self.started[number].send_signal(signal.SIGKILL)
        self.started[number].wait()

    def close(self) -> None:
        """End all machines."""
        for number in range(len(self.started)):
            self.kill(number)


def write_scene(folder: Path, views: int, frames: int) -> Path:
    """Write the scene of ``benchmarks.scale.faults`` with all its files in one folder, and an image for a light."""
    shutil.copytree(ROOT / "scenes/assets/hex_nut_m16", folder / "nut")
    rng = np.random.default_rng(0)
    cv2.imwrite(str(folder / "sky.png"), rng.integers(0, 256, (32, 64, 3), dtype=np.uint8))
    text = SCENE.replace(f"{ROOT}/scenes/assets/hex_nut_m16", "nut")
    text = text.replace("layouts: 3, views: 5", f"layouts: {-(-frames // views)}, views: {views}")
    start, end = text.index("\nlights:"), text.index("\nrandomise:")
    path = folder / "scene.yaml"
    path.write_text(text[:start] + LIGHTS + text[end:])
    return path


def main() -> None:
    """Run both, and print the differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--views", type=int, default=5)
    options = parser.parse_args()
    if os.geteuid() != 0:
        sys.exit("machines that share nothing take root: sudo python -m benchmarks.scale.cluster")
    with recording("scale.cluster", parser, options):
        same = measure(options)
    sys.exit(not same)


def measure(options: argparse.Namespace) -> bool:
    """Return True if nothing is missing and nothing differs."""
    folder = Path(tempfile.mkdtemp(prefix="mitsplat-cluster-", dir="/tmp"))
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    os.environ.setdefault("WARP_CACHE_PATH", str(Path.home() / ".cache/warp"))
    # The cluster has its own token, because the machines have no home with one.
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    port = free_port()
    ray, head = str(Path(sys.executable).parent / "ray"), None
    machines = Machines(f"127.0.0.1:{port}", folder)
    try:
        path = write_scene(folder, options.views, options.frames)
        options_of_head = f"--head --block --disable-usage-stats --include-dashboard false --temp-dir {folder}/ray"
        options_of_head += f" --port {port} --num-cpus 0"
        with (folder / "head.log").open("wb") as log:
            head = subprocess.Popen([ray, "start", *options_of_head.split()], stdout=log, stderr=log)
        return compare(path, options.frames, machines)
    finally:
        machines.close()
        if head is not None:
            head.terminate()  # with --block, its children end too
            head.wait()
        shutil.rmtree(folder, ignore_errors=True)


def compare(path: Path, frames: int, machines: Machines) -> bool:
    """Compare the datasets of one process and of the cluster."""
    import ray
    from ray._private.state import actors  # the public API needs a dashboard

    from mitsplat.dataset.write import write_dataset
    from mitsplat.engine.ray import Cluster
    from mitsplat.scene.loading.scene_loading import load_scene

    folder = path.parent
    write_dataset(load_scene(path), folder / "alone", frames=frames)
    print(f"{frames} frames are made by one process", flush=True)
    ray.init(address=machines.address, log_to_driver=False, logging_level="ERROR")
    for _ in range(2):
        machines.start()
    while sum(node["Alive"] for node in ray.nodes()) < 3:
        time.sleep(0.5)
    events: Counter[str] = Counter()

    def hear(done: int, total: int, text: str) -> None:
        if text.startswith("frame "):
            events["frames"] += 1
            if events["frames"] == frames // 4:
                machines.kill(0)
                print(f"machine 1 is killed after frame {events['frames']}", flush=True)
            if events["frames"] == frames // 2:
                machines.start()
                print(f"machine 3 is started after frame {events['frames']}", flush=True)
        elif "is repeated" in text:
            events["lost"] += 1
            print(text[:100], flush=True)

    summary = write_dataset(
        load_scene(path),
        folder / "cluster",
        frames=frames,
        workers=None,
        cluster=Cluster(machines.address, {"machine": 1}),
        progress=hear,
    )
    expected, found = hashes(folder / "alone"), hashes(folder / "cluster")
    differing = {file for file in expected.keys() | found.keys() if expected.get(file) != found.get(file)}
    workers = Counter(actor["Address"]["NodeID"][:6] for actor in actors().values())
    for count, what in (
        (summary.rendered, "frames"),
        (frames // 4, "killed after"),
        (frames // 2, "joined after"),
        (len(workers), "nodes"),
        (events["lost"], "lost"),
        (len(found), "files"),
        (len(differing), "differing"),
    ):
        figure(count, "", what)
    print(f"workers by node: {dict(workers)}; frames in hand that were lost with their machine: {events['lost']}")
    print(f"{summary.rendered} frames, {len(found)} files, {len(differing)} differ {sorted(differing)[:5]}")
    ray.shutdown()
    return not differing and summary.rendered == frames


if __name__ == "__main__":
    main()
