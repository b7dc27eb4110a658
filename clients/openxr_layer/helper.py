"""The helper of the OpenXR layer: filters the frames of one program at a time."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, cast

import typer
from numpy.typing import NDArray

from clients.commands.options import read_profile
from clients.frame_log import percentiles, without_numbers
from clients.headset.options import EyeOptions, Eyes
from clients.headset.runtime import (
    EYES,
    DueFrame,
    Eye,
    GazeSample,
    angles_of,
    rotation_of,
)
from clients.headset.stereo_filter import LogOnce, Say, StereoFilter, StereoFrame
from clients.headset.stereo_gaze import RgbdPicture, StereoGaze
from clients.headset.viewer import SPLIT_RATIO
from clients.openxr_layer import wire
from clients.openxr_layer.frame_images import FrameImages, check_frame
from clients.openxr_layer.wire import (
    SOCKET_VARIABLE,
    is_trusted,
    listening,
    socket_path,
)
from estimator.bounded_files import loads_bounded, printable
from filter_service.command_line import check_range
from filter_service.errors import FilterError
from filter_service.shared_memory import Slot

USUAL_AGE_MS = 150
MAX_WAIT_MS = 600_000
WAIT_S = 1.0
"""Period reported to a service's filter, which waits for a result accordingly."""

MS_PER_S, US_PER_MS, NS_PER_S = 1e3, 1e3, 1e9
_COUNTS = ("filtered", "not_filtered", "submitted", "shown_filtered", "fallback")
N_LATE = 10
"""Successive late results before a message to the user."""

N_TIMES = 4096
"""Newest frames whose times are reported."""

MAX_WAITING = 64
"""Connections that are neither closed nor the program's.  Of more, the oldest goes:
a layer and a command send their first message at once."""


Socket = Annotated[
    Path | None,
    typer.Option(
        metavar="PATH",
        help=f"Socket of the helper; by default ${SOCKET_VARIABLE}, or a file of this "
        "user.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class LayerOptions(EyeOptions):
    """Options of `ocufilter layer run` and `serve`."""

    flat_dpt: Annotated[
        float,
        typer.Option(
            metavar="D",
            help="Distance of everything in programs that submit no depth, dpt; 0 is "
            "infinity.",
        ),
    ] = 1.0
    wait_ms: Annotated[
        int,
        typer.Option(
            metavar="MS",
            help="Longest wait of the program for the result of each frame; 0 shows "
            "the newest result.",
        ),
    ] = 0
    max_age_ms: Annotated[
        int,
        typer.Option(
            metavar="MS",
            help="Age up to which a filtered frame is shown; then the program's own is "
            "shown.",
        ),
    ] = USUAL_AGE_MS
    split: Annotated[
        bool, typer.Option("--split", help="Leave the left half unfiltered.")
    ] = False
    leave_quads: Annotated[
        bool,
        typer.Option(
            "--leave-quads",
            help="Show quad layers, such as menus, unfiltered.  By default, they are "
            "filtered at their distance.",
        ),
    ] = False
    socket: Socket = None

    @property
    def socket_file(self) -> Path:
        """Return the socket of the helper."""
        return self.socket or socket_path()

    @property
    def longest_age_ms(self) -> int:
        """Return the age up to which a frame is shown.

        A frame that the program waited for is shown at any age.
        """
        return max(self.max_age_ms, self.wait_ms)

    @property
    def flat_m(self) -> float:
        """Return the planar depth of programs without depth."""
        return 1.0 / self.flat_dpt if self.flat_dpt else float("inf")

    def check(self) -> None:
        """Check the limits.

        Raises
        ------
        ValueError
            If a value is out of range.  The message names the option.
        """
        check_range("--flat-dpt", self.flat_dpt, (0.0, 20.0))
        check_range("--wait-ms", self.wait_ms, (0, MAX_WAIT_MS))
        check_range("--max-age-ms", self.max_age_ms, (1, MAX_WAIT_MS))


@dataclass(eq=False)
class _Program:
    """The program whose frames are filtered."""

    connection: socket.socket
    name: str
    engine: str
    graphics: str
    memory: Slot | None = None
    notes: set[str] = field(default_factory=set)


class LayerHelper:
    """Filters the frames of programs with the layer, one program at a time.

    Parameters
    ----------
    seeing : StereoFilter
        Filter of both eyes.
    look : StereoGaze
        Gaze, focus and pupils.
    say : callable
        Called with each message for the user, one line.
    options : LayerOptions
    change : callable
        Called with (eye, profile text) by `ocufilter layer set`; raises `ValueError`.
    path : Path
        Where to listen.

    Raises
    ------
    OSError
        If the socket cannot be created, or another helper listens there.
    """

    def __init__(
        self,
        seeing: StereoFilter,
        look: StereoGaze,
        say: Say,
        options: LayerOptions,
        change: Callable[[Eye, str], None],
        path: Path,
    ) -> None:
        self._seeing, self._look, self._say = seeing, look, say
        self._say_once = LogOnce(say)
        self._options, self._change = options, change
        self._path = path
        self._listener = listening(path)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._program: _Program | None = None
        self._waiting: dict[socket.socket, None] = {}  # oldest first
        self.on_frame: Callable[[StereoFrame, Any], None] | None = None
        self.on_gaze: Callable[[], None] = lambda: None  # an eye tracker was found
        self._stages_ms: dict[str, deque[float]] = {}
        self._n_late = 0
        self.n_frames = 0
        self._counts = dict.fromkeys(_COUNTS, 0)

    def close(self) -> None:
        """Close all connections and remove the socket."""
        self._drop("")
        for connection in list(self._waiting):
            self._forget(connection)
        self._selector.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def run_once(self, timeout_s: float) -> None:
        """Handle received messages; wait up to ``timeout_s`` if there are none."""
        for key, _ in self._selector.select(timeout_s):
            found = key.fileobj
            assert isinstance(found, socket.socket)
            if found is self._listener:
                self._accept()
            elif self._program is not None and found is self._program.connection:
                self._take(self._program)
            elif found in self._waiting:
                self._take_first(found)

    # Connections

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # it has hung up
            return
        connection.setblocking(False)
        if not is_trusted(connection):
            connection.close()
            return
        if len(self._waiting) >= MAX_WAITING:
            self._forget(next(iter(self._waiting)))
        self._waiting[connection] = None
        self._selector.register(connection, selectors.EVENT_READ)

    def _forget(self, connection: socket.socket) -> None:
        self._waiting.pop(connection, None)
        with contextlib.suppress(KeyError):
            self._selector.unregister(connection)
        connection.close()

    def _drop(self, why: str) -> None:
        program, self._program = self._program, None
        if program is None:
            return
        if why:
            self._say(f"{program.name}: {why}")
        if program.memory is not None:
            program.memory.close()
        self._forget(program.connection)

    def _take_first(self, connection: socket.socket) -> None:
        """Answer the first message of a connection."""
        try:
            data = connection.recv(wire.MAX_CONTROL_BYTES + 4)
        except OSError:
            data = b""
        if wire.kind_of(data) == wire.CONTROL:
            reply = json.dumps(self._control(data[4:])).encode()
            with contextlib.suppress(OSError):
                connection.send(reply)
            self._forget(connection)
            return
        hello = None
        with contextlib.suppress(ValueError):
            hello = wire.parsed(data)
        if not isinstance(hello, wire.Hello) or hello.magic != wire.MAGIC:
            self._forget(connection)
            return
        name = _printable(hello.application) or f"process {hello.process_id}"
        if hello.version != wire.VERSION:
            self._say(f"{name}: its layer is of another version of ocufilter")
        elif self._program is None:
            self._begin(connection, name, hello)
            return
        self._forget(connection)  # it tries again every second

    def _begin(self, connection: socket.socket, name: str, hello: wire.Hello) -> None:
        self._waiting.pop(connection, None)
        engine, graphics = _printable(hello.engine), _printable(hello.graphics)
        self._program = _Program(connection, name, engine, graphics)
        welcome = wire.Welcome(
            *(wire.WELCOME, wire.MAGIC, wire.VERSION),
            *(self._options.wait_ms, self._options.longest_age_ms),
            self._options.leave_quads,
        )
        self._say(f"{name}: connected")
        self._seeing.restart()
        self._look.restart()
        self._send(self._program, welcome)

    def _send(self, program: _Program, message: ctypes.Structure) -> None:
        try:
            program.connection.send(bytes(message))
        except OSError:  # also if it does not read: then it is not worth waiting for
            self._drop("disconnected")

    def _control(self, data: bytes) -> dict[str, Any]:
        """Answer a request of `ocufilter layer set` or `status`."""
        try:
            wanted = loads_bounded(data, max_bytes=wire.MAX_CONTROL_BYTES)
            if not isinstance(wanted, dict):
                raise ValueError(f"{wanted!r:.60}; allowed: a JSON object")
            for eye in EYES:
                text = wanted.get(eye)
                if isinstance(text, str):
                    self._change(eye, text)
                elif eye in wanted:
                    raise ValueError(f"{eye} is {text!r:.60}; allowed: text")
        except ValueError as error:
            return {"error": str(error)}
        return {
            "program": self._program.name if self._program else None,
            "graphics": self._program.graphics if self._program else None,
            **self.report(),
        }

    # Frames

    def _take(self, program: _Program) -> None:
        """Take the next message of the program."""
        try:
            data, descriptors, _, _ = socket.recv_fds(
                program.connection, ctypes.sizeof(wire.Frame) + 1, 1
            )
        except BlockingIOError:
            return
        except OSError:
            data, descriptors = b"", []
        try:
            if not data:
                self._drop("disconnected")
                return
            message = wire.parsed(data)
            if isinstance(message, wire.Memory) and len(descriptors) == 1:
                self._share(program, message, descriptors.pop())
            elif isinstance(message, wire.Frame):
                self._filter(program, message)
            else:
                raise ValueError("a message out of order")
        except ValueError as error:
            self._drop(f"disconnected, because it sent {error}")
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def _share(self, program: _Program, message: wire.Memory, descriptor: int) -> None:
        if not 1 <= message.size_bytes <= wire.MAX_SHARED_BYTES:
            os.close(descriptor)
            raise ValueError(f"shared memory of {message.size_bytes} bytes")
        try:
            memory = Slot.received(0, message.size_bytes, descriptor)
        except (OSError, ValueError):
            os.close(descriptor)
            raise ValueError("shared memory that is not sealed") from None
        if program.memory is not None:
            program.memory.close()
        program.memory = memory

    def _filter(self, program: _Program, frame: wire.Frame) -> None:
        begun_s = time.monotonic()
        if program.memory is None:
            raise ValueError("a frame without memory")
        check_frame(frame)
        images = FrameImages(program.memory, frame, program.engine)
        pictures = []
        for index, eye in enumerate(EYES):
            picture, note = images.picture(index, eye, self._options.flat_m)
            pictures.append(picture)
            self._tell_depth(program, note)
        is_filtered = self._see(program, frame, tuple(pictures), images, begun_s)
        self._count(frame, is_filtered)
        result = wire.Result(wire.RESULT, is_filtered, frame.frame_id)
        self._send(program, result)

    def _tell_depth(self, program: _Program, note: str) -> None:
        kind = without_numbers(note)  # a program may send other numbers in each frame
        if note and kind not in program.notes:
            program.notes.add(kind)
            self._say(f"{program.name}: depth: {note}")

    def _see(
        self,
        program: _Program,
        given: wire.Frame,
        pictures: tuple[RgbdPicture, ...],
        images: FrameImages,
        begun_s: float,
    ) -> bool:
        """Filter a frame; return whether it was."""
        if given.flags & wire.HAS_GAZE and "gaze" not in program.notes:
            program.notes.add("gaze")
            self._say(f"{program.name}: eyes are tracked")
            self.on_gaze()
        due = DueFrame(
            given.display_time_ns,
            True,
            tuple(picture.view for picture in pictures),
            tuple(given.head) if given.flags & wire.HAS_HEAD else None,
            _gaze_of(given),
            period_s=WAIT_S,
        )
        try:
            eyes = self._look.follow(due, pictures)
            frame = StereoFrame(due, pictures, eyes, begun_s)
            looked_s = time.monotonic()
            seen = self._seeing.see(frame)
        except (FilterError, ValueError) as error:
            self._say_once(f"a frame is not filtered: {error}")
            return False
        if self.on_frame is not None:
            self.on_frame(frame, seen)
        if seen is None or seen.frame is not frame:
            return False
        ratio = SPLIT_RATIO if self._options.split else 0.0
        for index, color in enumerate(seen.colors):
            if ratio and images.has_quads:  # they are not in the program's image
                images.put(index, pictures[index].color)
            images.put(index, cast("NDArray[Any]", color), ratio)  # as the input
        self._look.learn(pictures, eyes, seen.used_focus_dpt)
        took_ms = MS_PER_S * (time.monotonic() - begun_s)
        self._note(
            look_ms=MS_PER_S * (looked_s - begun_s), **seen.stages_ms, helper_ms=took_ms
        )
        self._tell_time(took_ms)
        return True

    def _tell_time(self, took_ms: float) -> None:
        """Report that results are too old, unless a few are."""
        limit_ms = self._options.longest_age_ms
        self._n_late = self._n_late + 1 if took_ms > limit_ms else 0
        if self._n_late == N_LATE:
            self._say(
                f"filtering a frame takes {took_ms:.0f} ms, and results are not shown "
                f"after {limit_ms} ms; reduce the program's resolution, or raise "
                "--max-age-ms"
            )

    def _note(self, **stages_ms: float) -> None:
        for name, time_ms in stages_ms.items():
            self._stages_ms.setdefault(name, deque(maxlen=N_TIMES)).append(time_ms)

    def _count(self, frame: wire.Frame, is_filtered: bool) -> None:
        self.n_frames += 1
        counted = (
            *(is_filtered, not is_filtered),
            *(frame.frames, frame.frames_filtered, frame.frames_fallback),
        )
        for name, count in zip(_COUNTS, counted, strict=True):
            self._counts[name] += count
        if frame.frames:
            self._note(
                **{
                    f"{name}_ms": getattr(frame, f"{name}_us")
                    / US_PER_MS
                    / frame.frames
                    for name in ("copy", "read", "upload", "other")
                }
            )

    def report(self) -> dict[str, Any]:
        """Return counts of frames, and times in ms."""
        return {
            **self._counts,
            "stages_ms": {
                name: percentiles(list(times))
                for name, times in self._stages_ms.items()
            },
        }


def _printable(name: bytes) -> str:
    """Return a name that may be written to a terminal."""
    return printable(name.decode(errors="replace"))


def _gaze_of(frame: wire.Frame) -> GazeSample | None:
    """Return the gaze that the eye tracker reports."""
    if not frame.flags & wire.HAS_GAZE:
        return None
    ahead = -rotation_of(frame.gaze)[:, 2]
    time_ns = frame.gaze_time_ns or frame.display_time_ns
    return GazeSample(*angles_of(ahead), at_s=time_ns / NS_PER_S)


# Profiles of both eyes, from options, files that change, and commands


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:  # while it is replaced
        return None
    return found.st_mtime_ns, found.st_size


class WatchedEyes(Eyes):
    """Eyes whose profiles may be files, which are read again when they change.

    The parameters are the same as for `Eyes`.
    """

    def __init__(self, options: EyeOptions, *others: Any) -> None:
        super().__init__(options, *others)
        self._files: dict[Eye, tuple[Path, tuple[int, int] | None]] = {}
        for eye in EYES:
            text = getattr(options, eye)
            self._watch(eye, options.profile if text is None else text)

    def _watch(self, eye: Eye, text: str) -> None:
        """Watch the file of an eye's profile if it is one."""
        path = Path(text)
        self._files.pop(eye, None)
        if not text.lstrip().startswith("{") and path.is_file():
            self._files[eye] = path, _stamp(path)

    def change_to(self, eye: Eye, text: str) -> None:
        """Change an eye's profile.

        Raises
        ------
        ValueError
            If the profile cannot be read.
        """
        profile = read_profile(text, f"--{eye}")
        self._watch(eye, text)
        self.change(eye, profile)

    def reread(self) -> None:
        """Read the files that have changed."""
        for eye, (path, seen) in list(self._files.items()):
            stamp = _stamp(path)
            if stamp is None or stamp == seen:
                continue
            self._files[eye] = path, stamp
            try:
                self.change_to(eye, str(path))
            except ValueError as error:
                self._say(f"{eye} eye is unchanged: {error}")
