"""One row of results from its times and its error."""

import numpy as np

from tests.benchmarks.harness import Row, memory_mb


def row_of(
    bench: str,
    method: str,
    case: str,
    setting: str,
    times_ms,
    error_name: str,
    error: float,
    reference: str,
    *,
    n: int | None = None,
    used_mb: float | None = None,
    kind: type[Row] = Row,
    **more,
) -> Row:
    """Return a row with the median and the 95th percentile of times.

    Parameters
    ----------
    times_ms : sequence of float
        Without any, the times are NaN: nothing was timed.
    n : int, optional
        Number of measurements; that of the times by default.
    used_mb : float, optional
        Memory; the largest of this process by default.
    kind : type
        A `Row` with further fields, which ``more`` contains.
    """
    times_ms = np.asarray(times_ms, np.float64)
    median_ms, p95_ms = (
        np.percentile(times_ms, (50, 95)).tolist() if times_ms.size else (np.nan,) * 2
    )
    return kind(
        bench=bench,
        method=method,
        case=case,
        setting=setting,
        n=times_ms.size if n is None else n,
        median_ms=median_ms,
        p95_ms=p95_ms,
        memory_mb=memory_mb() if used_mb is None else used_mb,
        error_name=error_name,
        error=float(error),
        reference=reference,
        **more,
    )
