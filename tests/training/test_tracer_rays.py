"""Rays of the torch tracer against those of the compiled tracer, at every surface."""

import numpy as np
import pytest

from estimator.eye import assembly
from estimator.eye.parameters import random_vectors
from estimator.eye.tracing import eye_indices
from estimator.optics.raytrace import RayStatus, trace_packed
from estimator.optics.surfaces import (
    BICONIC,
    FORM,
    IS_TURNED,
    REVOLVED,
    ROTATION,
    VERTEX,
    WITH_OFFSET,
)

torch = pytest.importorskip("torch")

from training.tracer import eye as eyes  # noqa: E402
from training.tracer.rays import cross_conic, cross_iterated  # noqa: E402

N_EYES, N_RAYS = 40, 30
WAVELENGTH_NM = 530.0
TOLERANCE_MM = 1e-9


def _rays(rng):
    angle, turn = rng.uniform(0.0, 35.0, N_RAYS), rng.uniform(0.0, 2 * np.pi, N_RAYS)
    sine = np.sin(np.radians(angle))
    direction = np.stack(
        [sine * np.cos(turn), sine * np.sin(turn), np.cos(np.radians(angle))], -1
    )
    aim = np.concatenate(
        [rng.uniform(-1.2, 1.2, (N_RAYS, 2)), np.full((N_RAYS, 1), 3.0)], 1
    )
    return np.concatenate([aim - 8.0 * direction, direction], 1)


def _compiled(packed, rays):
    """Points on the surfaces (n_rays, 5, 3), each in its surface's axes."""
    found = trace_packed(packed, eye_indices(WAVELENGTH_NM), rays)
    points = np.delete(found.points_mm, 2, axis=1)  # without the stop
    for i, row in enumerate(packed):
        axes = row[ROTATION : ROTATION + 9].reshape(3, 3)
        points[:, i] = (points[:, i] - row[VERTEX : VERTEX + 3]) @ axes
    return points, found.status_index


def _batched(vectors, rays):
    """The same points from the torch tracer, (n_eyes, n_rays, 5, 3)."""
    count = len(vectors)
    eye = eyes.pack_eyes(
        torch.tensor(vectors), torch.full((count,), WAVELENGTH_NM, dtype=torch.float64)
    )
    ray = torch.tensor(rays.T).expand(count, 6, N_RAYS)
    point, direction = ray[:, :3], ray[:, 3:]
    steps = (
        (eye.to_cornea,),
        (eye.to_posterior,),
        (eye.to_stop, eye.to_lens),
        (eye.to_lens_posterior,),
        (eye.to_retina,),
    )
    found = []
    for i, links in enumerate(steps):
        for step in links:
            point, direction = eyes.inward(step, point, direction)
        ratio = (
            None
            if i == 4
            else eye.indices[:, i : i + 1] / eye.indices[:, i + 1 :][:, :1]
        )
        cross = cross_iterated if i < 2 else cross_conic
        point, direction, _ = cross(eye.shapes[i], point, direction, ratio)
        found.append(point)
    return torch.stack(found, -1).permute(0, 2, 3, 1).numpy()


def test_rays_are_those_of_the_compiled_tracer_on_every_form(rng):
    """Offsets, biconic, tilted conics and the retina: all that training uses."""
    vectors, rays = random_vectors(N_EYES, rng), _rays(rng)
    packed = assembly.pack_eyes(vectors)
    assert set(packed[..., FORM].ravel()) == {REVOLVED, BICONIC, WITH_OFFSET}
    assert packed[:, 2:4, IS_TURNED].all()  # the lens is tilted
    found = _batched(vectors, rays)
    n_compared = 0
    for e in range(N_EYES):
        points, status = _compiled(packed[e], rays)
        traced = status == RayStatus.TRACED
        error_mm = np.abs(found[e][traced] - points[traced])
        assert error_mm.max(initial=0.0) < TOLERANCE_MM
        n_compared += traced.sum()
    assert n_compared > 0.8 * N_EYES * N_RAYS
