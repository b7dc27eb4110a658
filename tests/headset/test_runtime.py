"""The root of `setup_root.sh` does what tests of a headset's client rely on.

Started by `run_in_root.sh`; elsewhere, where there is no runtime, it is skipped.
"""

from pathlib import Path

import numpy as np

from tests.headset.monado import Eye, Monado, Pose, RemoteHead
from tests.headset.program import Program

PROBE = Path(__file__).with_name("probe.py")
EYE_SRGB = ((200, 40, 30), (20, 60, 180))  # as probe.py has them
PATCH_SRGB = (255, 255, 255)

START = ["IDLE", "READY", "SYNCHRONIZED", "VISIBLE", "FOCUSED"]
END = ["VISIBLE", "SYNCHRONIZED", "STOPPING", "IDLE", "EXITING"]
MANY_FRAMES = "100000"

POSE_ERROR = 1e-6  # of meters, of quaternions, of radians
SCREEN_ERROR = 3  # of 255: two conversions between sRGB and linear light
EDGE_PX = 3  # that lie beside a step, and mix

HEADS = (
    Pose((0.0, 1.6, 0.0)),
    Pose((0.3, 1.2, -0.4), (0.0, np.sin(0.25), 0.0, np.cos(0.25))),
    Pose((-0.1, 1.7, 0.2), (np.sin(-0.15), 0.0, 0.0, np.cos(-0.15))),
    Pose((0.0, 1.5, 1.0), (0.1, -0.2, 0.3, np.sqrt(0.86))),
)
EYES = (
    Eye(Pose((-0.032, 0.0, 0.0)), (-45.0, 40.0, 38.0, -42.0)),
    Eye(
        Pose((0.032, 0.001, 0.0), (0.0, np.sin(0.02), 0.0, np.cos(0.02))),
        (-40.0, 45.0, 38.0, -42.0),
    ),
)
SOON = 3
"""Frames after which a headset that was moved is seen where it is."""


class Probe(Program):
    """One run of probe.py.

    Parameters
    ----------
    monado : Monado
        The runtime that it finds.
    folder : Path
        Of the validation layer's report.
    *arguments : str
        Of probe.py.
    """

    def __init__(self, monado: Monado, folder: Path, *arguments: str):
        super().__init__(folder, monado.environment, str(PROBE), *arguments)

    def frames(self):
        """Yield the two views of each frame it shows."""
        for line in self.lines():
            if "frame" in line:
                yield line["frame"]


def told(lines, key):
    return [line[key] for line in lines if key in line]


def test_frames_with_depth_are_taken(started, tmp_path):
    with Probe(started(), tmp_path, "--frames", "60") as probe:
        lines = list(probe.lines())
    states = told(lines, "state")
    assert states == START + END
    assert told(lines, "frames") == [60]
    assert told(lines, "gl") == ["GL_NO_ERROR"]
    assert len(told(lines, "frame")) == 60
    assert probe.complaints() == []


def test_the_validation_layer_sees_a_fault(started, tmp_path):
    with Probe(started(), tmp_path, "--fault", "type") as probe:
        lines = list(probe.lines())
    assert told(lines, "error") == ["ValidationFailureError"]
    assert any("VUID-XrSystemGetInfo-type-type" in line for line in probe.complaints())


def test_the_runtime_reads_the_depth_it_is_given(started, tmp_path):
    with Probe(started(), tmp_path, "--fault", "planes") as probe:
        lines = list(probe.lines())
    assert told(lines, "error") == ["LayerInvalidError"]


def test_the_screen_shows_each_eye_in_its_half(started, tmp_path):
    monado = started(remote=True, screen=True)  # a head that keeps still
    with Probe(monado, tmp_path, "--frames", MANY_FRAMES) as probe:
        frames = probe.frames()
        for _ in range(30):
            next(frames)
        screen = monado.screenshot()
    for half, fill_srgb in zip(np.split(screen, 2, axis=1), EYE_SRGB, strict=True):
        assert_patch_upper_left(half, fill_srgb)


def assert_patch_upper_left(half, fill_srgb):
    height_px, width_px = half.shape[:2]
    expected = np.empty_like(half)
    expected[:] = fill_srgb
    expected[: height_px // 2, : width_px // 2] = PATCH_SRGB
    inner = np.ones((height_px, width_px), bool)
    for steps, size_px in ((inner, height_px), (inner.T, width_px)):
        for step_px in (0, size_px // 2, size_px):
            steps[max(0, step_px - EDGE_PX) : step_px + EDGE_PX] = False
    errors = np.abs(half.astype(int) - expected)[inner]
    assert errors.max() <= SCREEN_ERROR


def test_scripted_poses_come_back(started, tmp_path):
    monado = started(remote=True)
    with (
        RemoteHead() as remote,
        Probe(monado, tmp_path, "--frames", MANY_FRAMES) as probe,
    ):
        frames = probe.frames()
        for head in HEADS:
            remote.move(head, EYES)
            errors = [pose_error(next(frames), head) for _ in range(SOON)]
            assert errors[-1] < POSE_ERROR


def pose_error(views, head):
    """Return by how much views differ from those of `EYES` in a head, at most."""
    differences = []
    for view, eye in zip(views, EYES, strict=True):
        expected = head @ eye.pose
        turn = np.array(view["orientation"])
        turn *= np.sign(turn @ expected.orientation)  # q and -q are the same turn
        differences += [
            np.subtract(view["position_m"], expected.position_m),
            turn - expected.orientation,
            np.radians(np.subtract(view["angles_deg"], eye.angles_deg)),
        ]
    return np.abs(np.concatenate(differences)).max()


def test_a_killed_runtime_is_noticed_and_comes_back(started, tmp_path):
    monado = started()
    with Probe(monado, tmp_path, "--frames", MANY_FRAMES) as probe:
        lines = probe.lines()
        next(line for line in lines if "frame" in line)
        monado.kill()
        assert told(lines, "error") == ["InstanceLostError"]
    monado.restart()
    with Probe(monado, tmp_path, "--frames", "5") as probe:
        assert told(probe.lines(), "frames") == [5]
