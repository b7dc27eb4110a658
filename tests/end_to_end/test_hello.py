"""The smallest client, `clients/hello.py`, gets a filtered picture."""

import numpy as np
import pytest
from PIL import Image

from tests.end_to_end.printed_script import printed_by


@pytest.mark.clients
def test_the_smallest_client_writes_a_blurred_picture(real_service, tmp_path):
    out = tmp_path / "seen.png"
    printed_by("-m", "clients.hello", out, real_service.endpoint, cwd=tmp_path)
    seen = np.asarray(Image.open(out)).astype(int)
    assert seen.shape == (270, 480, 3)
    # squares of 15 px: near on the left, in reach of a myopic eye, lost on the right
    # 1.8 times the contrast, by the dense reference (exact PSF of every pixel)
    contrast = np.abs(np.diff(seen[..., 1], axis=0)).max(axis=0)
    assert contrast[:60].mean() > 1.7 * contrast[-60:].mean()
