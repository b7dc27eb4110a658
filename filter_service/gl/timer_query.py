"""Timer queries, which can be deleted: those of moderngl cannot."""

import ctypes
from types import SimpleNamespace

GL_TIME_ELAPSED, GL_QUERY_RESULT = 0x88BF, 0x8866


class TimerQuery:
    """Measures the time that the GPU takes for the commands within.

    Parameters
    ----------
    functions : SimpleNamespace
        From `gl_functions`.
    """

    def __init__(self, functions: SimpleNamespace) -> None:
        self._gl, self._name = functions, ctypes.c_uint(0)
        functions.glGenQueries(1, ctypes.byref(self._name))

    def __enter__(self) -> None:
        """Begin the query."""
        self._gl.glBeginQuery(GL_TIME_ELAPSED, self._name)

    def __exit__(self, *raised: object) -> None:
        """End the query."""
        self._gl.glEndQuery(GL_TIME_ELAPSED)

    @property
    def elapsed_ns(self) -> int:
        """Wait for the GPU, and return the time in nanoseconds."""
        found = ctypes.c_uint64(0)
        self._gl.glGetQueryObjectui64v(self._name, GL_QUERY_RESULT, ctypes.byref(found))
        return found.value

    def release(self) -> None:
        """Delete the query."""
        self._gl.glDeleteQueries(1, ctypes.byref(self._name))
