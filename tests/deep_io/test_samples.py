"""Windows, blocks of samples and their arithmetic."""

import numpy as np
import pytest

from deep_io import DeepSamples, Window
from deep_io.samples import concatenate
from tests.deep_io.deep_files import assert_same, random_samples, split_rows


def test_window_bounds_are_inclusive():
    window = Window(-2, 3, 5, 3)
    assert (window.width, window.height) == (8, 1)
    assert window.rows(10, 12) == Window(-2, 10, 5, 11)


def test_offsets_frame_each_pixels_samples():
    samples = random_samples()
    offsets = samples.offsets
    assert offsets.dtype == np.int64
    assert offsets[0] == 0
    assert offsets[-1] == samples.total
    assert np.array_equal(np.diff(offsets), samples.counts.ravel())
    assert np.array_equal(np.bincount(samples.pixel_index, minlength=samples.counts.size), samples.counts.ravel())


@pytest.mark.parametrize(("counts", "size"), [((2, 3), 6), ((3, 2), 5)])
def test_shapes_that_do_not_fit_are_refused(counts, size):
    with pytest.raises(ValueError, match=r"do not fit|sum to"):
        DeepSamples(np.ones(counts, np.int32), {"R": np.zeros(size, np.float16)}, Window(0, 0, 1, 2))


def test_blocks_concatenate_to_the_whole():
    whole = random_samples()
    blocks = split_rows(whole, 4)
    assert_same(concatenate(blocks), whole)
    with pytest.raises(ValueError, match="do not follow"):
        concatenate([blocks[0], blocks[2]])
    with pytest.raises(ValueError, match="no block"):
        concatenate([])
