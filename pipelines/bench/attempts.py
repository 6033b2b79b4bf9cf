"""Lets one method fail on one scene without ending a bench: the failure is told, and kept as a gap in the results."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from deep_io.errors import OutputError, UsageError
from pipelines.bench.results import Gap, What
from pipelines.jobs import describe_error
from pipelines.progress import Progress

Value = TypeVar("Value")

SHARED: tuple[type[Exception], ...] = (OutputError, UsageError, BrokenPipeError)
"""Failures that concern more than one method: a full disk, wrong options, a reader of what is printed who went away."""


class Attempts:
    """Does what may fail by itself; `gaps` takes what did."""

    def __init__(self, gaps: list[Gap], progress: Progress) -> None:
        self.gaps = gaps
        self.progress = progress

    def __call__(self, method: str, scene: str, what: What, work: Callable[[], Value],
                 fatal: tuple[type[Exception], ...] = ()) -> Value | None:
        """What the work gives, or None where it fails. Raises failures of SHARED, and those that are `fatal`."""
        try:
            return work()
        except SHARED + fatal:
            raise
        except Exception as error:
            gap = Gap(method, scene, what, describe_error(error))
            self.gaps.append(gap)
            self.progress.fail(f"{gap.cell}: {gap.why}")
            return None
