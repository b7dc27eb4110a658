"""Workers of a data loader: the same bytes in any number of processes and threads."""

import pickle
import sys

import numpy as np
import pytest

from filter_service import EyeBank, FilterSettings
from filter_service.camera import Camera
from tests.loader_workers import SeenPictures, digest, loaded

CAMERA = Camera.from_fov(8.0, width_px=48, height_px=32)
SETTINGS = FilterSettings(
    mode="on-axis",
    pupil_range_mm=(3.0, 4.0),
    focus_range_dpt=(0.0, 0.5),
    object_planes_dpt=(0.5,),
)
PEOPLE = [
    {"kind": "prescription", "sphere_dpt": sphere_dpt, "age_years": 30.0, "sample": 1}
    for sphere_dpt in (-0.5, -2.0)
]
STATES = [
    {"pupil_diameter_mm": pupil_mm, "focus_dpt": 0.2}
    for pupil_mm in (3.0, 3.3, 3.7, 4.0)
]


@pytest.fixture(scope="module")
def profiles(tmp_path_factory):
    """Return the profiles of all samples by whether they are in a bank."""
    folder = tmp_path_factory.mktemp("banks") / "bank"
    bank = EyeBank.build(folder, PEOPLE, CAMERA, SETTINGS, workers=1)
    return {"bank": [*bank, *bank], "drawn": [*PEOPLE, *PEOPLE]}


def pictures(profiles):
    color = np.random.default_rng(3).integers(0, 256, (32, 48, 3), np.uint8)
    frame = color, np.full((32, 48), 2.0, np.float32)
    return SeenPictures(frame, CAMERA, SETTINGS, profiles, STATES)


@pytest.fixture(scope="module")
def expected(profiles):
    """Return the hash of the images without workers."""
    images = [
        image for _, image, *_ in map(pictures(profiles["drawn"]).__getitem__, range(4))
    ]
    assert len({image.tobytes() for image in images}) == 4
    return digest(images)


@pytest.mark.skipif(sys.platform != "linux", reason="forks, and reads /proc")
@pytest.mark.long("processes that filter images")
@pytest.mark.parametrize(
    ("eyes", "method", "n_workers", "threads"),
    [
        ("bank", "fork", 1, ""),
        ("bank", "spawn", 2, "3"),
        ("drawn", "fork", 2, "3"),
    ],
)
def test_images_do_not_depend_on_the_workers(
    monkeypatch, profiles, expected, eyes, method, n_workers, threads
):
    monkeypatch.setenv("OCUFILTER_THREADS", threads)
    copied = pickle.loads(pickle.dumps(pictures(profiles[eyes])))
    found = loaded(copied, method, n_workers)
    assert found["images"] == expected
    assert found["processes"] == found["workers"] == n_workers  # no other processes
    assert 0.0 < found["start_s"] < 30.0
    assert found["pss_mb"] > 5 * n_workers
