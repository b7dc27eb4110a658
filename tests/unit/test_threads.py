"""The thread layer that the service accepts."""

import subprocess
import sys
import textwrap

import pytest

from filter_service.threads import (
    UNSAFE_THREADING_LAYER,
    require_safe_threading_layer,
)

WITHOUT_SAFE_LAYERS = """
    import sys
    sys.modules["numba.np.ufunc.omppool"] = None
    sys.modules["numba.np.ufunc.tbbpool"] = None
    from filter_service.errors import RenderFailed
    from filter_service.threads import require_safe_threading_layer
    try:
        require_safe_threading_layer()
    except RenderFailed as error:
        print(error)
"""


def test_this_machine_has_a_safe_layer():
    assert require_safe_threading_layer() != UNSAFE_THREADING_LAYER


@pytest.mark.long("a process starts")
def test_a_machine_without_openmp_and_tbb_is_told_what_to_install():
    answer = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(WITHOUT_SAFE_LAYERS)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "libgomp1" in answer.stdout
