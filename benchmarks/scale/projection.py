"""Cost of a million images, extrapolated from one. Uses only the standard library."""

from __future__ import annotations

from dataclasses import dataclass

IMAGES = 1e6
WORKERS = 1, 2, 10, 100, 300, 1000, 3000
FSYNCED = 2e-3
"""Assumed time to append and fsync the two lines of a frame in one process [s]."""


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
    """Rows, time of a frame in a worker [s], speed of one writer [1/s], and workers that saturate it."""

    rows: tuple[Row, ...]
    each: float
    limit: float
    most: float


def project(seconds: float, size: float, settle: float, views: int) -> Projection:
    """Project the cost of images for numbers of workers, until the one process that writes records is saturated.

    Args:
        seconds: Time of a frame, with labels and files [s].
        size: Size of a frame on the disk [bytes].
        settle: Time to settle a layout [s].
        views: Frames per layout.
    """
    each, limit = seconds + settle / views, 1 / FSYNCED
    rows = []
    for workers in WORKERS:
        speed = min(workers / each, limit)
        days = IMAGES / speed / 86400
        rows.append(Row(workers, speed, speed == limit, days, workers * 24 * days, IMAGES * size / 1e12))
    return Projection(tuple(rows), each, limit, limit * each)
