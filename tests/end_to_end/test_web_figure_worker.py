"""The process that draws figures: answers, failures, and an end."""

import asyncio
import json

import pytest

from clients.web.figure_worker import (
    FigureFailed,
    FigureWorker,
    eye_figure,
    point_spread,
)

MYOPE = json.dumps({"kind": "prescription", "sphere_dpt": -3.0, "eye_side": "OD"})
PNG = b"\x89PNG"


def _of_a_study(questions):
    """Return what becomes of questions to one process."""

    async def ask():
        figure_worker = FigureWorker()
        try:
            return await questions(figure_worker)
        finally:
            figure_worker.close()

    return asyncio.run(ask())


def _seen(state, body=MYOPE):
    return point_spread(body, **state)[1]["half_light_arcmin"]


@pytest.mark.clients
def test_answers_failures_and_newer_questions():
    async def questions(figure_worker):
        state = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
        pictures = [
            await figure_worker.ask("a", "figure", eye_figure, name, MYOPE, **state)
            for name in ("wavefront", "section")
        ]
        with pytest.raises(FigureFailed, match="'cat' is unknown"):
            await figure_worker.ask(
                "a", "figure", eye_figure, "field", '{"kind": "cat"}', **state
            )
        waiting = [
            asyncio.create_task(figure_worker.ask("a", "n", divmod, 7 + k, 2))
            for k in range(3)
        ]
        answers = await asyncio.gather(*waiting)
        figure_worker._process.kill()
        with pytest.raises(FigureFailed, match="was restarted"):
            await figure_worker.ask("a", "n", divmod, 7, 2)
        return pictures, answers, await figure_worker.ask("a", "n", divmod, 7, 2)

    pictures, answers, last = _of_a_study(questions)
    assert all(picture.startswith(PNG) for picture in pictures)
    assert answers == [(3, 1), None, (4, 1)]  # in hand, dropped, the newest
    assert last == (3, 1)


@pytest.mark.clients
def test_light_of_a_point_spreads_as_rays_have_it():
    """A disc of pupil times defocus: half of its light within 1 / sqrt(2) of it."""
    state = {"direction_deg": (0.0, 0.0), "pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
    sharp, blurred = state | {"object_dpt": 3.0}, state | {"object_dpt": 1.0}
    body = {"kind": "prescription", "sphere_dpt": -3, "higher_order": "none"}
    plain = json.dumps(body)
    expected_arcmin = 2.0 * 4.0 / 2.0 / 2.0**0.5 * 3.43775
    assert _seen(blurred, plain) == pytest.approx(expected_arcmin, rel=0.12)
    assert _seen(sharp, plain) < 0.25 * _seen(blurred, plain)
