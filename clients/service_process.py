"""Filter service in a child process, for the demo, benchmarks and tests."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from filter_service.waiting import Wait

SERVE_COMMAND = (sys.executable, "-m", "filter_service", "serve")
CHECKOUT = Path(__file__).resolve().parents[1]
# `-m` finds our packages in a checkout, and installed packages from any folder.
SERVICE_FOLDER = CHECKOUT if (CHECKOUT / "pyproject.toml").is_file() else None
POLL_S = 0.02
LOG_TAIL_CHARACTERS = 2000


class ServiceProcess:
    """`ocufilter serve` on a free local port.

    Parameters
    ----------
    settings : mapping, optional
        Fields of the configuration file of the service.
    command : sequence of str
        Command to start; ``--config FILE`` is appended.
    start_timeout_s : float
        Longest time without output of the service before it is ready.
    wait : bool
        Whether to wait until the service is ready; otherwise call `await_ready`.

    Examples
    --------
    >>> with ServiceProcess() as service:  # doctest: +SKIP
    ...     client = FilterClient(service.endpoint)
    """

    def __init__(
        self,
        settings: Mapping[str, Any] | None = None,
        *,
        command: Sequence[str] = SERVE_COMMAND,
        start_timeout_s: float = 60.0,
        wait: bool = True,
    ) -> None:
        self.endpoint = ""
        self._folder = tempfile.TemporaryDirectory(prefix="ocufilter-")
        folder = Path(self._folder.name)
        self._ready_file = folder / "ready"
        self._log_file = folder / "log"
        self.config_file = folder / "service.toml"
        merged = {"bind": "tcp://127.0.0.1:*"} | dict(settings or {})
        merged["ready_file"] = str(self._ready_file)
        self.config_file.write_text(_as_toml(merged), encoding="utf-8")
        with self._log_file.open("wb") as log:
            self.process = subprocess.Popen(
                [*command, "--config", str(self.config_file)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=SERVICE_FOLDER,
            )
        if wait:
            self.await_ready(start_timeout_s)

    def __enter__(self) -> ServiceProcess:
        """Return the service, which is ready if ``wait`` was set."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Stop the service."""
        self.stop()

    @property
    def log(self) -> str:
        """Return the output of the service."""
        return self._log_file.read_text(encoding="utf-8", errors="replace")

    def pids(self) -> dict[str, int]:
        """Return process ids by name: supervisor, front-end and render (Linux only).

        A spare render process is named `standby`.  The render processes of several
        devices are named `render 0` and so on.
        """
        supervisor = self.process.pid
        found = {"supervisor": supervisor}
        children = (
            Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split()
        )
        for child in map(int, children):
            try:
                words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
            except FileNotFoundError:
                continue
            name = ""
            if b"filter_service.service.front_end" in words:
                name = "front-end"
            elif b"filter_service.service.render_worker_process" in words:
                name = words[-2].decode()  # the last argument; an empty word follows
            if name in found:
                name = name.replace("render", "standby")  # the older process filters
            if name:
                found[name] = child
        return found

    @property
    def memory_mb(self) -> float:
        """Return the memory in use by the processes of `pids` (Linux)."""
        kilobytes = 0
        for pid in self.pids().values():
            status = Path(f"/proc/{pid}/status").read_text().splitlines()
            line = next((li for li in status if li.startswith("VmRSS")), "VmRSS: 0")
            kilobytes += int(line.split()[1])
        return kilobytes / 1e3

    def stop(self, timeout_s: float = 10.0) -> int:
        """Stop the service with SIGTERM; return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()
            raise RuntimeError(
                f"the service did not end within {timeout_s:g} s of SIGTERM"
            ) from None
        self._folder.cleanup()
        return code

    def kill(self) -> None:
        """Kill the service, as a crash would."""
        self.process.kill()
        self.process.wait()
        self._folder.cleanup()

    def await_ready(self, timeout_s: float = 60.0) -> None:
        """Wait until the service accepts frames; kill it if it does not start.

        Parameters
        ----------
        timeout_s : float
            Longest time without output of the service.

        Raises
        ------
        RuntimeError
            If the service has ended, or wrote nothing for ``timeout_s``.  The message
            includes its output.
        """
        try:
            with Wait("Starting the service", timeout_s) as wait:
                self._await_ready(wait, timeout_s)
        except BaseException:
            self.kill()
            raise

    def _await_ready(self, wait: Wait, timeout_s: float) -> None:
        while not self._ready_file.exists():
            code = self.process.poll()
            if code is not None:
                raise RuntimeError(
                    f"the service ended with code {code} before it was ready: "
                    f"{self.log[-LOG_TAIL_CHARACTERS:].strip()}"
                )
            wait.update(self._log_file.stat().st_size)
            if wait.remaining_s <= 0.0:
                raise RuntimeError(
                    f"the service was not ready and wrote nothing for {timeout_s:g} s: "
                    f"{self.log[-LOG_TAIL_CHARACTERS:].strip()}"
                )
            time.sleep(POLL_S)
        self.endpoint = self._ready_file.read_text(encoding="utf-8").strip()


def _as_toml(settings: Mapping[str, Any]) -> str:
    # JSON of text, numbers, switches and lists is also TOML.
    return "".join(f"{name} = {json.dumps(v)}\n" for name, v in settings.items())
