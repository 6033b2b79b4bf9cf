"""An input frame that is decoded once, for all its mirror images: what the survey has read can be kept.

Whether there is room for it is the job's decision, which knows the memory budget.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from deep_io.csr import Index, offsets_of
from deep_io.deep_reader import DEFAULT_BLOCK_BYTES
from deep_io.path_samples import PathSamples, SampleReader
from deep_io.roles import ROLES
from pipelines.mirrors import STRAIGHT, Mirror


class FrameReader(SampleReader):
    """A `SampleReader` that keeps what `blocks` reads once `keep` was called; `read` is then served from memory.

    Blocks that are kept share their arrays with what is read later: a caller must not write into them.
    """

    _keeping = False
    _whole: PathSamples | None = None
    _mirror = STRAIGHT  # which of its images the kept frame is

    def keep(self) -> None:
        """From now on a frame that is read to its end by `blocks` stays in memory."""
        self._keeping = True

    @property
    def kept_bytes(self) -> int:
        """About what a kept frame takes."""
        widths = sum(len(ROLES[role].channels) for role in self.mapping.sources)
        return self.total * 4 * (widths + 2 + self.carried)

    def blocks(self, max_bytes: int = DEFAULT_BLOCK_BYTES) -> Iterator[PathSamples]:
        """See SampleReader."""
        kept: list[PathSamples] = []
        for block in super().blocks(max_bytes):
            if self._keeping:
                kept.append(block)
            yield block
        if kept:
            self._whole = self._joined(kept)

    def read(self, y0: int | None = None, y1: int | None = None) -> PathSamples:
        """See SampleReader. Of a kept frame `repairs` are left out: the survey has told them."""
        if self._whole is None:
            return super().read(y0, y1)
        window = self.header.data_window
        return self.read_mirrored(window.ymin if y0 is None else y0, window.ymax + 1 if y1 is None else y1, STRAIGHT)

    def read_mirrored(self, y0: int, y1: int, mirror: Mirror) -> PathSamples:
        """Rows y0 to y1, exclusive, of a mirror image of the frame. `window` and `source` are those of the file's rows.

        A kept frame is turned in place: what was read of its other images is of no use any more.
        """
        top, height = self.header.data_window.ymin, self.header.data_window.height
        if self._whole is None:
            first, last = mirror.rows(y0 - top, y1 - top, height)
            return mirror.turn(super().read(top + first, top + last))
        if mirror != self._mirror:
            self._whole, self._mirror = self._mirror.to(mirror).turn(self._whole), mirror
        return self._rows(y0 - top, y1 - top)

    def forget(self, roles: Collection[str]) -> None:
        """Frees what is kept of some roles, which nobody will read."""
        for role in roles:
            if self._whole is not None:
                self._whole.roles.pop(role, None)

    def _joined(self, blocks: list[PathSamples]) -> PathSamples:
        """Blocks from top to bottom as one; they are emptied role by role, so that little is there twice."""
        first, last = blocks[0], blocks[-1]
        window = first.window.rows(first.window.ymin, last.window.ymax + 1)
        source = self._joined_source(blocks)
        roles = {role: np.concatenate([block.roles.pop(role) for block in blocks]) for role in tuple(first.roles)}
        return PathSamples(
            np.concatenate([block.counts for block in blocks]),
            np.concatenate([block.weight for block in blocks]),
            np.concatenate([block.coverage for block in blocks]),
            roles, window,
            extra=np.concatenate([block.extra for block in blocks]) if self.carried else first.extra,
            source=source,
        )

    def _joined_source(self, blocks: list[PathSamples]) -> Index | None:
        """Each sample's number in the file; None where all are there, in their order."""
        if all(block.source is None for block in blocks):
            return None
        top = self.header.data_window.ymin
        parts = []
        for block in blocks:
            own = np.arange(block.total, dtype=np.int64) if block.source is None else block.source
            before = self.samples_per_row[: block.window.ymin - top].sum()
            parts.append(np.where(own < 0, own, own + before))
        return np.concatenate(parts)

    def _rows(self, first: int, last: int) -> PathSamples:
        """Rows of the kept frame as it is turned, counted from its top; the arrays are views."""
        whole = self._whole
        assert whole is not None
        height, width = whole.counts.shape
        if not 0 <= first < last <= height:
            raise ValueError(f"rows {first} to {last} are not within 0 to {height}")
        offsets = offsets_of(whole.counts)
        own = slice(int(offsets[first * width]), int(offsets[last * width]))
        top, bottom = self._mirror.rows(first, last, height)
        source = whole.source
        if source is not None:
            before = self.samples_per_row[:top].sum()
            source = np.where(source[own] < 0, source[own], source[own] - before)
        return PathSamples(
            whole.counts[first:last], whole.weight[own], whole.coverage[own],
            {role: values[own] for role, values in whole.roles.items()},
            whole.window.rows(whole.window.ymin + top, whole.window.ymin + bottom),
            extra=whole.extra[own] if self.carried else whole.extra,
            source=source,
        )
