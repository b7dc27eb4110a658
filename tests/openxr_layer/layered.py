"""Programs that run with the layer, on the mock runtime or another one."""

import json
import os
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path

from clients.headset.local_filter import LocalFilter
from clients.headset.stereo_filter import FilteredStereoFrame
from clients.headset.stereo_gaze import StereoGaze
from clients.openxr_layer import manifest
from clients.openxr_layer.helper import SOCKET_VARIABLE
from tests.openxr_layer.captured import read_frames

TIMEOUT_S = 90
LAYER_LINE = "ocufilter layer: "
LONG_MS = 60_000


def layer_environment(library, folder, socket_path, monkeypatch):
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
    monkeypatch.setattr(manifest, "library", lambda: library)
    (folder / f"{manifest.NAME}.json").write_text(manifest.manifest("explicit"))
    return manifest.layered_environment(folder) | {SOCKET_VARIABLE: str(socket_path)}


@dataclass
class Ran:
    """A program that has ended.

    Attributes
    ----------
    exit_code : int
    said : str
        Standard error.
    told : list of dict
        JSON on standard output.
    captured : Path
        Folder of the mock runtime's captures.
    """

    exit_code: int
    said: str
    told: list = field(repr=False)
    captured: Path

    @property
    def frames(self):
        """Frames that had layers."""
        found = (self.captured / "frames.jsonl").exists()
        return [f for f in read_frames(self.captured) if f["layers"]] if found else []

    @property
    def violations(self):
        return [line for line in self.said.splitlines() if "violation" in line]

    @property
    def layer_lines(self):
        """What the layer has said."""
        lines = self.said.splitlines()
        return [
            line.removeprefix(LAYER_LINE)
            for line in lines
            if line.startswith(LAYER_LINE)
        ]

    def pairs(self):
        """Yield what the driver tells of each frame, and what was captured of it."""
        shown = {frame["display_time"]: frame for frame in self.frames}
        for line in self.told:
            if "frame" in line:
                yield line, shown[line["display_time"]]


def run(command, folder, environment):
    """Run a program to its end, with captures in a folder."""
    captured = folder / "captured"
    done = subprocess.run(
        list(map(str, command)),
        env=os.environ | environment | {"MOCK_XR_CAPTURE": str(captured)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    lines = done.stdout.splitlines()
    told = [json.loads(line) for line in lines if line.startswith("{")]
    return Ran(done.returncode, done.stderr, told, captured)


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
            tuple(picture.view for picture in frame.pictures),
            tuple(inverted(picture.color) for picture in frame.pictures),
            tuple(eye.state.focus_dpt for eye in frame.eyes),
            True,
            (),
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
