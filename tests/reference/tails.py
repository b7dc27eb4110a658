"""Light beyond kernels on squares, in NumPy."""

import numpy as np
from scipy.signal import fftconvolve

NEAR_STEPS, FADE_STEPS, FAR_SAMPLES = 15, (10.0, 16.0), 12


def edge_density(elements, x, y):
    """Return the light of an edge (8, N_EDGE) at points (...), mean over a unit."""
    slope, tangent, normal = elements[0:2], elements[2:4], elements[4:6]
    length, turn = elements[6:8]
    offset = x[..., None] - slope[0], y[..., None] - slope[1]
    across = offset[0] * tangent[0] + offset[1] * tangent[1]
    along = offset[0] * normal[0] + offset[1] * normal[1]
    ahead, along_ahead = np.roll(across, -1, axis=-1), np.roll(along, -1, axis=-1)
    change = np.maximum(np.abs(ahead - across), 1e-3)
    middle = 0.5 * (across + ahead)
    overlap = np.minimum(middle + 0.5 * change, 0.5)
    overlap = np.maximum(overlap - np.maximum(middle - 0.5 * change, -0.5), 0.0)
    distance = 0.5 * (along + along_ahead) - turn / 6.0 * (ahead - across)
    square = np.maximum(distance**2, 1.0) - 0.25
    return (length * overlap / (change * square)).sum(axis=-1)


def scaled(elements, ratio):
    """Return an edge in units of another size."""
    found = elements.astype(float)
    found[[0, 1, 6]] *= ratio
    return found


def on_squares(light, ratio):
    """Return the mean over sending and receiving squares of ``ratio`` samples."""
    box = np.full((ratio, ratio), 1.0 / ratio**2)
    found = fftconvolve(fftconvolve(light, box), box)
    middle = found.shape[0] // 2
    n = middle // ratio
    at = middle + ratio * np.arange(-n, n + 1)
    return found[np.ix_(at, at)] * ratio**2


def tails(elements, omitted, step_px):
    """Return the near and the far tail of one channel.

    Parameters
    ----------
    elements : (8, N_EDGE)
    omitted : callable
        Share of the kernel that ends before points x, y, px.
    """

    def near_share(steps):
        part = np.clip((steps - FADE_STEPS[0]) / np.ptp(FADE_STEPS), 0.0, 1.0)
        return 1.0 - part**2 * (3.0 - 2.0 * part)

    y, x = np.mgrid[-NEAR_STEPS : NEAR_STEPS + 1, -NEAR_STEPS : NEAR_STEPS + 1] * 1.0
    near = edge_density(scaled(elements, 1.0 / step_px), x, y)
    near *= near_share(np.hypot(x, y)) * omitted(step_px * x, step_px * y)
    y, x = np.mgrid[-FAR_SAMPLES : FAR_SAMPLES + 1, -FAR_SAMPLES : FAR_SAMPLES + 1]
    y, x = y * 1.0, x * 1.0
    far = edge_density(scaled(elements, 0.25 / step_px), x, y)
    far *= 1.0 - near_share(4.0 * np.hypot(x, y))
    far *= omitted(4.0 * step_px * x, 4.0 * step_px * y)
    far[np.hypot(x, y) > FAR_SAMPLES + 0.5] = 0.0
    return on_squares(near, 4), on_squares(far, 2)


def halved(squares):
    """Return means of two by two squares (rows, columns, n)."""
    rows, columns = squares.shape[:2]
    padded = np.pad(squares, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
    return padded.reshape(-(-rows // 2), 2, -(-columns // 2), 2, -1).mean(axis=(1, 3))


def enlarged(squares, shape, ratio):
    """Return squares (rows, columns, n), interpolated to squares of a smaller size."""
    for axis, size in enumerate(shape):
        at = (np.arange(size) + 0.5) / ratio - 0.5
        low = np.floor(at).astype(int)
        last = squares.shape[axis] - 1
        near, far = (np.take(squares, np.clip(low + k, 0, last), axis) for k in (0, 1))
        part = np.expand_dims(at - low, (1 - axis, 2))
        squares = near + part * (far - near)
    return squares


def received(means, near, far):
    """Return what squares receive of means (rows, columns, n).

    Parameters
    ----------
    near, far : (side, side, n)
        Tails on squares and on squares of twice the size.
    """

    def spread(image, tail):
        return np.stack(
            [
                fftconvolve(image[..., c], tail[..., c], mode="same")
                for c in range(image.shape[2])
            ],
            axis=-1,
        )

    beyond = spread(halved(means), far)
    return spread(means, near) + enlarged(beyond, means.shape[:2], 2)
