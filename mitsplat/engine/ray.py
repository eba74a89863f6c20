"""Frames on a Ray cluster, or on this machine through Ray, with the same bytes as :mod:`mitsplat.engine.pool`.

The scene is put into Ray's object store once, and each worker reads it once. A layout that one worker has settled is
passed to all other workers that need it. The caller receives all files and is the only one that writes, so that no
shared file system is needed. Workers need the same version of mitsplat, and open no other file of the caller. The
unfinished frames of a lost machine are made again by other workers. A machine that joins gets workers too.
"""

from __future__ import annotations

import logging
import sys
import tempfile
import time
from collections import OrderedDict
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

from mitsplat.arguments import number_from
from mitsplat.engine.answers import Answer, Failure, Finished, Lost, LostWorkersError, Result
from mitsplat.engine.pool import check_workers
from mitsplat.engine.scheduler import run_pool
from mitsplat.errors import InputError, MissingResourceError
from mitsplat.progress import Note
from mitsplat.runtime.child_process import SAFE_PATH, safe_path_children
from mitsplat.runtime.device import Device, Kind, use_shared_device

MadeFrame = TypeVar("MadeFrame", covariant=True)

GPU_SHARE = {"CPU": 1.0, "GPU": 0.125}
"""Resources of a worker on a GPU: eight workers of 3 GiB each share a GPU of 24 GiB."""

_SEARCH_INTERVAL = 3.0
"""Minimum interval between searches for new machines [s]."""

_MACHINE_TIMEOUT = 60.0
"""Maximum waiting time for a machine when none is left [s]."""

_MAX_STORED_LAYOUTS = 64
"""Maximum number of layouts in the object store; any other layout is settled again or read from a cache."""


class ClusterJob(Protocol[MadeFrame]):
    """Job that settles layouts and makes their frames; must be picklable."""

    def cached_layout(self, layout: int) -> str | None:
        """Return a layout that is already settled, or None; called in the caller's process, not on the cluster."""

    def settle(self, layout: int) -> str:
        """Settle a layout."""

    def make(self, index: int, layout: str) -> MadeFrame:
        """Make a frame of a settled layout."""


@dataclass(frozen=True)
class Cluster:
    """Address of a Ray cluster, and the resources of a worker.

    Attributes:
        address: Address for ``ray.init``: None starts Ray on this machine, "auto" finds a running one.
        resources: Amounts that each worker reserves, by Ray's names: CPU, GPU, memory [bytes] or a resource that some
            nodes declare. A worker with a GPU, or a fraction of one, renders on it. Other workers render on their CPUs.
            The default is two CPUs, or :data:`GPU_SHARE` for GPUs.
    """

    address: str | None = None
    resources: Mapping[str, float] | None = None

    @staticmethod
    def parse_resources(text: str) -> dict[str, float]:
        """Parse amounts from a text such as ``CPU=4,GPU=1``.

        Raises:
            InputError: If the text has another format.
        """
        found = {}
        for part in text.split(","):
            name, _, amount = part.strip().partition("=")
            try:
                found[name] = number_from(amount, float)
            except ValueError:
                found[name] = 0.0
            if not name or not 0 < found[name] < float("inf"):
                raise InputError(f"resources must be NAME=AMOUNT,..., such as CPU=4,GPU=1 (got {text})")
        return found

    def on_device(self, device: str | Device | None) -> tuple[Device, Cluster]:
        """Return the device of the workers, and the cluster with the resources that each of them reserves.

        Args:
            device: ``cpu``, ``cuda``, or None to follow the resources.

        Raises:
            InputError: If the device is unknown, or contradicts the resources.
        """
        kind = device.kind if isinstance(device, Device) else device
        if kind not in (None, "cpu", "cuda"):
            raise InputError(f"device must be cpu or cuda on a cluster, because Ray assigns the GPUs (got {kind})")
        resources = self.resources
        if resources is None:
            resources = GPU_SHARE if kind == "cuda" else {"CPU": 2.0}
        elif kind is not None and (kind == "cuda") != ("GPU" in resources):
            rule = "include a GPU, such as GPU=0.125," if kind == "cuda" else "not include a GPU"
            wanted = ",".join(f"{name}={amount:g}" for name, amount in resources.items())
            raise InputError(f"resources must {rule} for the device {kind} (got {wanted})")
        return Device("cuda" if "GPU" in resources else "cpu"), replace(self, resources=resources)


def run_on_ray(
    job: ClusterJob[Result],
    layouts: Mapping[int, Sequence[int]],
    cluster: Cluster,
    *,
    workers: int | None = None,
    note: Note,
) -> Generator[Result]:
    """Call ``job.make`` for every frame and yield the results in order of completion.

    Args:
        job: Job to run.
        layouts: Frame indices by layout.
        cluster: Cluster to use.
        workers: Number of workers; None for the number that the cluster's resources allow.
        note: Callback that receives a short description of the current operation.

    Raises:
        MissingResourceError: If Ray is not installed or not found, or has no room for one worker.
        InputError, FrameError, LostWorkersError: As :func:`mitsplat.engine.pool.run_frames`.
    """
    check_workers(workers)
    if not any(layouts.values()):
        return
    with closing(_Actors(job, cluster, workers)) as pool, closing(run_pool(pool, layouts, pool.room, note)) as results:
        yield from results


def load_ray() -> Any:
    """Import and return the module ``ray``.

    Raises:
        MissingResourceError: If it is not installed.
    """
    try:
        import ray  # optional: the extra [cluster]
    except ImportError:
        raise MissingResourceError("the engine ray needs Ray: pip install 'mitsplat[cluster]'") from None
    return ray


class _Actors(Generic[Result]):
    """Pool of workers that are Ray actors.

    Attributes:
        room: Maximum number of workers at the start.
    """

    def __init__(self, job: ClusterJob[Result], cluster: Cluster, max_workers: int | None) -> None:
        ray = load_ray()
        self._ray = ray
        self._started = not ray.is_initialized()
        if self._started:
            where: dict[str, Any] = {"include_dashboard": False} if cluster.address is None else {}
            try:
                # Ray puts the caller's current folder on the import path of workers that have no working directory.
                # Output of a worker is contained in its answers or in Ray's logs.
                with safe_path_children(), tempfile.TemporaryDirectory() as empty:
                    where["runtime_env"] = {"working_dir": empty, "env_vars": {SAFE_PATH: "1"}}
                    ray.init(
                        address=cluster.address or "local", log_to_driver=False, logging_level=logging.ERROR, **where
                    )
            except Exception as error:  # Ray also raises errors without a type, such as after a timeout
                place = "on this machine" if cluster.address is None else f"at {cluster.address!r}"
                reason = str(error).partition("\n")[0]
                raise MissingResourceError(f"no Ray cluster {place}: {reason}") from error
        device, cluster = cluster.on_device(None)
        self._wanted, self._max_workers = cluster.resources or {}, sys.maxsize if max_workers is None else max_workers
        self._actors: dict[int, Any] = {}
        room = self._workers_per_node()
        self._nodes, self.room = set(room), min(self._max_workers, sum(room.values()))
        self._last_search = self._last_room = time.monotonic()
        if not self.room:
            self.close()
            raise MissingResourceError(self._no_node_text())
        amounts = dict(self._wanted)
        options: dict[str, Any] = {"num_cpus": amounts.pop("CPU", 0), "num_gpus": amounts.pop("GPU", 0)}
        if "memory" in amounts:
            options["memory"] = amounts.pop("memory")
        self._actor = ray.remote(_Actor).options(**options, resources=amounts, max_restarts=0)
        self._kind = device.kind
        self._threads = max(1, int(self._wanted["CPU"])) if "CPU" in self._wanted else None
        self._job = job
        self._stored = ray.put(job)
        self._answers: dict[Any, tuple[int, int, int]] = {}
        self._layouts: OrderedDict[int, tuple[Any, int | None]] = OrderedDict()
        self._count = 0

    def _workers_per_node(self) -> dict[str, int]:
        """Return the number of workers that fit on each node."""
        nodes = [(node["NodeID"], node["Resources"]) for node in self._ray.nodes() if node["Alive"]]
        return {
            node: int(min(resources.get(name, 0.0) / amount for name, amount in self._wanted.items()))
            for node, resources in nodes
        }

    def _no_node_text(self) -> str:
        wanted = ", ".join(f"{name}={amount:g}" for name, amount in self._wanted.items())
        return f"no node of the Ray cluster has {wanted} for a worker"

    def free_slots(self) -> int:
        now = time.monotonic()
        if now < self._last_search + _SEARCH_INTERVAL:
            return 0
        room, known, self._last_search = self._workers_per_node(), self._nodes, now
        self._nodes = set(room)
        if any(room.values()):
            self._last_room = now
        elif now > self._last_room + _MACHINE_TIMEOUT:
            raise LostWorkersError(f"{self._no_node_text()} any more; finished frames are kept")
        joined = sum(count for node, count in room.items() if node not in known)
        return max(0, min(joined, self._max_workers - len(self._actors)))

    def start(self) -> int:
        worker, self._count = self._count, self._count + 1
        self._actors[worker] = self._actor.remote([self._stored], self._kind, self._threads)
        return worker

    def stop(self, worker: int) -> None:
        self._ray.kill(self._actors.pop(worker))

    def send_frame(self, worker: int, frame: int, layout: int) -> None:
        actor = self._actors[worker]
        if layout not in self._layouts:
            known = self._job.cached_layout(layout)
            # The first worker that needs a layout settles it; Ray passes the result to the others.
            self._layouts[layout] = (
                (actor.settle.remote(layout), worker) if known is None else (self._ray.put(known), None)
            )
            while len(self._layouts) > _MAX_STORED_LAYOUTS:
                self._layouts.popitem(last=False)
        self._answers[actor.make.remote(frame, self._layouts[layout][0])] = worker, frame, layout

    def wait(self) -> Iterator[tuple[int, Answer[Result]]]:
        ready, _ = self._ray.wait(list(self._answers), num_returns=1, timeout=_SEARCH_INTERVAL)
        for reference in ready:
            worker, frame, layout = self._answers.pop(reference)
            try:
                answer = self._ray.get(reference)
            except self._ray.exceptions.RayError as error:
                _, settler = self._layouts.pop(layout, (None, None))
                if settler not in (None, worker):
                    self.send_frame(worker, frame, layout)  # the lost worker may be the one that settled the layout
                    continue
                self.stop(worker)
                yield worker, Lost(f"was lost ({str(error).strip().splitlines()[0]})")
            else:
                if isinstance(answer, Failure):  # the settling may have failed, which is then repeated with the frame
                    self._layouts.pop(layout, None)
                yield worker, answer

    def close(self) -> None:
        for worker in list(self._actors):
            self.stop(worker)
        if self._started:
            self._ray.shutdown()


class _Actor:
    """Worker on the cluster."""

    def __init__(self, stored: list[Any], kind: Kind, threads: int | None) -> None:
        import ray  # optional: the extra [cluster]

        self._kind: Kind | None = kind
        self._threads = threads
        self._job = ray.get(stored[0])

    def settle(self, layout: int) -> Failure | str:
        try:
            return self._job.settle(layout)  # type: ignore[no-any-return]
        except Exception as error:  # noqa: BLE001 - the caller raises it
            return Failure.of(error)

    def make(self, frame: int, layout: Failure | str) -> Failure | Finished[Any]:
        if isinstance(layout, Failure):
            return layout
        try:
            if self._kind is not None:
                use_shared_device(self._kind, self._threads)
                self._kind = None
            return Finished(self._job.make(frame, layout))
        except Exception as error:  # noqa: BLE001 - the caller raises it
            return Failure.of(error)
