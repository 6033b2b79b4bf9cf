"""Where the time goes: a clock whose stages exclude each other, and that can watch the methods of an object."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Times:
    """Seconds by stage: `cpu` of all threads of the process, `wall` on the clock on the wall."""

    cpu: dict[str, float] = field(default_factory=dict)
    wall: dict[str, float] = field(default_factory=dict)


class Clock:
    """Charges time to the innermost stage that is open; stages may nest, and their times add up to the whole."""

    def __init__(self) -> None:
        self._times = Times()
        self._open: list[str] = []
        self._mark = (0.0, 0.0)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Charges what happens inside to `name`, apart from what stages inside it take."""
        self._charge()
        self._open.append(name)
        try:
            yield
        finally:
            self._charge()
            self._open.pop()

    def watch(self, owner: object, method: str, stage: str, then: Callable[[Any], None] = lambda _: None) -> None:
        """From now on, calls of this object's method count as `stage`; for a generator, the making of its items.

        `then` is given each result before the caller gets it.
        """
        original: Callable[..., Any] = getattr(owner, method)

        def timed(*arguments: Any, **named: Any) -> Any:
            with self.stage(stage):
                result = original(*arguments, **named)
                then(result)
            return self._items(result, stage) if isinstance(result, Iterator) else result

        setattr(owner, method, timed)

    def take(self) -> Times:
        """What was measured since the last call."""
        times, self._times = self._times, Times()
        return times

    def _items(self, items: Iterator[Any], stage: str) -> Iterator[Any]:
        while True:
            with self.stage(stage):
                try:
                    item = next(items)
                except StopIteration:
                    return
            yield item

    def _charge(self) -> None:
        now = time.process_time(), time.perf_counter()
        if self._open:
            name = self._open[-1]
            for sums, end, start in zip((self._times.cpu, self._times.wall), now, self._mark, strict=True):
                sums[name] = sums.get(name, 0.0) + end - start
        self._mark = now
