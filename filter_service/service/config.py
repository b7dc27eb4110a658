"""Settings of the service, read from a TOML file and the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from estimator.bounded_files import MAX_BITS, read_toml
from estimator.threads import MAX_THREADS, thread_count
from filter_service.building.jobs import BuildLimits, default_cache_dir
from filter_service.constants import ENGINES
from filter_service.gl_device import checked_gl_device
from filter_service.log_lines import LOG_FORMATS
from filter_service.wire.message import DEFAULT_ENDPOINT, MAX_DEVICES, Limits

DEVICES_ALLOWED = (
    f"up to {MAX_DEVICES} of auto, native, native:THREADS (1 to {MAX_THREADS}), gl, "
    "gl:INDEX"
)


@dataclass(frozen=True)
class Device:
    """Engine and resources of one render worker.

    Attributes
    ----------
    engine, gl_device : str
        See the settings of the same names.
    threads : int, optional
        Number of threads; None: a share of all threads.
    """

    engine: str
    gl_device: str = "auto"
    threads: int | None = None


def device_named(text: str) -> Device:
    """Parse the name of a device.

    Raises
    ------
    ValueError
        If the name is invalid.
    """
    engine, colon, number = text.partition(":")
    is_number = number.isascii() and number.isdecimal()
    if engine in ENGINES and not colon:
        return Device(engine)
    if engine == "gl" and is_number:
        return Device(engine, gl_device=number)
    if engine == "native" and is_number and 1 <= int(number) <= MAX_THREADS:
        return Device(engine, threads=int(number))
    raise ValueError(
        f"unknown device {text!r:.100} in devices; allowed: {DEVICES_ALLOWED}"
    )


def check_devices(names: tuple[str, ...], *, engine: str, gl_device: str) -> None:
    """Check the names of devices, and that no other setting selects an engine.

    Raises
    ------
    ValueError
        If there are too many names, one is invalid, or ``engine`` or ``gl_device`` is
        set as well.
    """
    if len(names) > MAX_DEVICES:
        raise ValueError(f"devices has {len(names)} items; allowed: {DEVICES_ALLOWED}")
    for name in names:
        device_named(name)
    for setting, value in (("engine", engine), ("gl_device", gl_device)):
        if names and value != "auto":
            raise ValueError(
                f"{setting} is {value!r:.100}, but devices select their own engines; "
                "allowed with devices: auto"
            )


LOOPBACK_HOSTS = ("127.0.0.1", "[::1]", "localhost")
MB = 10**6
MAX_CONFIG_BYTES = 100_000
"""Size limit of a configuration file; one with every setting has 1 kB."""


@dataclass(frozen=True)
class ServiceConfig:
    """Settings of the service.

    Attributes
    ----------
    bind : str
        Endpoint to listen on: ``tcp://127.0.0.1:5577``, port ``*`` for any free port,
        or ``ipc://`` and a path.
    keys_dir : str
        Folder of keys, created by ``ocufilter keys``: only clients whose keys are in it
        are admitted, and traffic is encrypted.  Required for any interface but
        loopback; disables shared memory.
    credit : int
        Unanswered frames that a client may have.
    max_sessions : int
        Maximum number of clients served at once.
    max_width_px, max_height_px, max_views, max_part_mb, max_profile_kb : int
        Limits of one message; published in ``welcome``.
    max_blur_radius_px : int
        Largest kernel radius; a profile that needs a wider kernel is rejected.
    max_store_mb : int
        Memory for the PSFs of one profile; a profile that needs more is rejected.
    max_stores_mb : int
        Memory for the PSFs of all clients, on each device.  Beyond it, the least
        recently used PSFs are evicted and computed again when a frame needs them.
    engine : "auto", "gl" or "native"
        Engine that filters frames: compute shaders on a GPU, or compiled loops on all
        cores.  "auto" selects gl on a hardware GPU, otherwise native.
    gl_device : str
        Index of the EGL device for OpenGL; an index selects the engine gl.  "auto" is
        the first device that works, hardware before software.
    devices : tuple of str
        Devices that filter, each in a separate process behind one socket: up to
        eight of ``native``, ``native:THREADS``, ``gl``, ``gl:INDEX`` and ``auto``, as
        in ``devices = ["gl:0", "gl:1"]``.  A new session is assigned to the least busy
        device; a device that cannot be restarted is taken out of service.  Empty: one
        process, configured by ``engine`` and ``gl_device``.
    max_cameras : int
        Cameras that one session keeps prepared.
    store_cache_dir : str
        Cache folder for estimated eyes and the nodes of their PSFs.  ``""``, the
        default unless ``$OCUFILTER_CACHE_DIR`` names a folder, disables the cache.
    store_cache_max_mb : int
        Maximum size of that folder; the least recently used entries are evicted.
    threads : int
        CPU threads; 0 uses the cores available to this process, capped by a container's
        quota.  Devices share them, except devices that specify their own number.
    build_niceness : int
        Niceness of the process that estimates eyes while render workers filter.
    cancel_grace_s : float
        Time after which a canceled build that is still running is killed.
    build_limit_s : float
        Longest time without progress of a profile's build.
    alive_interval_s : float
        Interval between ``alive`` messages, which detect vanished clients.
    session_keep_s : float
        Time for which a disconnected client may resume its session.
    frame_limit_s : float
        Timeout of a render worker, for filtering one frame or anything else; a worker
        that does not respond for longer is restarted.
    give_up_after_s : float
        Time after which the service exits with an error if one of its processes keeps
        exiting; 0: never.  The process is restarted after pauses of up to a minute.
    standby : bool
        Keep a second render worker on standby for each device: after a fault of the
        first, frames resume a second sooner.  It takes a few hundred megabytes.
    max_image_mb : int
        Memory for the images of all frames and results, divided equally among the
        devices.
    shared_memory : bool
        Offer shared memory for images to clients of the same user on this machine.
    max_socket_mb : int
        Memory limit of the process that owns the socket, incomplete messages included;
        the process is restarted beyond it.
    log_format : "text" or "json"
        Format of the log: plain text, or one JSON object per line.
    metrics_port : int
        Port on 127.0.0.1 for metrics in the Prometheus format; 0 disables them.
    ready_file : Path, optional
        File that holds the bound endpoint while the service is ready.
    """

    bind: str = DEFAULT_ENDPOINT
    keys_dir: str = ""
    credit: int = 2
    max_sessions: int = 8
    max_width_px: int = 4096
    max_height_px: int = 4096
    max_views: int = 2
    max_part_mb: int = 100
    max_profile_kb: int = 1024
    max_blur_radius_px: int = 255
    max_store_mb: int = 2000
    max_stores_mb: int = 4000
    engine: str = "auto"
    gl_device: str = "auto"
    devices: tuple[str, ...] = ()
    max_cameras: int = 4
    store_cache_dir: str = default_cache_dir()
    store_cache_max_mb: int = 2000
    threads: int = 0
    build_niceness: int = 5
    cancel_grace_s: float = 3.0
    build_limit_s: float = 600.0
    alive_interval_s: float = 5.0
    session_keep_s: float = 30.0
    frame_limit_s: float = 60.0
    give_up_after_s: float = 0.0
    standby: bool = False
    max_image_mb: int = 2000
    shared_memory: bool = True
    max_socket_mb: int = 2000
    log_format: str = "text"
    metrics_port: int = 0
    ready_file: Path | None = None

    def __post_init__(self) -> None:
        """Raise ValueError, with the name of the setting, for invalid values."""
        _check_bind(self.bind, has_keys=bool(self.keys_dir))
        for name, allowed in (
            ("engine", ENGINES),
            ("log_format", LOG_FORMATS),
        ):
            if getattr(self, name) not in allowed:
                found = f"{name} is {getattr(self, name)!r:.100}"
                raise ValueError(f"{found}; allowed: {', '.join(allowed)}")
        checked_gl_device(self.gl_device)
        check_devices(self.devices, engine=self.engine, gl_device=self.gl_device)
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} is {value!r:.100}; allowed: {low} to {high}")

    @property
    def device_names(self) -> tuple[str, ...]:
        """Return the names of the devices; a single one is named after its engine."""
        return self.devices or (self.engine,)

    def for_device(self, index: int) -> ServiceConfig:
        """Return the settings for one device's process."""
        if not self.devices:
            return self
        device = device_named(self.devices[index])
        share = max(1, (self.threads or thread_count()) // len(self.devices))
        return replace(
            self,
            devices=(),
            engine=device.engine,
            gl_device=device.gl_device,
            threads=device.threads or share,
        )

    @property
    def limits(self) -> Limits:
        """Return the limits of one message."""
        return Limits(
            max_width_px=self.max_width_px,
            max_height_px=self.max_height_px,
            max_views=self.max_views,
            max_part_bytes=self.max_part_mb * MB,
            max_profile_bytes=self.max_profile_kb * 1024,
        )

    @property
    def build_limits(self) -> BuildLimits:
        """Return the limits of every build."""
        return BuildLimits(
            max_blur_radius_px=self.max_blur_radius_px,
            max_store_mb=self.max_store_mb,
            max_stores_mb=self.max_stores_mb,
            store_cache_dir=self.store_cache_dir,
            store_cache_max_mb=self.store_cache_max_mb,
        )

    @property
    def max_message_part_bytes(self) -> int:
        """Return the part size beyond which libzmq disconnects a client."""
        limits = self.limits
        return max(limits.max_part_bytes, limits.max_profile_bytes)


RANGES: dict[str, tuple[float, float]] = {
    "credit": (1, 16),
    "max_sessions": (1, 64),
    "max_width_px": (1, 16384),
    "max_height_px": (1, 16384),
    "max_views": (1, 8),
    "max_part_mb": (1, 2047),
    "max_profile_kb": (1, 1024),
    "max_blur_radius_px": (1, 255),
    "max_store_mb": (1, 1_000_000),
    "max_stores_mb": (1, 1_000_000),
    "max_cameras": (1, 16),
    "store_cache_max_mb": (1, 1_000_000),
    "threads": (0, MAX_THREADS),
    "build_niceness": (0, 19),
    "cancel_grace_s": (0.05, 600.0),
    "build_limit_s": (0.1, 86_400.0),
    "alive_interval_s": (0.05, 600.0),
    "metrics_port": (0, 65535),
    "session_keep_s": (0.0, 86_400.0),
    "frame_limit_s": (0.1, 3600.0),
    "give_up_after_s": (0.0, 86_400.0),
    "max_image_mb": (1, 1_000_000),
    "max_socket_mb": (200, 1_000_000),
}


CHANGEABLE = (
    *("credit", "max_sessions", "max_width_px", "max_height_px"),
    *("alive_interval_s", "session_keep_s", "frame_limit_s", "give_up_after_s"),
)
"""Settings that a running service reloads at SIGHUP.  A session keeps the values that
``welcome`` reported."""


REMOVED = {"psf_engine": "PSFs are computed on the processor, in C"}


def changed_while_running(
    config: ServiceConfig, wanted: ServiceConfig
) -> tuple[ServiceConfig, list[str], list[str]]:
    """Apply the wanted settings that may change while a service runs.

    Returns
    -------
    config : ServiceConfig
    changed, others : list of str
        Names of the settings that changed, and of those that require a restart.
    """
    differing = [
        field.name
        for field in fields(ServiceConfig)
        if getattr(config, field.name) != getattr(wanted, field.name)
    ]
    changed = [name for name in differing if name in CHANGEABLE]
    others = [name for name in differing if name not in CHANGEABLE]
    new = replace(config, **{name: getattr(wanted, name) for name in changed})
    return new, changed, others


def _check_bind(bind: object, *, has_keys: bool) -> None:
    if not isinstance(bind, str) or "://" not in bind:
        raise ValueError(
            f"bind is {bind!r:.100}; allowed: tcp://127.0.0.1:PORT or ipc://PATH"
        )
    transport, address = bind.split("://", 1)
    if transport == "ipc" and address:
        return
    if transport != "tcp":
        raise ValueError(
            f"bind is {bind!r:.100}; allowed: tcp://HOST:PORT or ipc://PATH"
        )
    host, _, port = address.rpartition(":")
    is_port = port == "*" or (port.isdigit() and int(port) < 65536)
    if not host or not is_port:
        raise ValueError(
            f"bind is {bind!r:.100}; allowed: tcp://HOST:PORT, PORT 0 to 65535 or *"
        )
    if host not in LOOPBACK_HOSTS and not has_keys:
        raise ValueError(
            f"bind is {bind!r:.100}, which other machines can reach: anyone who "
            "connects could use sessions of other clients and exhaust this machine's "
            "memory. Listen on tcp://127.0.0.1:PORT and let clients connect through an "
            "SSH tunnel, or create keys (`ocufilter keys add NAME`) and set keys_dir "
            "in the configuration file"
        )


def load_config(path: Path | str | None = None, **overrides: Any) -> ServiceConfig:
    """Read settings from a TOML file, overridden by arguments that are not None.

    Raises
    ------
    ValueError
        For an unknown setting, a wrong type or a value out of range; the message names
        the setting.  If the file cannot be read or is not TOML, the error is an
        `InvalidFile`.
    """
    settings: dict[str, Any] = {}
    if path is not None:
        settings = read_toml(Path(path), max_bytes=MAX_CONFIG_BYTES, option="config")
    settings |= {name: value for name, value in overrides.items() if value is not None}
    return ServiceConfig(**_typed(settings))


def _string_items(name: str, value: object) -> tuple[str, ...]:
    """Return the items of a list, or of a comma-separated string."""
    words = [w.strip() for w in value.split(",")] if isinstance(value, str) else value
    if isinstance(words, list | tuple) and all(type(word) is str for word in words):
        return tuple(words)
    raise ValueError(f"{name} is {value!r:.100}; allowed: a list of strings")


def _typed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Convert settings to the types of their fields."""
    defaults = {field.name: field.default for field in fields(ServiceConfig)}
    for name in REMOVED.keys() & settings.keys():
        raise ValueError(f"{name} was removed: {REMOVED[name]}; delete the setting")
    unknown = sorted(set(settings) - set(defaults))
    if unknown:
        raise ValueError(
            f"unknown setting {unknown[0]!r:.100}; allowed: {', '.join(defaults)}"
        )
    typed: dict[str, Any] = {}
    for name, value in settings.items():
        if name == "ready_file":
            if not isinstance(value, str | Path):
                raise ValueError(f"{name} is {value!r:.100}; allowed: str")
            typed[name] = Path(value)
            continue
        wanted = type(defaults[name])
        if wanted is float and type(value) is int and value.bit_length() <= MAX_BITS:
            value = float(value)
        if name == "gl_device" and type(value) is int:
            value = str(value)
        if name == "devices":
            value = _string_items(name, value)
        if type(value) is not wanted:
            raise ValueError(f"{name} is {value!r:.100}; allowed: {wanted.__name__}")
        typed[name] = value
    return typed
