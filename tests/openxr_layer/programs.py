"""Programs that run on the mock runtime, with what they told and what was captured.

Run         any program, such as the driver, until it ends
run_hello_xr   Khronos' sample, for some frames
"""

import json
import os
import re
import subprocess
from pathlib import Path

from tests.openxr_layer.captured import read_frames

TIMEOUT_S = 150
VALIDATION = re.compile("VUID|SYNC-HAZARD|Validation (Error|Warning)", re.IGNORECASE)
"""Lines of Khronos' validation layer."""

SIZE_PX = (128, 96)
"""Of a view, unless MOCK_XR_SIZE says otherwise."""


class Run:
    """A program that has run on the mock runtime, as fast as it could.

    Parameters
    ----------
    runtime : Path
        Manifest of the runtime.
    folder : Path
        A folder of the test's; what was captured is in its `captured`.
    *command : object
        The program and its arguments.
    **variables : str
        More of the environment: of the mock runtime, of a layer, of a sanitizer.

    Attributes
    ----------
    folder : Path
        What was captured.
    exit_code : int
    said : str
        What the runtime and others wrote to standard error.
    told : list of dict
        What the program told in JSON.
    frames : list of dict
        Captured frames that have layers.
    """

    def __init__(self, runtime: Path, folder: Path, *command, **variables: str):
        self.folder = folder / "captured"
        run = subprocess.run(
            list(map(str, command)),
            env=_environment(runtime, self.folder)
            | {"MOCK_XR_RATE_HZ": "0"}
            | variables,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )
        self.exit_code, self.said = run.returncode, run.stderr
        lines = run.stdout.splitlines()
        self.told = [json.loads(line) for line in lines if line.startswith("{")]
        self.frames = _shown_frames(self.folder)

    @property
    def violations(self) -> list[str]:
        """Return what the runtime found wrong."""
        return _violations(self.said)

    def pairs(self):
        """Yield what the driver tells of each frame, and what was captured of it."""
        captured = {frame["display_time"]: frame for frame in self.frames}
        for line in self.told:
            if "frame" in line:
                yield line, captured[line["display_time"]]


def run_hello_xr(
    runtime: Path,
    folder: Path,
    display: str,
    n_frames: int,
    graphics: str = "OpenGL",
    **variables: str,
) -> tuple[list[dict], list[str]]:
    """Run `hello_xr` until the runtime ends its session.

    Parameters
    ----------
    runtime, folder, variables
        As of `Run`.
    display : str
        Name of an X display, of `tests.headset.xorg.Xorg`.
    n_frames : int
        That are shown.
    graphics : "OpenGL", "Vulkan" or "Vulkan2"
        API and, for Vulkan, the version of the extension.

    Returns
    -------
    list of dict, list of str
        Captured frames that have layers, and violations of OpenXR and of Vulkan.

    Raises
    ------
    RuntimeError
        It did not end well.
    """
    captured, said_path = folder / "captured", folder / "hello_xr.txt"
    own = {"DISPLAY": display, "MOCK_XR_EXIT_AT": str(n_frames)}
    with (
        said_path.open("wb") as said,
        subprocess.Popen(
            ["timeout", str(TIMEOUT_S), "hello_xr", "-g", graphics],
            env=_environment(runtime, captured) | own | variables,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
        ) as program,
    ):
        vulkan = []
        for line in program.stdout:
            if VALIDATION.search(line):
                vulkan.append(line)
            if "SESSION_STATE_EXITING" in line:
                break
        program.communicate()  # it waits for a key, or the end of its input
    text = said_path.read_text(errors="replace")
    if program.returncode != 0:
        raise RuntimeError(f"hello_xr: {program.returncode}: {text[-2000:]}")
    vulkan += [line for line in text.splitlines() if VALIDATION.search(line)]
    return _shown_frames(captured), _violations(text) + vulkan


def _environment(runtime: Path, captured: Path) -> dict[str, str]:
    return os.environ | {
        "XR_RUNTIME_JSON": str(runtime),
        "MOCK_XR_CAPTURE": str(captured),
        "MOCK_XR_SIZE": "{}x{}".format(*SIZE_PX),
        "LP_NUM_THREADS": "1",
    }


def _shown_frames(folder: Path) -> list[dict]:
    if not (folder / "frames.jsonl").exists():
        return []
    return [frame for frame in read_frames(folder) if frame["layers"]]


def _violations(said: str) -> list[str]:
    return [line for line in said.splitlines() if "mock: violation" in line]
