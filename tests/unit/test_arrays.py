"""Broadcast copies have one type, whatever they are made of."""

import numpy as np
import pytest

from estimator.psf.arguments import broadcast_copy


@pytest.mark.parametrize("shape", [(), (2,), (1, 2), (3, 2), (3, 1)])
def test_copies_are_writable_and_contiguous(shape):
    values = np.arange(np.prod(shape), dtype=np.float64).reshape(shape)
    copy = broadcast_copy(values, (3, 2))
    np.testing.assert_array_equal(copy, np.broadcast_to(values, (3, 2)))
    assert copy.flags.writeable
    assert copy.flags.c_contiguous
    assert not np.shares_memory(copy, values)


def test_values_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="broadcast"):
        broadcast_copy(np.zeros(4), (3, 2))
