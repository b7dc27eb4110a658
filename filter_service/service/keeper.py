"""The supervisor: starts the processes of the service and restarts those that end.

The door owns the socket, a render process the eyes, those of one device where there are
several.  Each outlives the others; a new one is given a link to those that are there,
and a new door the sessions that there were.  A process that hangs or was stopped is
killed and restarted.  Once the service has been ready, no fault ends it: a process that
ends again and again is restarted after ever longer pauses, and a device among several
is given up meanwhile, so that its sessions go to another one.
"""

from __future__ import annotations

import logging
import os
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from filter_service.building.helper_process import (
    end,
    how_it_ended,
    import_path,
    is_stopped,
)
from filter_service.service.config import ServiceConfig, changed_while_running
from filter_service.service.link import Link, LinkClosed

DOOR_MODULE = "filter_service.service.door_process"
RENDER_MODULE = "filter_service.service.render_process"
DOOR, RENDER = "door", "render"
OPEN_WORKSHOP = "filter_service.service.render_process:open_real_workshop"
STABLE_S = 60.0
"""A process that has run for so long starts a new row of deaths when it ends."""

FIRST_PAUSE_S, MAX_PAUSE_S = 1.0, 60.0
"""Before a restart: none the first two times, then ever twice as long."""

DEATHS_WITHOUT_PAUSE = 2
GIVE_UP_DEVICE_DEATHS = 4
"""Deaths in a row after which a device's sessions go to others, where there are any."""

CHECK_INTERVAL_S = 0.5
STOPPED_LIMIT_S = 3.0
"""Stopped by a signal for longer, a process is taken for one that stays so."""

STOP_GRACE_S = 2.0

STANDBY_AFTER_S = 5.0
"""A process that stands by is started so long after the last one that filters: until
then that one, or its client, needs the processor."""

log = logging.getLogger("ocufilter")


class ServiceFailed(Exception):
    """A process of the service cannot start, or does not stay for too long."""


@dataclass
class _Child:
    """A process, and the link to it."""

    process: subprocess.Popen[bytes] | None = None
    link: Link | None = None
    is_ready: bool = False
    stopped_since_s: float | None = None
    started_s: float = field(default_factory=time.monotonic)

    def tell(self, message: object, descriptors: Sequence[int] = ()) -> None:
        """Send a message; that a process is gone is found out by listening to it."""
        if self.link is not None:
            with suppress(LinkClosed):
                self.link.send(message, descriptors)

    def end(self) -> str:
        """End the process, with patience first; return how it ended."""
        how = "gone"
        if self.process is not None:
            how = how_it_ended(end(self.process, STOP_GRACE_S))
        if self.link is not None:
            self.link.close()
        return how


@dataclass
class _Restarts:
    """The deaths of one process, and when it is started next."""

    n_deaths: int = 0  # in a row
    failing_since_s: float | None = None
    due_s: float | None = None

    def note_death(self, started_s: float, now_s: float) -> float:
        """Count a death; return the pause before the restart."""
        if now_s - started_s > STABLE_S:
            self.n_deaths, self.failing_since_s = 0, None
        self.n_deaths += 1
        if self.failing_since_s is None:
            self.failing_since_s = now_s
        n_paused = self.n_deaths - DEATHS_WITHOUT_PAUSE
        doubled_s = FIRST_PAUSE_S * 2.0 ** min(n_paused - 1, 10)
        pause_s = min(doubled_s, MAX_PAUSE_S) if n_paused > 0 else 0.0
        self.due_s = now_s + pause_s
        return pause_s


class Keeper:
    """Keeps a door and a render process going, or one for each of several devices.

    Parameters
    ----------
    config : ServiceConfig
    open_workshop : str
        ``module:function``, see `render_process`.
    when_ready : callable
        Called with the endpoint once frames may come, and again after each time that
        they could not.
    when_not_ready : callable
        Called when a process has ended and is not restarted at once.
    read_again : callable, optional
        Returns the settings as they are now.
    """

    def __init__(
        self,
        config: ServiceConfig,
        *,
        open_workshop: str = OPEN_WORKSHOP,
        when_ready: Callable[[str], None],
        when_not_ready: Callable[[], None] = lambda: None,
        read_again: Callable[[], ServiceConfig] | None = None,
    ) -> None:
        self._config = config
        self._open_workshop = open_workshop
        self._when_ready, self._when_not_ready = when_ready, when_not_ready
        self._was_ready = self._is_announced = False
        self._read_again = read_again
        self._is_to_read_again = False
        self._endpoint = ""
        self._is_stopping = False
        n_devices = len(config.device_names)
        # The index of each device, by the name of its process.
        self._devices = (
            {f"{RENDER} {index}": index for index in range(n_devices)}
            if n_devices > 1
            else {RENDER: 0}
        )
        self._children = {name: _Child() for name in (DOOR, *self._devices)}
        self._standbys: dict[str, _Child] = {}
        self._lost: set[int] = set()  # devices that are given up for now
        self._met: set[int] = set()  # devices whose render process the door works with
        self._spawned_s = 0.0  # the last process of all
        self._restarts = {name: _Restarts() for name in self._children}
        self._sessions: dict[str, object] = {}  # by key, for the next door
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_reader.setblocking(False)
        self._wake_writer.setblocking(False)

    @property
    def wake_file_descriptor(self) -> int:
        """Return where a byte written ends the wait of the loop."""
        return self._wake_writer.fileno()

    def stop(self) -> None:
        """Let `run` return; may be called from a signal handler."""
        self._is_stopping = True

    def ask_to_read_again(self) -> None:
        """Have the settings read again; may be called from a signal handler."""
        self._is_to_read_again = True

    def run(self) -> None:
        """Serve until `stop`.

        Raises
        ------
        ServiceFailed
            A process cannot start the first time, or one ends again and again for
            longer than `give_up_after_s`.
        """
        try:
            for name in (*self._devices, DOOR):  # the last takes least
                self._start(name)
            while not self._is_stopping:
                try:
                    self._turn()
                except OSError as error:
                    self._bear(error)
        finally:
            self._end_all()

    def _bear(self, error: OSError) -> None:
        """Go on after the system has refused something, once all had been ready.

        Raises
        ------
        ServiceFailed
        """
        if not self._was_ready:
            raise ServiceFailed(str(error)) from None
        log.error("the system refused something (%s)", error)
        time.sleep(CHECK_INTERVAL_S)

    def _turn(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_reader, selectors.EVENT_READ)
            for child in self._all_children:
                if child.link is not None:
                    selector.register(child.link, selectors.EVENT_READ)
            selector.select(self._wait_s())
        try:
            self._wake_reader.recv(4096)
        except BlockingIOError:
            pass
        if self._is_to_read_again:
            self._is_to_read_again = False
            self._change_settings()
        for name, child in list(self._children.items()):
            self._listen(name, child)
            self._check_stopped(name, child)
        for name, restarts in self._restarts.items():
            if restarts.due_s is not None and time.monotonic() >= restarts.due_s:
                restarts.due_s = None
                self._start(name)
        if self._config.standby:
            for name in list(self._devices):
                self._keep_standby(name)

    def _wait_s(self) -> float:
        now_s = time.monotonic()
        due_s = [
            r.due_s - now_s for r in self._restarts.values() if r.due_s is not None
        ]
        return max(0.0, min([CHECK_INTERVAL_S, *due_s]))

    @property
    def _all_children(self) -> list[_Child]:
        return [*self._children.values(), *self._standbys.values()]

    def _start(self, name: str) -> None:
        """Start a process, or let the one that stands by take its place."""
        standby = self._standbys.pop(name, None)
        try:
            self._children[name] = standby or self._spawned(name)
            self._join(name)
        except OSError as error:  # no memory, processes or descriptors for it now
            if not self._was_ready:
                raise ServiceFailed(f"its {name} process: {error}") from None
            self._children[name].end()
            self._note_death(name, time.monotonic(), f"cannot be started ({error})")

    def _spawned(self, name: str) -> _Child:
        self._spawned_s = time.monotonic()
        link, theirs = Link.pair()
        # A new door listens where the one before it did.
        config = replace(self._config, bind=self._endpoint or self._config.bind)
        module, arguments = DOOR_MODULE, [str(theirs.fileno())]
        if name in self._devices:
            config = config.of_device(self._devices[name])
            module, arguments = RENDER_MODULE, [*arguments, self._open_workshop, name]
        process = subprocess.Popen(
            # Without -P a file of the current folder would come before every module of
            # its name.
            [sys.executable, "-P", "-m", module, *arguments],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(import_path())},
        )
        theirs.close()
        child = _Child(process, link)
        child.tell(("config", config))
        if name == DOOR:
            child.tell(("sessions", list(self._sessions.values())))
        return child

    def _keep_standby(self, name: str) -> None:
        """Have a second process ready to filter, with a worker of its own."""
        standby = self._standbys.get(name)
        if standby is None:
            is_quiet = time.monotonic() - self._spawned_s > STANDBY_AFTER_S
            if is_quiet and self._children[name].is_ready:
                self._standbys[name] = self._spawned(name)
            return
        try:
            if standby.link is not None:
                standby.is_ready |= any(
                    message[0] == "ready" for message, _ in standby.link.receive()
                )
            self._check_stopped("standby", standby)
        except LinkClosed:
            del self._standbys[name]
            log.error("the standby process %s; a new one is started", standby.end())

    def _change_settings(self) -> None:
        """Take what may change while the service runs; say what may not."""
        if self._read_again is None:
            return
        try:
            wanted = self._read_again()
        except (ValueError, OSError) as error:
            log.error("the settings stay as they are: %s", error)
            return
        self._config, changed, others = changed_while_running(self._config, wanted)
        for name in changed:
            log.info("%s is %s now", name, getattr(self._config, name))
        if others:
            log.warning("for %s the service has to be started again", ", ".join(others))
        if changed:
            self._children[DOOR].tell(("config", self._config))

    def _join(self, new: str) -> None:
        """Give the door, and each render process that it lacks, the ends of a link."""
        if self._children[DOOR].link is None:
            return
        for name, index in self._devices.items():
            if new in (DOOR, name) and self._children[name].link is not None:
                self._met.discard(index)
                ours, theirs = socket.socketpair()
                self._children[name].tell(("link", index), [ours.fileno()])
                self._children[DOOR].tell(("link", index), [theirs.fileno()])
                ours.close()
                theirs.close()
        if new == DOOR:
            for index in self._lost:
                self._children[DOOR].tell(("lost", index))
            self._tell_degraded()

    def _listen(self, name: str, child: _Child) -> None:
        try:
            if child.link is None:
                return
            for (kind, *rest), _ in child.link.receive():
                if kind == "ready":
                    child.is_ready = True
                    self._endpoint = rest[0] or self._endpoint
                    self._tell_ready(name)
                elif kind == "met":
                    self._met.add(rest[0])
                    self._announce()
                elif kind == "failed":
                    self._fail(name, child, rest[0])
                    return
                elif kind == "hung":
                    self._kill_device(rest[0])
                elif kind == "session":
                    self._keep_session(*rest)
        except LinkClosed:
            self._restart(name, child)

    def _keep_session(self, key: str, record: object | None) -> None:
        if record is None:
            self._sessions.pop(key, None)
        else:
            self._sessions[key] = record

    def _tell_ready(self, name: str) -> None:
        index = self._devices.get(name)
        if index in self._lost:
            self._lost.discard(index)
            self._children[DOOR].tell(("found", index))
            log.info("the %s process is there again", name)
        self._tell_degraded()
        self._announce()

    def _announce(self) -> None:
        """Say that frames may come, once the door would say so, too."""
        if (
            not self._is_announced
            and all(child.is_ready for child in self._children.values())
            and self._met == set(self._devices.values())
        ):
            self._is_announced = True
            self._when_ready(self._endpoint)
            self._was_ready = True

    def _tell_degraded(self) -> None:
        """Have the door say so while a process is down for longer than a restart."""
        is_degraded = bool(self._lost) or any(
            restarts.n_deaths > DEATHS_WITHOUT_PAUSE
            and not self._children[name].is_ready
            for name, restarts in self._restarts.items()
        )
        self._children[DOOR].tell(("degraded", is_degraded))

    def _restart(self, name: str, child: _Child) -> None:
        """Bury a process that has ended; have another one started when it is time."""
        how = child.end()
        if name in self._standbys:
            log.error("the %s process %s; the one that stood by takes over", name, how)
            self._restarts[name].due_s = time.monotonic()
            self._children[name] = _Child()
            return
        self._note_death(name, child.started_s, how)

    def _note_death(self, name: str, started_s: float, how: str) -> None:
        """Decide when a process is started again.

        Raises
        ------
        ServiceFailed
            It has never been ready, or the service is to give up by now.
        """
        now_s, restarts = time.monotonic(), self._restarts[name]
        pause_s = restarts.note_death(started_s, now_s)
        self._children[name] = _Child()
        failing_s = now_s - (restarts.failing_since_s or now_s)
        limit_s = self._config.give_up_after_s
        if not self._was_ready:
            raise ServiceFailed(f"its {name} process {how} before it was ready")
        if limit_s and failing_s > limit_s:
            raise ServiceFailed(
                f"its {name} process {how}; it has not stayed for {failing_s:.0f} s "
                f"(give_up_after_s is {limit_s:g})"
            )
        when = f"in {pause_s:g} s" if pause_s else "now"
        log.error("the %s process %s; a new one is started %s", name, how, when)
        if pause_s and self._is_announced:
            self._is_announced = False
            self._when_not_ready()
        index = self._devices.get(name)
        if index is not None and restarts.n_deaths >= GIVE_UP_DEVICE_DEATHS:
            self._give_up_device(name, index)
        self._tell_degraded()

    def _give_up_device(self, name: str, index: int) -> None:
        """Have the sessions of a device go to others, where there are any."""
        if index in self._lost or len(self._lost) + 1 >= len(self._devices):
            return
        log.error("the %s process is given up until it stays", name)
        self._lost.add(index)
        self._children[DOOR].tell(("lost", index))

    def _fail(self, name: str, child: _Child, why: str) -> None:
        """Handle a process that says that it cannot work.

        Raises
        ------
        ServiceFailed
            The service has not been ready yet.
        """
        if not self._was_ready:
            raise ServiceFailed(why)
        child.end()
        restarts = self._restarts[name]
        # It would say the same again at once.
        restarts.n_deaths = max(restarts.n_deaths, GIVE_UP_DEVICE_DEATHS - 1)
        self._note_death(name, time.monotonic(), f"cannot work ({why})")

    def _check_stopped(self, name: str, child: _Child) -> None:
        """End a process that was stopped by a signal and is not let go on."""
        if child.process is None or not is_stopped(child.process.pid):
            child.stopped_since_s = None
            return
        now_s = time.monotonic()
        if child.stopped_since_s is None:
            child.stopped_since_s = now_s
        elif now_s - child.stopped_since_s > STOPPED_LIMIT_S:
            log.error("the %s process stands still", name)
            child.process.kill()

    def _kill_device(self, index: int) -> None:
        for name, of_index in self._devices.items():
            process = self._children[name].process
            if of_index == index and process is not None:
                process.kill()

    def _end_all(self) -> None:
        """End all processes: asked first, by force where they take long."""
        for child in self._all_children:
            child.tell(("stop",))
        for child in self._all_children:
            child.end()
        self._wake_reader.close()
        self._wake_writer.close()
