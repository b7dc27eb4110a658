"""CURVE keys of ZeroMQ for clients on other machines, with a list of allowed clients.

The key folder (mode 0700) contains the service's key pair, ``server.toml``, and the
public key of each allowed client, in ``clients/``.  The client's own file (mode 0600)
contains its key pair and the service's public key.  The service has no copy of the
client's secret key.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import stat
import time
import tomllib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filter_service.atomic_files import write_atomically
from filter_service.log_lines import ONCE_A_SECOND

MAX_FILE_BYTES = 4096
"""Largest size of a key file; `KeyRing` writes 300 bytes."""

MAX_CLIENTS = 10_000
RESCAN_S = 1.0
"""Interval of checks for modified client files.  Added and removed files are detected
at once, by the modification time of the folder."""

RETRY_S = 0.1

OUT_OF_DESCRIPTORS = (errno.EMFILE, errno.ENFILE)

log = logging.getLogger("ocufilter")

KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
"""32 bytes in Z85 (ZeroMQ RFC 32)."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")

HEAD = "# A key of the ocufilter service.  Anyone who can read this file can use it.\n"


@dataclass(frozen=True)
class KeyPair:
    """A public and a secret key, in Z85."""

    public: str
    secret: str


@dataclass(frozen=True)
class ClientKey:
    """Keys of a client: its key pair, and the service's public key."""

    name: str
    pair: KeyPair
    server: str

    def use_on(self, socket: Any) -> None:
        """Set these keys on a ZeroMQ socket."""
        socket.curve_serverkey = self.server.encode()
        socket.curve_publickey = self.pair.public.encode()
        socket.curve_secretkey = self.pair.secret.encode()


def load_client_key(path: Path | str) -> ClientKey:
    """Read a client's key file, which `KeyRing.add` has written.

    Raises
    ------
    ValueError
        The file is not a valid key file.
    OSError
    """
    values = _read(Path(path), ("public", "secret", "server"))
    pair = KeyPair(values["public"], values["secret"])
    name = values.get("name", "client")
    if not isinstance(name, str):
        raise ValueError(f"{path}: 'name' is {name!r:.60}; expected text")
    return ClientKey(name, pair, values["server"])


class KeyRing:
    """The key folder of a service.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._clients = self.folder / "clients"
        self._keys: dict[str, tuple[tuple[int, ...], str | None]] = {}  # by file name
        self._allowed: frozenset[str] = frozenset()
        self._folder_stamp_ns = -1
        self._next_scan_s = self._retry_s = 0.0

    @property
    def server(self) -> KeyPair:
        """Return the service's key pair.

        Raises
        ------
        ValueError, OSError
        """
        values = _read(self.folder / "server.toml", ("public", "secret"))
        return KeyPair(values["public"], values["secret"])

    def check(self) -> None:
        """Check the permissions and the service's key pair.

        Raises
        ------
        ValueError, OSError
            Other users can write to the folder or read the service's key, or the public
            and the secret key do not match.
        """
        if not (self.folder / "server.toml").is_file():
            raise ValueError(
                f"{self.folder} has no server.toml; expected a folder that "
                "`ocufilter keys add NAME` has created"
            )
        for path, bad_bits, what in (
            (self.folder, 0o022, "other users can change it"),
            (self.folder / "server.toml", 0o077, "other users can read it"),
        ):
            mode = stat.S_IMODE(path.stat().st_mode)
            if mode & bad_bits:
                good = 0o600 if path.suffix else 0o700
                raise ValueError(
                    f"{path} has mode {mode:04o}: {what}; expected {good:04o} "
                    f"(chmod {good:o} '{path}')"
                )
        pair = self.server
        if _public_of(pair.secret) != pair.public:
            raise ValueError(
                f"{self.folder / 'server.toml'}: 'public' does not belong to 'secret'; "
                "expected a pair that `ocufilter keys` has created"
            )

    def create(self) -> KeyPair:
        """Return the service's key pair; create folder and key pair if missing."""
        self._clients.mkdir(parents=True, exist_ok=True)
        self.folder.chmod(0o700)
        file = self.folder / "server.toml"
        if not file.exists():
            pair = _new_pair()
            values = {"public": pair.public, "secret": pair.secret}
            with suppress(FileExistsError):  # created by another process meanwhile
                _write(file, values)
        return self.server

    def add(self, name: str, client_file: Path) -> ClientKey:
        """Add a client, and write its key file.

        Raises
        ------
        ValueError
            The name is not a valid file name, or the client already exists.
        OSError
            The key file cannot be written, or already exists.
        """
        file = self._file_of(name)
        if file.exists():
            raise ValueError(f"client {name!r} already exists: remove it first")
        key = ClientKey(name, _new_pair(), self.create().public)
        _write(
            client_file,
            {
                "name": name,
                "public": key.pair.public,
                "secret": key.pair.secret,
                "server": key.server,
            },
        )
        _write(file, {"public": key.pair.public})
        return key

    def remove(self, name: str) -> None:
        """Remove a client; a running service disconnects it.

        Raises
        ------
        ValueError
            There is no client of that name.
        """
        file = self._file_of(name)
        if not file.exists():
            names = ", ".join(self.names()) or "nobody"
            raise ValueError(f"unknown client {name!r}; existing clients: {names}")
        file.unlink()

    def names(self) -> list[str]:
        """Return the names of the allowed clients."""
        return sorted(file.stem for file in self._clients.glob("*.toml"))

    def allowed(self) -> frozenset[str]:
        """Return the public keys of the allowed clients, including recent changes.

        Invalid key files are skipped and logged once.  If the folder cannot be read,
        the previous keys remain allowed.
        """
        now_s = time.monotonic()
        if now_s < self._retry_s:
            return self._allowed
        try:
            stamp_ns = self._clients.stat().st_mtime_ns
            if stamp_ns != self._folder_stamp_ns or now_s >= self._next_scan_s:
                self._scan()
                self._folder_stamp_ns = stamp_ns
                self._next_scan_s = now_s + RESCAN_S
        except OSError as error:
            self._retry_s = now_s + RETRY_S
            log.warning(
                *("%s cannot be read (%s)", self._clients, error.strerror),
                extra=ONCE_A_SECOND,
            )
        return self._allowed

    def _scan(self) -> None:
        """Read new and changed files."""
        found: dict[str, tuple[tuple[int, ...], str | None]] = {}
        with os.scandir(self._clients) as entries:
            names = sorted(e.name for e in entries if e.name.endswith(".toml"))
        if len(names) > MAX_CLIENTS:
            log.warning(
                "%s: only the first %d keys are used", self._clients, MAX_CLIENTS
            )
        for name in names[:MAX_CLIENTS]:
            path = self._clients / name
            try:
                status = path.stat()
                identity = _stamp(status)
                known = self._keys.get(name)
                if known is not None and known[0] == identity:
                    found[name] = known
                    continue
                found[name] = identity, _read(path, ("public",))["public"]
            except (ValueError, OSError) as error:
                if isinstance(error, OSError) and error.errno in OUT_OF_DESCRIPTORS:
                    raise
                if isinstance(error, FileNotFoundError) and not path.is_symlink():
                    continue  # removed meanwhile
                identity = _stamp(path.lstat())  # exists even for a dangling link
                if (self._keys.get(name) or (None,))[0] != identity:
                    log.warning("skipped an invalid key file: %s", error)
                found[name] = identity, None
        self._keys = found
        keys = (key for _, key in found.values())
        self._allowed = frozenset(key for key in keys if key is not None)

    def _file_of(self, name: str) -> Path:
        if not NAME.fullmatch(name):
            raise ValueError(
                f"the name is {name!r}; allowed: up to 64 letters, digits, '_', '.', "
                "'-', a letter or digit first"
            )
        return self._clients / f"{name}.toml"


def _new_pair() -> KeyPair:
    import zmq

    public, secret = zmq.curve_keypair()
    return KeyPair(public.decode(), secret.decode())


def _public_of(secret: str) -> str:
    import zmq

    return zmq.curve_public(secret.encode()).decode()


def _stamp(status: os.stat_result) -> tuple[int, ...]:
    """Return values that differ once a file has changed."""
    return status.st_ino, status.st_mtime_ns, status.st_size


def _read(path: Path, wanted: tuple[str, ...]) -> dict[str, Any]:
    """Read a key file; never block on a pipe, and limit the size."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError(f"{path} is not a regular file; expected a key file")
        content = os.read(descriptor, MAX_FILE_BYTES + 1)
    finally:
        os.close(descriptor)
    if len(content) > MAX_FILE_BYTES:
        raise ValueError(
            f"{path} has more than {MAX_FILE_BYTES} bytes; expected a key file"
        )
    try:
        values = tomllib.loads(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not a key file: {error}") from None
    for name in wanted:
        if not isinstance(values.get(name), str) or not KEY.fullmatch(values[name]):
            raise ValueError(f"{path}: {name!r} is not a key of 40 characters (Z85)")
    return values


def _write(path: Path, values: dict[str, str]) -> None:
    """Write a new file atomically; only its owner can access it."""
    text = HEAD + "".join(f"{name} = '{value}'\n" for name, value in values.items())
    write_atomically(path, text, is_new=True)
