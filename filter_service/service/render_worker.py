"""Event loop of a render worker, which filters frames that the front end sends.

The front end owns the socket and the sessions, the worker the eyes of the sessions.
Sending never blocks.  Each process survives a restart of the other: the worker reports
its eyes to a new front end.

Messages from the front end:

- ``("slot", number, size)`` with a descriptor; ``("drop_slot", number)``
- ``("texture", key, request)`` with a descriptor; ``("drop_texture", key, number)``;
  ``("drop_textures", key)``
- ``("open", key, session_id, generations)``, where ``generations`` belong to the
  session's eyes; ``("close", key)``
- ``("profile", key, request)``
- ``("frame", number, key, header, places, sizes)``, where ``header`` was received from
  the client, ``places`` are those of the header if None, and ``sizes`` refer to
  compressed parts

Messages to the front end:

- ``("started", server, eyes, can_interrupt, texture_support)``, the first one
- ``("texture_reply", key, number, reason)``, with a reason if it is not imported
- ``("profile_reply", key, eye, reply)``
- ``("profile_used", key, used_s)``, the processor time of reading a profile, before the
  reply
- ``("frame_reply", number, reply, started_s, ended_s, used_s, blocks_bytes)``; a result
  is the map of its header fields
- ``("state", memory, is_building)``, with `WorkerMemory`
"""

from __future__ import annotations

import logging
import os
import selectors
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from estimator.profiles.parse import EyeProfile
from filter_service.errors import FilterError, NoProfile, NoSession, RenderFailed
from filter_service.filtering.builder import Builder
from filter_service.heap import resident_memory_mb, trim_heap
from filter_service.messages import (
    Dropped,
    ErrorReply,
    EyeName,
    Frame,
    ProfileRequest,
    Reply,
    Result,
    SharedPlaces,
    ShareTexture,
)
from filter_service.service.frame_reply import filter_in_slots, filter_in_textures
from filter_service.service.process_channel import (
    Link,
    LinkClosed,
    WorkerMemory,
)
from filter_service.service.profile_reader import ProfileReader, ReadProfile
from filter_service.service.session_eyes import SessionEyes
from filter_service.shared_memory import Slot
from filter_service.version import __version__
from filter_service.wire.requests import frame_of

IDLE_WAIT_S = 0.5
WORKER_POLL_S = 0.1
STATE_INTERVAL_S = 0.5
INTERRUPTION_INTERVAL_S = 0.01
"""Minimum time between two interruptions of a frame.  Beside a stream of 1280x720,
frames of 160x90 took 29 and 45 ms (median), and 154 and 118 without interruptions."""

LONG_FRAME_S = 0.2
"""Duration of a frame after which its interruptions also advance builds of eyes."""

TRIM_AFTER_S = 10.0
"""Time without a frame after which frame memory is returned to the system."""

log = logging.getLogger("ocufilter")


class RenderWorker:
    """Filters the frames received over a link.

    Parameters
    ----------
    builder : Builder
        Builder of all sessions' eyes; closed at the end of `run`.
    read_profile : callable
        ``read_profile(body)`` returns a parsed profile, or raises `FilterError`.
    max_cameras : int
        Number of cameras for which each eye stays prepared.
    """

    def __init__(
        self,
        builder: Builder,
        read_profile: Callable[[dict[str, Any]], EyeProfile],
        *,
        max_cameras: int,
    ) -> None:
        self._builder = builder
        builder.wakes_after_frames = False  # the reply goes first
        self._reader = ProfileReader(read_profile)
        self._max_cameras = max_cameras
        self._sessions: dict[str, SessionEyes] = {}
        self._slots: dict[int, Slot] = {}
        self._textures: dict[str, dict[int, Any]] = {}  # imported, by session key
        self._front_end: Link | None = None
        self._inbox: deque[tuple[Any, list[int]]] = deque()
        self._next_state_s = 0.0
        self._trim_at_s: float | None = None  # None while frames hold no memory
        self._frame_since_s: float | None = None  # start of the current frame
        self._interrupted_s = 0.0  # total duration of its interruptions
        self._next_interruption_s = 0.0
        self._listen: Callable[[], None] = lambda: None
        self._is_stopping = False
        self._can_interrupt = builder.engine.call_between(
            self._interrupt, INTERRUPTION_INTERVAL_S
        )

    def run(
        self,
        control: Link,
        handle_control: Callable[[Any, list[int]], bool],
        received: Iterable[tuple[Any, list[int]]] = (),
    ) -> None:
        """Serve until the supervisor sends stop or exits.

        Parameters
        ----------
        control : Link
            Link to the supervisor.
        handle_control : callable
            Handles a message of the supervisor; returns whether to continue.
        received : iterable of (message, descriptors), optional
            Messages of the supervisor that arrived during the start.
        """
        selector = selectors.DefaultSelector()

        def handle(messages: Iterable[tuple[Any, list[int]]]) -> None:
            for message, descriptors in messages:
                if not handle_control(message, descriptors):
                    self._is_stopping = True

        def listen() -> None:
            handle(control.receive())

        self._listen = listen
        try:
            self._builder.worker.start()
            handle(received)
            while not self._is_stopping:
                self._watch(selector, control)
                found = {key.fd for key, _ in selector.select(self._wait_s())}
                if control.fileno() in found:
                    listen()
                self._run_once()
        except LinkClosed:
            log.error("the supervisor exited")
        finally:
            self._close()

    def connect(self, front_end: Link) -> None:
        """Connect to a new front end after the previous one has exited."""
        if self._front_end is not None:
            self._front_end.close()
        self._front_end = front_end
        self._drop_slots()
        self._drop_all_textures()
        while self._inbox:  # of the previous front end
            for descriptor in self._inbox.popleft()[1]:
                os.close(descriptor)
        server = {
            "name": "ocufilter",
            "version": __version__,
            "engine": self._builder.engine_name,
            "renderer": self._builder.engine.name,
            "gl_renderer": self._builder.engine.name,  # for older clients
        }
        eyes = [(key, session.profiles) for key, session in self._sessions.items()]
        importer = self._builder.engine.importer
        support = None if importer is None else importer.support
        self._send(("started", server, eyes, self._can_interrupt, support))

    # Event loop

    def _watch(self, selector: selectors.BaseSelector, control: Link) -> None:
        wanted: dict[int, tuple[int, Link | None]] = {
            control.fileno(): (selectors.EVENT_READ, control)
        }
        wanted[self._builder.has_events.fileno()] = selectors.EVENT_READ, None
        if self._reader.file_descriptor is not None:
            wanted[self._reader.file_descriptor] = selectors.EVENT_READ, None
        if self._front_end is not None:
            events = selectors.EVENT_READ
            if self._front_end.has_unsent:
                events |= selectors.EVENT_WRITE
            wanted[self._front_end.fileno()] = events, self._front_end
        for key in list(selector.get_map().values()):
            # A link may have the descriptor of another that was closed meanwhile.
            if key.fd not in wanted or key.data is not wanted[key.fd][1]:
                selector.unregister(key.fileobj)
        known = selector.get_map()
        for descriptor, (events, link) in wanted.items():
            if descriptor not in known:
                selector.register(descriptor, events, link)
            elif known[descriptor].events != events:
                selector.modify(descriptor, events, link)

    def _wait_s(self) -> float:
        return WORKER_POLL_S if self._reader.needs_poll else IDLE_WAIT_S

    def _run_once(self, *, is_short: bool = False) -> None:
        if self._front_end is not None:
            try:
                self._front_end.flush()
                # Messages read during a frame must not overtake earlier ones.
                self._inbox.extend(self._front_end.receive())
                while self._inbox:
                    self._handle(*self._inbox.popleft())
            except LinkClosed:
                log.warning("the front end exited; waiting for its replacement")
                if self._front_end is not None:
                    self._front_end.close()
                self._front_end = None
        for key, request, found in self._reader.poll():
            self._accept_profile(key, request, found)
        if is_short:
            return
        if self._frame_since_s is not None:
            self._builder.let_thread_work()
        self._builder.deliver_all()
        if self._frame_since_s is None and self._is_time_to_trim:
            self._trim_at_s = None
            self._builder.trim()
            trim_heap()
        self._send_state()

    @property
    def _is_time_to_trim(self) -> bool:
        return self._trim_at_s is not None and time.monotonic() > self._trim_at_s

    def _interrupt(self) -> None:
        """Interrupt a frame to handle messages, which may filter a smaller frame.

        The pause after an interruption is at least as long as the interruption.  The
        frame holds references to its resources, so no message can free them.
        """
        begin_s = time.monotonic()
        since_s = self._frame_since_s
        if since_s is None or begin_s < self._next_interruption_s:
            return
        try:
            self._listen()
            self._run_once(is_short=begin_s < since_s + LONG_FRAME_S)
        except LinkClosed:
            self._is_stopping = True
        except Exception:  # must not propagate through the compiled loops
            log.exception("an interruption of a frame failed")
        end_s = time.monotonic()
        self._interrupted_s += end_s - begin_s
        self._next_interruption_s = end_s + (end_s - begin_s)

    def _send_state(self, *, is_due: bool = False) -> None:
        now_s = time.monotonic()
        if is_due or now_s >= self._next_state_s:
            self._next_state_s = now_s + STATE_INTERVAL_S
            is_building = self._builder.worker.is_busy
            memory = WorkerMemory(
                resident_memory_mb(),
                self._builder.stores_mb,
                self._builder.tables_mb,
                self._builder.engine.memory_mb,
            )
            self._send(("state", memory, is_building))

    def _send(self, message: tuple[Any, ...]) -> None:
        if self._front_end is None:
            return
        try:
            self._front_end.send(message)
        except LinkClosed:
            self._front_end.close()
            self._front_end = None

    def _close(self) -> None:
        for key in list(self._sessions):
            self._close_session(key)
        self._drop_all_textures()
        self._reader.close()
        self._builder.close()
        self._drop_slots()
        if self._front_end is not None:
            self._front_end.close()

    # Messages

    def _handle(self, message: tuple[Any, ...], descriptors: list[int]) -> None:
        kind, *rest = message
        if kind == "frame":
            self._filter(*rest)
        elif kind == "profile":
            self._read_profile(*rest)
        elif kind == "open":
            self._open_session(*rest)
        elif kind == "close":
            self._close_session(*rest)
        elif kind == "slot":
            number, size_bytes = rest
            self._slots[number] = Slot.received(number, size_bytes, *descriptors)
        elif kind == "drop_slot":
            self._slots.pop(rest[0]).close()
        elif kind == "texture":
            self._import_texture(*rest, *descriptors)
        elif kind == "drop_texture":
            key, number = rest
            self._release_texture(self._textures.get(key, {}).pop(number, None))
        elif kind == "drop_textures":
            self._drop_textures(*rest)

    def _drop_slots(self) -> None:
        for slot in self._slots.values():
            slot.close()
        self._slots = {}

    # Textures

    def _import_texture(self, key: str, request: ShareTexture, descriptor: int) -> None:
        """Import a texture of a session, or reply with the reason."""
        importer, reason = self._builder.engine.importer, ""
        assert importer is not None  # otherwise the front end offers no textures
        try:
            imported = importer.import_texture(request.memory, descriptor)
            self._textures.setdefault(key, {})[request.texture] = imported
        except Exception as error:
            if not isinstance(error, FilterError):
                log.exception("a texture could not be imported")
            reason = str(error)
        self._send(("texture_reply", key, request.texture, reason))

    def _release_texture(self, imported: Any) -> None:
        importer = self._builder.engine.importer
        if imported is not None and importer is not None:
            importer.release(imported)

    def _drop_textures(self, key: str) -> None:
        for imported in self._textures.pop(key, {}).values():
            self._release_texture(imported)

    def _drop_all_textures(self) -> None:
        for key in list(self._textures):
            self._drop_textures(key)

    # Sessions

    def _open_session(
        self, key: str, session_id: int, generations: dict[EyeName, int]
    ) -> None:
        self._close_session(key)
        self._sessions[key] = SessionEyes(
            session_id,
            self._builder,
            partial(self._send_profile_reply, key),
            max_cameras=self._max_cameras,
            generations=generations,
        )

    def _close_session(self, key: str) -> None:
        self._drop_textures(key)
        self._reader.forget(key)
        session = self._sessions.pop(key, None)
        if session is not None:
            session.close()

    def _read_profile(self, key: str, request: ProfileRequest) -> None:
        """Read a profile, or begin to."""
        if key in self._sessions:
            found = self._reader.submit(key, request)
            if found is not None:
                self._accept_profile(key, request, found)

    def _accept_profile(
        self, key: str, request: ProfileRequest, found: ReadProfile
    ) -> None:
        """Accept or reject a profile; its progress follows as events."""
        reply = self._sessions[key].accept_profile(request, found.found)
        self._send(("profile_used", key, found.used_s))
        self._send_profile_reply(key, request.eye, reply)
        self._send_state(is_due=True)

    def _send_profile_reply(self, key: str, eye: EyeName, reply: Reply) -> None:
        self._send(("profile_reply", key, eye, reply))

    # Frames

    def _filter(
        self,
        number: int,
        key: str,
        header: bytes,
        places: SharedPlaces | None,
        sizes_bytes: Sequence[int],
    ) -> None:
        """Filter a frame; a frame that interrupts another is not interrupted itself."""
        started_s, frame = time.monotonic(), frame_of(header)
        is_first = self._frame_since_s is None
        if is_first:
            self._frame_since_s, self._interrupted_s = started_s, 0.0
        try:
            reply, blocks_bytes = self._reply_to(key, frame, places, sizes_bytes)
            is_early = isinstance(reply, ErrorReply) and reply.code == NoProfile.code
            if is_early and self._reader.is_reading(key):
                reply = Dropped(frame.frame_id, "preparing")
        finally:
            interrupted_s = self._interrupted_s if is_first else 0.0
            if is_first:
                self._frame_since_s = None
        ended_s = time.monotonic()
        self._trim_at_s = ended_s + TRIM_AFTER_S
        used_s = ended_s - started_s - interrupted_s
        times_s = (started_s, ended_s, used_s)
        if isinstance(reply, Result):
            sent = reply.fields()
            self._send(("frame_reply", number, sent, *times_s, blocks_bytes))
            self._builder.prepare()
        else:
            self._send(("frame_reply", number, reply, *times_s, blocks_bytes))

    def _reply_to(
        self,
        key: str,
        frame: Frame,
        places: SharedPlaces | None,
        sizes_bytes: Sequence[int],
    ) -> tuple[Reply, list[int]]:
        """Return the reply to a frame; any failure becomes an error reply."""
        try:
            session = self._sessions.get(key)
            if session is None:
                raise NoSession("the session has ended")
            if frame.textures:
                found = self._textures.get(key, {})
                textures = {n: imported.texture for n, imported in found.items()}
                return filter_in_textures(session.filter_of, frame, textures), []
            places = places or frame.memory
            assert places is not None
            # References, because the front end may drop the slots during the frame.
            slots = self._slots[places.slot], self._slots[places.result_slot]
            return filter_in_slots(session.filter_of, frame, slots, places, sizes_bytes)
        except Exception as error:
            if not isinstance(error, FilterError):
                log.exception("a frame could not be filtered")
                error = RenderFailed(f"{type(error).__name__}: {error}")
            return ErrorReply.from_exception(error, frame_id=frame.frame_id), []
