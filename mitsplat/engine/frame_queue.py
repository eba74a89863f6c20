"""Queue of the frames that are not yet assigned to a worker."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from heapq import heapify, heappop, heappush, heapreplace


class FrameQueue:
    """Frames that are not yet assigned to a worker, by layout.

    A worker stays with its layout while that has frames. Then it takes the first unassigned layout. If there is none,
    it helps with the layout that has most frames left. Each operation costs O(log layouts): heap entries may be
    outdated, and are checked when they reach the top.

    Args:
        layouts: Frames of each layout, in order.

    Attributes:
        waiting: Unassigned frames of each layout; layouts without any are absent.
        left: Number of unassigned frames.
    """

    def __init__(self, layouts: Mapping[int, Sequence[int]]) -> None:
        self.waiting = {layout: deque(frames) for layout, frames in layouts.items() if frames}
        self.left = sum(map(len, self.waiting.values()))
        self._layouts: dict[int, int] = {}
        self._workers: Counter[int] = Counter()
        self._order = {layout: order for order, layout in enumerate(self.waiting)}
        self._entered = len(self._order)
        self._free = [(order, layout) for layout, order in self._order.items()]
        self._longest = [(-len(self.waiting[layout]), order, layout) for order, layout in self._free]
        heapify(self._longest)

    def take(self, worker: int) -> tuple[int, int] | None:
        """Return the next (layout, frame) for a worker, or None if all frames are assigned."""
        if not self.waiting:
            return None
        layout = self._layouts.get(worker)
        if layout is None or layout not in self.waiting:
            if layout is not None:
                self._workers[layout] -= 1
            layout = self._first_free() if self._free else None
            if layout is None:
                layout = self._longest_left()
            self._layouts[worker] = layout
            self._workers[layout] += 1
        frames = self.waiting[layout]
        frame = frames.popleft()
        self.left -= 1
        if not frames:
            del self.waiting[layout], self._order[layout]
        return layout, frame

    def put_back(self, worker: int, frame: int) -> None:
        """Return the frame of a lost worker to the queue."""
        layout = self._layouts[worker]
        if layout not in self.waiting:  # append the layout at the end
            self.waiting[layout] = deque()
            self._order[layout] = self._entered
            self._entered += 1
        self.waiting[layout].appendleft(frame)
        self.left += 1
        heappush(self._longest, (-len(self.waiting[layout]), self._order[layout], layout))
        del self._layouts[worker]
        self._workers[layout] -= 1
        if not self._workers[layout]:
            heappush(self._free, (self._order[layout], layout))

    def _first_free(self) -> int | None:
        while self._free:
            order, layout = heappop(self._free)
            if self._order.get(layout) == order and not self._workers[layout]:
                return layout
        return None

    def _longest_left(self) -> int:
        while True:
            length, order, layout = self._longest[0]
            if self._order.get(layout) != order:
                heappop(self._longest)
            elif -length != (left := len(self.waiting[layout])):
                heapreplace(self._longest, (-left, order, layout))
            else:
                return layout
