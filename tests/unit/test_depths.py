"""Depth in fewer bytes: what each encoding keeps."""

import numpy as np
import pytest

from filter_service.messages import DEPTH_ENCODINGS, encoded_depth
from filter_service.wire.images import WIRE_DTYPES, decoded_depth

DEPTH_M = np.geomspace(0.05, 60.0, 5000, dtype=np.float32).reshape(50, 100)
STRANGE_M = np.array([[0.0, -1.0, np.nan, np.inf, 1e-6, 100.0, 1e9]], np.float32)


def there_and_back(depth_m, encoding):
    sent = encoded_depth(depth_m, encoding)
    assert sent.dtype == WIRE_DTYPES[encoding]
    found = decoded_depth(sent, encoding)
    assert found.dtype == np.float32
    return found


@pytest.mark.parametrize(
    ("encoding", "relative", "absolute_m"),
    [
        ("float32", 0.0, 0.0),
        ("float16", 2.0**-11, 0.0),
        ("dpt16", 2.0**-11, 0.0),
        ("mm16", 1e-6, 0.00050001),
    ],
)
def test_depth_is_kept_to_the_stated_error(encoding, relative, absolute_m):
    error_m = np.abs(there_and_back(DEPTH_M, encoding) - DEPTH_M)
    assert np.all(error_m <= relative * 1.01 * DEPTH_M + absolute_m)


@pytest.mark.parametrize("encoding", DEPTH_ENCODINGS)
def test_what_is_missing_and_what_is_infinite_stay_so(encoding):
    found = there_and_back(STRANGE_M, encoding)[0]
    assert not np.any(found[:3] > 0.0)
    assert found[3] == np.inf
    assert not np.isnan(found[5:]).any()
    assert np.all(found[5:] > 60.0)


def test_both_zeros_of_diopters_are_infinity():
    sent = np.array([0.0, -0.0, -1e-3, np.inf, np.nan], np.float16)
    found = decoded_depth(sent, "dpt16")
    assert np.isposinf(found[:2]).all()
    assert not np.any(found[2:] > 0.0)


def test_half_the_bytes():
    for encoding in ("float16", "dpt16", "mm16"):
        assert encoded_depth(DEPTH_M, encoding).nbytes == DEPTH_M.nbytes // 2
