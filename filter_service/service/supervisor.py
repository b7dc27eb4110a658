"""The supervisor: starts the processes of the service and restarts those that exit.

A new process gets links to the others, and a new front end gets the sessions of the
previous one.  A process that hangs or was stopped by a signal is killed and restarted.
A process that keeps exiting is restarted after increasing pauses; meanwhile its device
is out of service, if there are others, and its clients start sessions on those.  Once
the service has been ready, it keeps running whatever fails.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

from filter_service.atomic_files import write_atomically
from filter_service.building.worker_handle import (
    describe_exit,
    import_path,
    is_stopped,
    wait_or_kill,
)
from filter_service.log_lines import FORMAT_VARIABLE, configure_logging
from filter_service.service.config import ServiceConfig, changed_while_running
from filter_service.service.process_channel import Link, LinkClosed

FRONT_END_MODULE = "filter_service.service.front_end"
RENDER_MODULE = "filter_service.service.render_worker_process"
FRONT_END, RENDER = "front-end", "render"
OPEN_BUILDER = "filter_service.service.render_worker_process:open_configured_builder"
STABLE_S = 60.0
"""Run time after which the count of consecutive exits starts again."""

FIRST_PAUSE_S, MAX_PAUSE_S = 1.0, 60.0
"""Pause before a restart: none for the first two, then doubled each time."""

EXITS_WITHOUT_PAUSE = 2
GIVE_UP_DEVICE_EXITS = 4
"""Consecutive exits after which a device is out of service, if there are others."""

CHECK_INTERVAL_S = 0.5
STOPPED_LIMIT_S = 3.0
"""Time after which a process stopped by a signal is killed."""

STOP_GRACE_S = 2.0

STANDBY_AFTER_S = 5.0
"""Delay between the last start of a process and the start of a standby worker, so that
they do not compete for the processor."""

log = logging.getLogger("ocufilter")


class ServiceFailed(Exception):
    """A process of the service cannot start, or has kept exiting for too long."""


@dataclass
class _Process:
    """A process and the link to it."""

    process: subprocess.Popen[bytes] | None = None
    link: Link | None = None
    is_ready: bool = False
    stopped_since_s: float | None = None
    started_s: float = field(default_factory=time.monotonic)

    def send(self, message: object, descriptors: Sequence[int] = ()) -> None:
        """Send a message; ignore a closed link, which the next receive reports."""
        if self.link is not None:
            with suppress(LinkClosed):
                self.link.send(message, descriptors)

    def end(self) -> str:
        """Stop the process, by force after a grace period; describe its exit."""
        outcome = "did not start"
        if self.process is not None:
            outcome = describe_exit(wait_or_kill(self.process, STOP_GRACE_S))
        if self.link is not None:
            self.link.close()
        return outcome


@dataclass
class _Restarts:
    """Consecutive exits of one process, and the time of its next start."""

    n_exits: int = 0
    failing_since_s: float | None = None
    due_s: float | None = None

    def record_exit(self, started_s: float, now_s: float) -> float:
        """Count an exit; return the pause before the restart."""
        if now_s - started_s > STABLE_S:
            self.n_exits, self.failing_since_s = 0, None
        self.n_exits += 1
        if self.failing_since_s is None:
            self.failing_since_s = now_s
        n_paused = self.n_exits - EXITS_WITHOUT_PAUSE
        doubled_s = FIRST_PAUSE_S * 2.0 ** min(n_paused - 1, 10)
        pause_s = min(doubled_s, MAX_PAUSE_S) if n_paused > 0 else 0.0
        self.due_s = now_s + pause_s
        return pause_s


class Supervisor:
    """Runs the front end and a render worker for each device.

    Parameters
    ----------
    config : ServiceConfig
    open_builder : str
        ``module:function`` that opens the builder, see `render_worker_process`.
    on_ready : callable
        Called with the endpoint whenever the service becomes ready for frames.
    on_not_ready : callable
        Called when a process has exited and is not restarted at once.
    reload_config : callable, optional
        Returns the current settings.
    """

    def __init__(
        self,
        config: ServiceConfig,
        *,
        open_builder: str = OPEN_BUILDER,
        on_ready: Callable[[str], None],
        on_not_ready: Callable[[], None] = lambda: None,
        reload_config: Callable[[], ServiceConfig] | None = None,
    ) -> None:
        self._config = config
        self._open_builder = open_builder
        self._on_ready, self._on_not_ready = on_ready, on_not_ready
        self._was_ready = self._is_announced = False
        self._reload_config = reload_config
        self._is_reload_requested = False
        self._endpoint = ""
        self._is_stopping = False
        n_devices = len(config.device_names)
        # The index of each device, by the name of its process.
        self._devices = (
            {f"{RENDER} {index}": index for index in range(n_devices)}
            if n_devices > 1
            else {RENDER: 0}
        )
        self._processes = {name: _Process() for name in (FRONT_END, *self._devices)}
        self._standbys: dict[str, _Process] = {}
        self._lost: set[int] = set()  # devices that are out of service
        self._connected: set[int] = set()  # devices connected to the front end
        self._spawned_s = 0.0  # last start of any process
        self._restarts = {name: _Restarts() for name in self._processes}
        self._sessions: dict[str, bytes] = {}  # by key, for the next front end
        self._wake_reader, self._wake_writer = socket.socketpair()
        self._wake_reader.setblocking(False)
        self._wake_writer.setblocking(False)

    @property
    def wake_file_descriptor(self) -> int:
        """Return the descriptor that wakes the event loop when written to."""
        return self._wake_writer.fileno()

    def stop(self) -> None:
        """Make `run` return; may be called from a signal handler."""
        self._is_stopping = True

    def request_reload(self) -> None:
        """Request a reload of the settings; may be called from a signal handler."""
        self._is_reload_requested = True

    def run(self) -> None:
        """Run until `stop` is called.

        Raises
        ------
        ServiceFailed
            If a process cannot start the first time, or keeps exiting for longer than
            `give_up_after_s`.
        """
        try:
            for name in (*self._devices, FRONT_END):  # last, because it starts fastest
                self._start(name)
            while not self._is_stopping:
                try:
                    self._run_once()
                except OSError as error:
                    self._tolerate(error)
        finally:
            self._stop_all()

    def _tolerate(self, error: OSError) -> None:
        """Log an error of the operating system, if the service has been ready before.

        Raises
        ------
        ServiceFailed
            If it has not been ready yet.
        """
        if not self._was_ready:
            raise ServiceFailed(str(error)) from None
        log.error("a system call failed: %s", error)
        time.sleep(CHECK_INTERVAL_S)

    def _run_once(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake_reader, selectors.EVENT_READ)
            for process in self._all_processes:
                if process.link is not None:
                    selector.register(process.link, selectors.EVENT_READ)
            selector.select(self._wait_s())
        with suppress(BlockingIOError):
            self._wake_reader.recv(4096)
        if self._is_reload_requested:
            self._is_reload_requested = False
            self._apply_settings()
        for name, process in list(self._processes.items()):
            self._receive(name, process)
            self._check_stopped(name, process)
        for name, restarts in self._restarts.items():
            if restarts.due_s is not None and time.monotonic() >= restarts.due_s:
                restarts.due_s = None
                self._start(name)
        if self._config.standby:
            for name in list(self._devices):
                self._maintain_standby(name)

    def _wait_s(self) -> float:
        now_s = time.monotonic()
        due_s = [
            r.due_s - now_s for r in self._restarts.values() if r.due_s is not None
        ]
        return max(0.0, min([CHECK_INTERVAL_S, *due_s]))

    @property
    def _all_processes(self) -> list[_Process]:
        return [*self._processes.values(), *self._standbys.values()]

    def _start(self, name: str) -> None:
        """Start a process, or promote its standby."""
        standby = self._standbys.pop(name, None)
        try:
            self._processes[name] = standby or self._spawn(name)
            self._connect(name)
        except OSError as error:  # out of memory, processes or descriptors
            if not self._was_ready:
                raise ServiceFailed(f"its {name} process: {error}") from None
            self._processes[name].end()
            self._schedule_restart(
                name, time.monotonic(), f"cannot be started ({error})"
            )

    def _spawn(self, name: str) -> _Process:
        self._spawned_s = time.monotonic()
        link, theirs = Link.pair()
        # A new front end listens on the endpoint of the previous one.
        config = replace(self._config, bind=self._endpoint or self._config.bind)
        module, arguments = FRONT_END_MODULE, [str(theirs.fileno())]
        if name in self._devices:
            config = config.for_device(self._devices[name])
            module, arguments = RENDER_MODULE, [*arguments, self._open_builder, name]
        started = subprocess.Popen(
            # Without -P, files in the current folder would shadow modules of the same
            # name.
            [sys.executable, "-P", "-m", module, *arguments],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(import_path())},
        )
        theirs.close()
        process = _Process(started, link)
        process.send(("config", config))
        if name == FRONT_END:
            process.send(("sessions", list(self._sessions.values())))
        return process

    def _maintain_standby(self, name: str) -> None:
        """Keep a standby render worker running, with its own build worker."""
        standby = self._standbys.get(name)
        if standby is None:
            is_quiet = time.monotonic() - self._spawned_s > STANDBY_AFTER_S
            if is_quiet and self._processes[name].is_ready:
                self._standbys[name] = self._spawn(name)
            return
        try:
            if standby.link is not None:
                standby.is_ready |= any(
                    message[0] == "ready" for message, _ in standby.link.receive()
                )
            self._check_stopped("standby", standby)
        except LinkClosed:
            del self._standbys[name]
            log.error("the standby process %s; starting a new one", standby.end())

    def _apply_settings(self) -> None:
        """Reload the settings; warn about changes that require a restart."""
        if self._reload_config is None:
            return
        try:
            wanted = self._reload_config()
        except (ValueError, OSError) as error:
            log.error("the settings are unchanged: %s", error)
            return
        self._config, changed, others = changed_while_running(self._config, wanted)
        for name in changed:
            log.info("%s is now %s", name, getattr(self._config, name))
        if others:
            log.warning(
                "%s: takes effect after a restart of the service", ", ".join(others)
            )
        if changed:
            self._processes[FRONT_END].send(("config", self._config))

    def _connect(self, new: str) -> None:
        """Connect a new worker to the front end, or a new front end to all workers."""
        if self._processes[FRONT_END].link is None:
            return
        for name, index in self._devices.items():
            if new in (FRONT_END, name) and self._processes[name].link is not None:
                self._connected.discard(index)
                ours, theirs = socket.socketpair()
                self._processes[name].send(("link", index), [ours.fileno()])
                self._processes[FRONT_END].send(("link", index), [theirs.fileno()])
                ours.close()
                theirs.close()
        if new == FRONT_END:
            for index in self._lost:
                self._processes[FRONT_END].send(("lost", index))
            self._report_degraded()

    def _receive(self, name: str, process: _Process) -> None:
        try:
            if process.link is None:
                return
            for (kind, *rest), _ in process.link.receive():
                if kind == "ready":
                    process.is_ready = True
                    self._endpoint = rest[0] or self._endpoint
                    self._report_ready(name)
                elif kind == "connected":
                    self._connected.add(rest[0])
                    self._announce()
                elif kind == "failed":
                    self._fail(name, process, rest[0])
                    return
                elif kind == "hung":
                    self._kill_device(rest[0])
                elif kind == "session":
                    self._store_session(*rest)
        except LinkClosed:
            self._restart(name, process)

    def _store_session(self, key: str, record: bytes | None) -> None:
        if record is None:
            self._sessions.pop(key, None)
        else:
            self._sessions[key] = record

    def _report_ready(self, name: str) -> None:
        index = self._devices.get(name)
        if index in self._lost:
            self._lost.discard(index)
            self._processes[FRONT_END].send(("recovered", index))
            log.info("the %s process is running again", name)
        self._report_degraded()
        self._announce()

    def _announce(self) -> None:
        """Report that the service is ready, once all processes are connected."""
        if (
            not self._is_announced
            and all(process.is_ready for process in self._processes.values())
            and self._connected == set(self._devices.values())
        ):
            self._is_announced = True
            self._on_ready(self._endpoint)
            self._was_ready = True

    def _report_degraded(self) -> None:
        """Tell the front end whether a process has been down for several restarts."""
        is_degraded = bool(self._lost) or any(
            restarts.n_exits > EXITS_WITHOUT_PAUSE
            and not self._processes[name].is_ready
            for name, restarts in self._restarts.items()
        )
        self._processes[FRONT_END].send(("degraded", is_degraded))

    def _restart(self, name: str, process: _Process) -> None:
        """Clean up after a process that has exited, and schedule its restart."""
        outcome = process.end()
        if name in self._standbys:
            log.error(
                "the %s process %s; the standby process takes over", name, outcome
            )
            self._restarts[name].due_s = time.monotonic()
            self._processes[name] = _Process()
            return
        self._schedule_restart(name, process.started_s, outcome)

    def _schedule_restart(self, name: str, started_s: float, outcome: str) -> None:
        """Schedule the restart of a process.

        Raises
        ------
        ServiceFailed
            If the service has never been ready, or `give_up_after_s` has passed.
        """
        now_s, restarts = time.monotonic(), self._restarts[name]
        pause_s = restarts.record_exit(started_s, now_s)
        self._processes[name] = _Process()
        failing_s = now_s - (restarts.failing_since_s or now_s)
        limit_s = self._config.give_up_after_s
        if not self._was_ready:
            raise ServiceFailed(f"its {name} process {outcome} before it was ready")
        if limit_s and failing_s > limit_s:
            raise ServiceFailed(
                f"its {name} process {outcome}, repeatedly for {failing_s:.0f} s "
                f"(give_up_after_s is {limit_s:g})"
            )
        when = f"in {pause_s:g} s" if pause_s else "now"
        log.error("the %s process %s; starting a new one %s", name, outcome, when)
        if pause_s and self._is_announced:
            self._is_announced = False
            self._on_not_ready()
        index = self._devices.get(name)
        if index is not None and restarts.n_exits >= GIVE_UP_DEVICE_EXITS:
            self._give_up_device(name, index)
        self._report_degraded()

    def _give_up_device(self, name: str, index: int) -> None:
        """Take a device out of service, if there are others."""
        if index in self._lost or len(self._lost) + 1 >= len(self._devices):
            return
        log.error("the %s process is disabled until it stays up", name)
        self._lost.add(index)
        self._processes[FRONT_END].send(("lost", index))

    def _fail(self, name: str, process: _Process, reason: str) -> None:
        """Handle a process that reports that it cannot run.

        Raises
        ------
        ServiceFailed
            If the service has not been ready yet.
        """
        if not self._was_ready:
            raise ServiceFailed(reason)
        process.end()
        restarts = self._restarts[name]
        # An immediate restart would fail again.
        restarts.n_exits = max(restarts.n_exits, GIVE_UP_DEVICE_EXITS - 1)
        self._schedule_restart(name, time.monotonic(), f"cannot run ({reason})")

    def _check_stopped(self, name: str, process: _Process) -> None:
        """Kill a process that has been stopped by a signal for too long."""
        if process.process is None or not is_stopped(process.process.pid):
            process.stopped_since_s = None
            return
        now_s = time.monotonic()
        if process.stopped_since_s is None:
            process.stopped_since_s = now_s
        elif now_s - process.stopped_since_s > STOPPED_LIMIT_S:
            log.error("the %s process does not respond; killing it", name)
            process.process.kill()

    def _kill_device(self, index: int) -> None:
        for name, device_index in self._devices.items():
            process = self._processes[name].process
            if device_index == index and process is not None:
                process.kill()

    def _stop_all(self) -> None:
        """Stop all processes, by force after a grace period."""
        for process in self._all_processes:
            process.send(("stop",))
        for process in self._all_processes:
            process.end()
        self._wake_reader.close()
        self._wake_writer.close()


STDOUT = 1


def run(
    config: ServiceConfig,
    *,
    open_builder: str = OPEN_BUILDER,
    reload_config: Callable[[], ServiceConfig] | None = None,
) -> None:
    """Run the service until SIGINT or SIGTERM; print one line when ready.

    Call it from the main thread.

    Parameters
    ----------
    config : ServiceConfig
    open_builder : str
        ``module:function`` that opens the builder, see `render_worker_process`.
    reload_config : callable, optional
        Returns the current settings; called at SIGHUP.

    Raises
    ------
    OSError
        If the service cannot start, or has failed for too long.
    """
    os.environ[FORMAT_VARIABLE] = config.log_format  # for all processes
    configure_logging("service")
    supervisor = Supervisor(
        config,
        open_builder=open_builder,
        on_ready=ReadyAnnouncement(config).ready,
        on_not_ready=partial(_remove_ready_file, config),
        reload_config=reload_config,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: supervisor.stop())
    signal.signal(signal.SIGHUP, lambda *_: supervisor.request_reload())
    signal.set_wakeup_fd(supervisor.wake_file_descriptor, warn_on_full_buffer=False)
    try:
        supervisor.run()
    except ServiceFailed as error:
        raise OSError(str(error)) from None
    finally:
        signal.set_wakeup_fd(-1)
        _remove_ready_file(config)


class ReadyAnnouncement:
    """Reports that the service is ready: once on stdout, and in the ready file."""

    def __init__(self, config: ServiceConfig) -> None:
        self._config = config
        self._is_printed = False

    def ready(self, endpoint: str) -> None:
        """Print one line the first time, and write the ready file.

        A service that cannot print the line runs; one that cannot write the file does
        not start.

        Raises
        ------
        OSError
            If the ready file cannot be written.
        """
        if not self._is_printed:
            self._is_printed = True
            try:
                _print_line(f"ocufilter: serving on {endpoint}\n")
            except OSError as error:
                log.warning("stdout cannot be written: %s", error.strerror)
        if self._config.ready_file is not None:
            write_atomically(self._config.ready_file, endpoint + "\n")


def _print_line(line: str) -> None:
    """Write a line to stdout, unbuffered: otherwise Python fails again at exit.

    Raises
    ------
    OSError
        If the line cannot be written at once.
    """
    if not select.select([], [STDOUT], [], 0.0)[1]:
        raise BlockingIOError(errno.EAGAIN, "its reader does not read")
    os.write(STDOUT, line.encode())


def _remove_ready_file(config: ServiceConfig) -> None:
    if config.ready_file is not None:
        config.ready_file.unlink(missing_ok=True)
