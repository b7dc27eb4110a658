"""The keeper: starts the processes of the service, and starts again what dies.

The door owns the socket, a render process the eyes, those of one device where there are
several.  Each outlives the others; a new one is given a link to those that are there.
What stands still for long, stopped from outside or hung, is ended and started again; a
device that cannot be is given up where others are left.  The keeper itself does nothing
else, so there is little that could end it.
"""

from __future__ import annotations

import logging
import os
import selectors
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

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
MAX_RESTARTS = 8
RESTART_WINDOW_S = 60.0
CHECK_INTERVAL_S = 0.5
STOPPED_LIMIT_S = 3.0
"""Stopped by a signal for longer, a process is taken for one that stays so."""

STOP_GRACE_S = 2.0

STANDBY_AFTER_S = 5.0
"""A process that stands by is started so long after the last one that filters: until
then that one, or its client, needs the processor."""

log = logging.getLogger("ocufilter")


class ServiceFailed(Exception):
    """A process of the service cannot start, or does not stay."""


@dataclass
class _Child:
    """A process, and the link to it."""

    process: subprocess.Popen[bytes] | None = None
    link: Link | None = None
    is_ready: bool = False
    stopped_since_s: float | None = None

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


class Keeper:
    """Keeps a door and a render process going, or one for each of several devices.

    Parameters
    ----------
    config : ServiceConfig
    open_workshop : str
        ``module:function``, see `render_process`.
    when_ready : callable
        Called with the endpoint once frames may come.
    read_again : callable, optional
        Returns the settings as they are now.
    """

    def __init__(
        self,
        config: ServiceConfig,
        *,
        open_workshop: str = OPEN_WORKSHOP,
        when_ready: Callable[[str], None],
        read_again: Callable[[], ServiceConfig] | None = None,
    ) -> None:
        self._config = config
        self._open_workshop = open_workshop
        self._when_ready: Callable[[str], None] | None = when_ready
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
        self._lost: list[int] = []  # devices that were given up
        self._spawned_s = 0.0  # the last process of all
        self._starts_s: dict[str, deque[float]] = {
            name: deque() for name in self._children
        }
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
            A process cannot start, or ends again and again.
        """
        try:
            for name in (*self._devices, DOOR):  # the last takes least
                self._start(name)
            self._join(DOOR)
            while not self._is_stopping:
                self._turn()
        finally:
            self._end_all()

    def _turn(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_reader, selectors.EVENT_READ)
            for child in self._all_children:
                if child.link is not None:
                    selector.register(child.link, selectors.EVENT_READ)
            selector.select(CHECK_INTERVAL_S)
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
        if self._config.standby:
            for name in list(self._devices):
                self._keep_standby(name)

    @property
    def _all_children(self) -> list[_Child]:
        return [*self._children.values(), *self._standbys.values()]

    def _start(self, name: str) -> None:
        """Start a process, or let the one that stands by take its place."""
        starts_s, now_s = self._starts_s[name], time.monotonic()
        starts_s.append(now_s)
        while now_s - starts_s[0] > RESTART_WINDOW_S:
            starts_s.popleft()
        if len(starts_s) > MAX_RESTARTS:
            raise ServiceFailed(
                f"its {name} process was started {MAX_RESTARTS} times within "
                f"{RESTART_WINDOW_S:g} s and ended each time"
            )
        standby = self._standbys.pop(name, None)
        self._children[name] = standby or self._spawned(name)

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
            self._bury("standby", standby)

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
        for name, index in self._devices.items():
            if new in (DOOR, name):
                ours, theirs = socket.socketpair()
                self._children[name].tell(("link", index), [ours.fileno()])
                self._children[DOOR].tell(("link", index), [theirs.fileno()])
                ours.close()
                theirs.close()
        for index in self._lost:
            self._children[DOOR].tell(("lost", index))

    def _listen(self, name: str, child: _Child) -> None:
        try:
            if child.link is None:
                return
            for (kind, *rest), _ in child.link.receive():
                if kind == "ready":
                    child.is_ready = True
                    self._endpoint = rest[0] or self._endpoint
                    self._tell_ready()
                elif kind == "failed":
                    self._fail(name, rest[0])
                    return
                elif kind == "hung":
                    self._kill_device(rest[0])
        except LinkClosed:
            self._restart(name, child)

    def _tell_ready(self) -> None:
        if self._when_ready is not None and all(
            child.is_ready for child in self._children.values()
        ):
            self._when_ready(self._endpoint)
            self._when_ready = None

    def _restart(self, name: str, child: _Child) -> None:
        self._bury(name, child)
        try:
            self._start(name)
        except ServiceFailed as error:
            self._fail(name, str(error))
            return
        self._join(name)

    def _fail(self, name: str, why: str) -> None:
        """Give up a device where others are left, once all had been ready.

        Raises
        ------
        ServiceFailed
            The service cannot go on.
        """
        if name not in self._devices or len(self._devices) < 2 or self._when_ready:
            raise ServiceFailed(why)
        log.error("the %s process is given up: %s", name, why)
        for child in (self._children.pop(name), self._standbys.pop(name, None)):
            if child is not None:
                child.end()
        self._lost.append(self._devices.pop(name))
        self._children[DOOR].tell(("lost", self._lost[-1]))

    def _bury(self, name: str, child: _Child) -> None:
        how = child.end()
        following = "a new one is started"
        if name in self._standbys:
            following = "the one that stood by takes over"
        log.error("the %s process %s; %s", name, how, following)

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
