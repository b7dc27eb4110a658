"""Main loop of the viewer: render, follow the eyes, filter and show."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

from clients.frame_log import Notes, add_notes, percentiles
from clients.headset.runtime import (
    EYES,
    DueFrame,
    Eye,
    EyeView,
    NoRuntime,
    Runtime,
    SessionEnded,
    SessionLost,
    ShownView,
)
from clients.headset.stereo_filter import FilteredStereoFrame, StereoFilter, StereoFrame
from clients.headset.stereo_gaze import Picture, StereoGaze, images_of

MS_PER_S = 1e3
STALE_S = 1.0
"""If a result is older than this, the unfiltered scene is shown instead."""

RETRY_S = 1.0
SPLIT_RATIO = 0.5


class Scenery(Protocol):
    """Interface of renderers of a scene for both eyes."""

    def pictures(
        self, views: Sequence[EyeView], size_px: tuple[int, int]
    ) -> tuple[Picture, ...]:
        """Render the image of each eye; the next call may overwrite textures."""


@dataclass
class ViewerLog:
    """Counts and times of frames.

    Attributes
    ----------
    n_filtered, n_plain, n_hidden : int
        Numbers of frames shown filtered, shown unfiltered, and not rendered.
    n_repeated : int
        Number of filtered images that were shown again.
    n_incomplete : int
        Number of frames filtered with an incomplete eye.
    n_sessions : int
        Number of sessions with a headset.
    first_filtered_s : float or None
        Time of the first filtered frame, on the clock of `time.monotonic`.
    stages_ms : dict
        Times of each stage of the filtered frames.
    notes : Notes
        Notes of the filter.
    """

    n_filtered: int = 0
    first_filtered_s: float | None = None
    n_repeated: int = 0
    n_plain: int = 0
    n_hidden: int = 0
    n_sessions: int = 0
    stages_ms: dict[str, list[float]] = field(default_factory=dict)
    n_incomplete: int = 0
    notes: Notes = field(default_factory=dict)

    def add(self, times_ms: Mapping[str, float]) -> None:
        """Record a filtered frame's times."""
        self.n_filtered += 1
        self.first_filtered_s = self.first_filtered_s or time.monotonic()
        for name, value_ms in times_ms.items():
            self.stages_ms.setdefault(name, []).append(value_ms)

    def summary(self) -> dict[str, Any]:
        """Return counts and percentiles."""
        return {
            "sessions": self.n_sessions,
            "filtered": self.n_filtered,
            "repeated": self.n_repeated,
            "plain": self.n_plain,
            "not_rendered": self.n_hidden,
            "stages_ms": {
                name: percentiles(values) for name, values in self.stages_ms.items()
            },
            "incomplete": self.n_incomplete,
            "notes": list(self.notes.values()),
        }


class Viewer:
    """Viewer of a scene as seen through two eyes.

    Parameters
    ----------
    open_runtime : callable
        Function that opens the headset's runtime, called again after a lost session.
    scenery : Scenery
        Renderer of the scene.
    seeing : StereoFilter
        Filter of the frames.
    look : StereoGaze
        Model of the person's gaze, focus and pupils.
    controls : Controls
        Run-time switches.
    read_keys : callable
        Function that returns the keys pressed since the last call.
    say : callable
        Called with each message for the user, one line.
    on_session : callable
        Called with the runtime of each new session.
    """

    def __init__(
        self,
        open_runtime: Callable[[], Runtime],
        scenery: Scenery,
        seeing: StereoFilter,
        look: StereoGaze,
        controls: Controls,
        *,
        read_keys: Callable[[], str] = str,
        say: Callable[[str], None] = print,
        on_session: Callable[[Runtime], None] = lambda runtime: None,
    ) -> None:
        self._open_runtime = open_runtime
        self._scenery = scenery
        self._seeing = seeing
        self._look = look
        self._controls = controls
        self._read_keys = read_keys
        self._say = say
        self._on_session = on_session
        self._last: FilteredStereoFrame | None = None
        self._was_tracked = False
        self._was_stale = False
        self.log = ViewerLog()

    def run(
        self,
        *,
        max_frames: int | None = None,
        limit_s: float | None = None,
        warm_up_s: float = 0.0,
    ) -> ViewerLog:
        """Show frames until the user or a limit ends the viewer.

        If the headset is lost, the viewer waits for it.

        Parameters
        ----------
        max_frames : int, optional
            Number of filtered frames after which to stop.
        limit_s : float, optional
            Time after the first filtered frame when to stop.
        warm_up_s : float
            Longest wait for the first filtered frame, before the time limit starts.
        """
        latest_s = time.monotonic() + warm_up_s
        controls, log = self._controls, self.log

        def is_done() -> bool:
            begun_s = min(log.first_filtered_s or latest_s, latest_s)
            return (
                controls.is_over
                or (max_frames is not None and log.n_filtered >= max_frames)
                or (limit_s is not None and time.monotonic() >= begun_s + limit_s)
            )

        said = ""
        while not is_done():
            try:
                runtime = self._open_runtime()
            except (NoRuntime, SessionLost) as error:
                if str(error) != said:
                    said = str(error)
                    self._say(f"{said}; trying again every {RETRY_S:g} s")
                self._controls.press(self._read_keys())
                time.sleep(RETRY_S)
                continue
            said = ""
            self.log.n_sessions += 1
            self._say(f"{runtime.name}: {runtime.size_px[0]}x{runtime.size_px[1]} px")
            self._look.restart()
            self._seeing.restart()
            self._on_session(runtime)
            try:
                self._run_session(runtime, is_done)
            except SessionEnded as error:
                self._say(str(error))
                break
            except SessionLost as error:
                self._say(f"{error}; trying again")
                self._last = None
                time.sleep(RETRY_S)
            finally:
                runtime.close()
        return self.log

    def _run_session(self, runtime: Runtime, is_done: Callable[[], bool]) -> None:
        while not is_done():
            due = runtime.begin_frame()
            begun_s = time.monotonic()
            if due is None:
                self._controls.press(self._read_keys())
                continue
            seen: FilteredStereoFrame | None = None
            shown: tuple[ShownView, ...] = ()
            times_ms: dict[str, float] = {}
            try:
                self._controls.press(self._read_keys(), due.pressed)
                if due.should_render:
                    seen, shown, times_ms = self._frame(due, begun_s, runtime.size_px)
            except BaseException:
                # OpenXR requires that every frame that has begun also ends.
                runtime.end_frame(due, ())
                raise
            show_s = time.monotonic()
            runtime.end_frame(due, shown)
            times_ms["show_ms"] = MS_PER_S * (time.monotonic() - show_s)
            if due.should_render:
                self._note(seen, times_ms)
            else:
                self.log.n_hidden += 1

    def _frame(
        self, due: DueFrame, begun_s: float, size_px: tuple[int, int]
    ) -> tuple[FilteredStereoFrame | None, tuple[ShownView, ...], dict[str, float]]:
        """Return the filtered frame, the views to show, and the times of the stages."""
        pictures = self._scenery.pictures(due.views, size_px)
        rendered_s = time.monotonic()
        known = [self._seeing.known(picture) for picture in pictures]
        eyes = self._look.follow(due, pictures, known)
        looked_s = time.monotonic()
        self._tell_tracking()
        frame = StereoFrame(due, pictures, eyes, begun_s)
        seen = self._seeing.see(frame)
        is_stale = seen is not None and begun_s - seen.frame.begun_s > STALE_S
        if is_stale and not self._was_stale:
            self._say("the filter is late; showing the scene unfiltered")
        self._was_stale = is_stale
        times_ms = {
            "scene_ms": MS_PER_S * (rendered_s - begun_s),
            "look_ms": MS_PER_S * (looked_s - rendered_s),
        }
        seen = None if is_stale else seen
        return seen, self._shown(frame, seen), times_ms

    def _shown(
        self, frame: StereoFrame, seen: FilteredStereoFrame | None
    ) -> tuple[ShownView, ...]:
        """Return the views to show, each with the pose that it was rendered for."""
        if seen is None or not self._controls.is_on:
            return tuple(
                ShownView(picture.view, *images_of(picture))
                for picture in frame.pictures
            )
        ratio = SPLIT_RATIO if self._controls.is_split else 0.0
        found = []
        for color, picture in zip(seen.colors, seen.frame.pictures, strict=True):
            plain, depth_m = images_of(picture)
            found.append(ShownView(picture.view, color, depth_m, plain, ratio))
        return tuple(found)

    def _note(
        self, seen: FilteredStereoFrame | None, times_ms: dict[str, float]
    ) -> None:
        if seen is None:
            self.log.n_plain += 1
            return
        if seen is self._last:
            self.log.n_repeated += 1
            return
        self._last = seen
        frame = seen.frame
        self._look.learn(frame.pictures, frame.eyes, seen.used_focus_dpt)
        add_notes(self.log.notes, seen.notes)
        self.log.n_incomplete += not seen.is_complete
        scene_ms, look_ms, show_ms = times_ms.values()
        age_ms = MS_PER_S * (time.monotonic() - frame.begun_s)
        self.log.add(
            {
                "scene_ms": scene_ms,
                "look_ms": look_ms,
                **seen.stages_ms,
                "show_ms": show_ms,
                "age_ms": age_ms,
            }
        )

    def _tell_tracking(self) -> None:
        is_tracked, before = self._look.is_tracked, self._was_tracked
        self._was_tracked = is_tracked
        if is_tracked and not before:
            self._say("eyes are tracked")
        elif before and not is_tracked:
            self._say("the eye tracker lost the eyes: gaze is straight ahead")


# Run-time switches

try:  # not available on every system
    import termios
    import tty
except ImportError:
    termios = tty = cast("Any", None)

PRESETS = (
    "emmetropia",
    "myopia",
    "astigmatism",
    "keratoconus",
    "cataract",
    "post_lasik",
)
_PRESET_KEYS = ("1", "2", "3", "4", "5", "6")
_NEXT_KEYS: dict[str, tuple[Eye, ...]] = {
    "l": ("left",),
    "r": ("right",),
    "next_eye": EYES,  # a button
}
HELP = (
    "keys: both eyes: "
    + ", ".join(f"{n} {name}" for n, name in enumerate(PRESETS, 1))
    + "; l, r: next preset for the left or right eye; f: filter on or off; "
    "s: split view, unfiltered on the left; q: quit"
)


@dataclass
class Controls:
    """Run-time switches of the viewer.

    Attributes
    ----------
    profiles : dict
        Profile of each eye.
    change : callable
        Called with (eye, profile) when an eye changes.
    say : callable
        Called with each message for the user, one line.
    is_on : bool
        Whether the filter is on; otherwise the scene is shown unfiltered.
    is_split : bool
        Whether the left half is shown unfiltered.
    is_over : bool
        Whether the user has ended the program.
    """

    profiles: dict[Eye, Mapping[str, Any]]
    change: Callable[[Eye, Mapping[str, Any]], None]
    say: Callable[[str], None] = lambda line: None
    is_on: bool = True
    is_split: bool = False
    is_over: bool = False
    _numbers: dict[Eye, int] = field(default_factory=lambda: dict.fromkeys(EYES, -1))

    def press(self, keys: str, buttons: Sequence[str] = ()) -> None:
        """Handle pressed keys and controller buttons."""
        for key in (*keys, *buttons):
            if key in _PRESET_KEYS:
                for eye in EYES:
                    self._set(eye, _PRESET_KEYS.index(key))
            for eye in _NEXT_KEYS.get(key, ()):
                self._set(eye, (self._numbers[eye] + 1) % len(PRESETS))
            if key in ("f", "on_off"):
                self.is_on = not self.is_on
                state = "on" if self.is_on else "off: the scene is unfiltered"
                self.say(f"filter {state}")
            elif key == "s":
                self.is_split = not self.is_split
                self.say(f"split {'on' if self.is_split else 'off'}")
            elif key == "q":
                self.is_over = True

    def _set(self, eye: Eye, number: int) -> None:
        self._numbers[eye] = number
        self.profiles[eye] = {"kind": "preset", "name": PRESETS[number]}
        self.change(eye, self.profiles[eye])


class TerminalKeys:
    """Reader of single key presses from the terminal; reads none from other stdin."""

    def __init__(self) -> None:
        self._before: list[Any] = []
        self._descriptor = -1

    def __enter__(self) -> TerminalKeys:
        """Switch the terminal to unbuffered input."""
        if termios is not None and sys.stdin is not None and sys.stdin.isatty():
            self._descriptor = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor)
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Restore the terminal's settings."""
        if self._before:
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def pressed(self) -> str:
        """Return the keys pressed since the last call, without waiting."""
        keys = b""
        while self._before and select.select([self._descriptor], [], [], 0.0)[0]:
            got = os.read(self._descriptor, 64)
            if not got:
                break
            keys += got
        return keys.decode("utf-8", "ignore")
