"""Progress of the worker: throttled, but no stage passes unsaid."""

from multiprocessing import Pipe

from filter_service.building.worker import _throttled_progress


def test_every_stage_is_reported_once_however_short_it_is():
    near, far = Pipe()
    progress = _throttled_progress(far, ticket=3)
    for fraction, stage in [(0.0, "eye"), (0.1, "aberrations"), (0.2, "psfs")]:
        progress(fraction, stage)
        progress(fraction + 0.01, stage)  # too soon after the first
    messages = []
    while near.poll(0):
        messages.append(near.recv())
    assert messages == [
        ("progress", 3, 0.0, "eye"),
        ("progress", 3, 0.1, "aberrations"),
        ("progress", 3, 0.2, "psfs"),
    ]
