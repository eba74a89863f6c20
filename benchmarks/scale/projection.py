"""What a million images cost, from what one costs. Takes only the standard library."""

from __future__ import annotations

from dataclasses import dataclass

IMAGES = 1e6
WORKERS = 1, 2, 10, 100, 300, 1000, 3000
FSYNCED = 2e-3
"""Assumed time in which one process appends and fsyncs the two lines of a frame [s]."""


@dataclass(frozen=True)
class Row:
    """Images per second, days, worker-hours and terabytes with a number of workers."""

    workers: int
    speed: float
    saturated: bool
    days: float
    hours: float
    terabytes: float


@dataclass(frozen=True)
class Projection:
    """Rows, the time that a frame takes a worker [s], the speed of one writer [1/s], and the workers that reach it."""

    rows: tuple[Row, ...]
    each: float
    limit: float
    most: float


def project(seconds: float, size: float, settle: float, views: int) -> Projection:
    """Workers make images until the one process that writes lines has no time left.

    Args:
        seconds: Of a frame, with labels and files [s].
        size: Of a frame on the disk [bytes].
        settle: Time in which a layout is settled [s].
        views: Frames of a layout.
    """
    each, limit = seconds + settle / views, 1 / FSYNCED
    rows = []
    for workers in WORKERS:
        speed = min(workers / each, limit)
        days = IMAGES / speed / 86400
        rows.append(Row(workers, speed, speed == limit, days, workers * 24 * days, IMAGES * size / 1e12))
    return Projection(tuple(rows), each, limit, limit * each)
