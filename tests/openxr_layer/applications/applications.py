"""Applications that others wrote, with a scene of these tests.

Application    how one is started and ended
APPLICATIONS   Qt Quick 3D Xr, Psychtoolbox and Blender, as they differ for a layer
Running        an application in Monado, with the layer or without
stripe_contrasts, coarse   what is measured in a screenshot

The scene of all has fine stripes 6 m away above the horizon, others 25 cm away below
it, and a red and a blue box below those.
"""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.headset.monado import Monado, Pose, RemoteHead, Xvfb

SCENES = Path(__file__).parent
QML = "/opt/pyside/bin/pyside6-qml"
TIMEOUT_S = 120.0
VALIDATION = "XR_APILAYER_LUNARG_core_validation"
EYE_HEIGHT_M = 1.6
MIN_RANGE = 100
"""Least difference of the brightest and the darkest value in a drawn picture."""

STRIPES = {"far": (0.34, 0.46, 0.29, 0.71), "near": (0.54, 0.62, 0.365, 0.635)}
"""Top, bottom, left and right edge of stripes, relative to a view."""

HALF_SIZE = {"XRT_COMPOSITOR_SCALE_PERCENTAGE": "50"}


@dataclass(frozen=True)
class Application:
    """How an application is started.

    Attributes
    ----------
    name : str
    program : str
    options : tuple of str
        Before the scene.
    scene : str
        Name of a file in this folder.
    variables : mapping
        More of the environment.
    has_depth : bool
        Whether it submits depth.
    ends_itself : bool
        Whether it ends when asked; Debian's Blender 4.3.2 crashes when it ends.
    """

    name: str
    program: str
    options: tuple[str, ...]
    scene: str
    variables: Mapping[str, str] = field(default_factory=dict)
    has_depth: bool = False
    ends_itself: bool = True

    @property
    def is_missing(self) -> bool:
        """Whether it is not installed."""
        return shutil.which(self.program) is None


def _qt(name: str, backend: str = "opengl") -> Application:
    variables = {
        "QSG_RHI_BACKEND": backend,
        "QT_QPA_PLATFORM": "xcb",
        "QT_XCB_GL_INTEGRATION": "xcb_egl" if name == "egl" else "xcb_glx",
        "QML_XHR_ALLOW_FILE_READ": "1",
    }
    return Application(f"qt-{name}", QML, (), "scene.qml", variables, has_depth=True)


def _psychtoolbox(name: str, keywords: str) -> Application:
    variables = {
        # Its calls for the swap interval crash in Mesa's driver without zink.
        "MESA_LOADER_DRIVER_OVERRIDE": "zink",
        "SCENE_KEYWORDS": keywords,
    }
    return Application(
        f"psychtoolbox-{name}", "octave-cli", ("--no-gui",), "demo3d.m", variables
    )


APPLICATIONS = (
    _qt("glx"),
    _qt("egl"),
    _qt("vulkan", "vulkan"),
    _psychtoolbox("untimed", "NoTimingSupport NoTimestampingSupport"),
    _psychtoolbox("usual", " "),
    _psychtoolbox("presenter-thread", "TimingSupport TimestampingSupport"),
    Application(
        "blender",
        "blender",
        ("--factory-startup", "--python"),
        "vr.py",
        ends_itself=False,
    ),
)


class Running:
    """An application in Monado, whose head stands still.

    Parameters
    ----------
    application : Application
    folder : Path
        For the scene, and for what is said.
    *prefix : str
        A command that starts the application.
    is_validated : bool
        Load the validation layer below.  It crashes in Qt where there are controllers,
        so that the headset is the simulated one, which moves.
    **variables : str
        More of the environment.

    Attributes
    ----------
    monado : Monado
    process : Popen
    """

    def __init__(
        self,
        application: Application,
        folder: Path,
        *prefix: str,
        is_validated: bool = False,
        **variables: str,
    ):
        folder.mkdir(exist_ok=True)
        self._application, self._folder, self._prefix = application, folder, prefix
        self._xvfb, self._variables = Xvfb(folder), variables
        self._is_validated = is_validated
        self.monado = Monado(
            folder, remote=not is_validated, screen=True, variables=HALF_SIZE
        )
        self.process: subprocess.Popen | None = None
        self._head: RemoteHead | None = None

    def __enter__(self) -> "Running":
        try:
            display = self._xvfb.start()
            self.monado.__enter__()
            if not self._is_validated:
                self._head = RemoteHead()
                self._head.move(Pose((0.0, EYE_HEIGHT_M, 0.0)))
            self._start(display)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_) -> None:
        if self.process:
            if self.process.poll() is None:
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.communicate()
        if self._head:
            self._head.close()
        self.monado.close()
        self._xvfb.stop()

    def _start(self, display: str) -> None:
        application, folder = self._application, self._folder
        scene = Path(shutil.copy(SCENES / application.scene, folder))
        own = {
            "DISPLAY": display,
            "HOME": str(folder),
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "SCENE_END": str(folder / "end"),
        }
        if self._is_validated:
            own |= {
                "XR_ENABLE_API_LAYERS": VALIDATION,
                "XR_CORE_VALIDATION_EXPORT_TYPE": "text",
                "XR_CORE_VALIDATION_FILE_NAME": str(folder / "validation.txt"),
            }
        with (folder / "said.txt").open("wb") as said:
            self.process = subprocess.Popen(
                [*self._prefix, application.program, *application.options, str(scene)],
                env=os.environ
                | self.monado.environment
                | own
                | application.variables
                | self._variables,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if self._prefix else said,
                stderr=said,
                text=True,
                start_new_session=True,
            )

    @property
    def said(self) -> str:
        """Return what was said so far."""
        path = self._folder / "said.txt"
        return path.read_text(encoding="utf-8", errors="replace")

    def wait_until(self, is_wanted) -> None:
        """Wait until a function returns True."""
        end_s = time.monotonic() + TIMEOUT_S
        while not is_wanted():
            assert time.monotonic() < end_s, self.said[-3000:]
            assert self.process.poll() is None, self.said[-3000:]
            time.sleep(0.1)

    def screenshot(self) -> np.ndarray:
        """Return what the headset shows, as soon as that does not change anymore."""
        newest: list[np.ndarray] = []

        def is_still() -> bool:
            try:
                newest.append(self.monado.screenshot())
            except RuntimeError:
                return False
            time.sleep(0.4)
            one, *_, other = newest[-2:] * 2
            return len(newest) > 1 and is_drawn(other) and np.array_equal(one, other)

        self.wait_until(is_still)
        return newest[-1]

    def end(self) -> tuple[int, str]:
        """Let it end; return its exit code and its output."""
        if self._application.ends_itself:
            (self._folder / "end").write_text("end")
        else:
            self.process.terminate()
        output, _ = self.process.communicate(timeout=TIMEOUT_S)
        return self.process.returncode, output or ""

    def complaints(self) -> list[str]:
        """Return what the validation layer reports."""
        text = (self._folder / "validation.txt").read_text(errors="replace")
        return [line for line in text.splitlines() if "VUID" in line]


def is_drawn(picture: np.ndarray) -> bool:
    """Whether a screenshot shows more than one color."""
    return bool(np.ptp(picture.astype(int)) > MIN_RANGE)


def stripe_contrasts(picture: np.ndarray) -> dict[str, np.ndarray]:
    """Return the contrast of stripes in a screenshot.

    Parameters
    ----------
    picture : (height, width, 3) uint8
        sRGB; the left eye's view is the left half.

    Returns
    -------
    dict of (2,) ndarray
        Of "far" and "near" stripes, for the left and the right eye: standard deviation
        over mean along the rows, in linear light.
    """
    found = {}
    for name, edges in STRIPES.items():
        top, bottom, left, right = edges
        ratios = []
        for view in _views(_linear(picture)):
            height_px, width_px, _ = view.shape
            rows = slice(round(top * height_px), round(bottom * height_px))
            columns = slice(round(left * width_px), round(right * width_px))
            profile = view[rows, columns].mean(axis=(0, 2))
            ratios.append(profile.std() / profile.mean())
        found[name] = np.array(ratios)
    return found


def coarse(picture: np.ndarray) -> np.ndarray:
    """Return means of a screenshot in blocks of a tenth of its height, linear light."""
    height_px, width_px, _ = picture.shape
    side_px = height_px // 10
    rows, columns = height_px // side_px, width_px // side_px
    kept = _linear(picture)[: rows * side_px, : columns * side_px]
    return kept.reshape(rows, side_px, columns, side_px, 3).mean(axis=(1, 3))


def _linear(picture: np.ndarray) -> np.ndarray:
    encoded = picture / 255.0
    curve = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, encoded / 12.92, curve)


def _views(picture: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.split(picture, 2, axis=1))
