"""Environments of programs with the layer, and filters for its helper."""

import time
from unittest import mock

from clients.headset.stereo_filter import FilteredStereoFrame, LocalFilter
from clients.headset.stereo_gaze import StereoGaze
from clients.openxr_layer import program
from clients.openxr_layer.wire import SOCKET_VARIABLE

LAYER_LINE = "ocufilter layer: "
LONG_MS = 60_000


def layer_environment(library, folder, socket_path):
    """Return the environment of a program with a layer.

    Parameters
    ----------
    library : Path
    folder : Path
        Where the manifest is written.
    socket_path : Path
        The helper's socket.
    """
    # A library with a sanitizer loads only into programs with the sanitizer.
    with mock.patch.object(program, "library", return_value=library):
        text = program.manifest("explicit")
    (folder / f"{program.LAYER_NAME}.json").write_text(text)
    return program.layered_environment(folder) | {SOCKET_VARIABLE: str(socket_path)}


def layer_lines(run):
    """Return what the layer has said in a `Run`."""
    lines = run.said.splitlines()
    return [
        line.removeprefix(LAYER_LINE) for line in lines if line.startswith(LAYER_LINE)
    ]


class Inverting:
    """Filter that returns each picture inverted, after a time in s."""

    settings = None

    def __init__(self, takes_s=0.0):
        self.takes_s = takes_s

    def change(self, eye, profile):
        """There are no eyes."""

    def see(self, frame):
        time.sleep(self.takes_s)
        return FilteredStereoFrame(
            frame,
            tuple(inverted(picture.color) for picture in frame.pictures),
            tuple(eye.state.focus_dpt for eye in frame.eyes),
        )

    def restart(self):
        """Nothing is kept."""

    def close(self):
        """Nothing is held."""


def inverted(color):
    """Return an image of bytes or halves inverted."""
    return (255 if color.dtype.kind == "u" else 1) - color


class Patient:
    """Filter that waits until its eyes are prepared."""

    def __init__(self, seeing):
        self._seeing = seeing
        self.restart, self.close = seeing.restart, seeing.close

    def see(self, frame):
        while True:
            seen = self._seeing.see(frame)
            if seen is not None and seen.is_complete:
                return seen
            time.sleep(0.01)


PUPIL_MM, FOCUS_DPT = 4.0, 1.0


def frozen_look():
    """Return eyes that look straight ahead, with fixed pupils and focus."""
    return StereoGaze(age_years=30.0, pupil_diameter_mm=PUPIL_MM, focus_dpt=FOCUS_DPT)


def inverting_eyes(_say, takes_s=0.0):
    """Return the inverting filter, and frozen eyes."""
    return Inverting(takes_s), frozen_look()


def frozen_eyes(profiles, settings):
    """Return how to make the filter of two real eyes, and frozen eyes."""

    def made(say):
        seeing = LocalFilter(settings, say)
        for eye, profile in profiles.items():
            seeing.change(eye, profile)
        return Patient(seeing), frozen_look()

    return made
