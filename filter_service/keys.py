"""Keys for a service that other machines reach: ZeroMQ's CURVE, with a list of clients.

A folder, 0700, holds ``server.toml``, the service's pair, and in ``clients/`` the
public key of everyone who may connect.  A client's own file, 0600, has its pair and the
service's public key; the service keeps no copy of the secret.
"""

from __future__ import annotations

import os
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
"""32 bytes in Z85 (ZeroMQ RFC 32)."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")

HEAD = "# A key of the ocufilter service.  Whoever reads this file may use it.\n"


@dataclass(frozen=True)
class KeyPair:
    """A public key and its secret, Z85."""

    public: str
    secret: str


@dataclass(frozen=True)
class ClientKey:
    """What a client needs: its own pair, and the key by which it knows the service."""

    name: str
    pair: KeyPair
    server: str

    def use_on(self, socket: Any) -> None:
        """Have a ZeroMQ socket connect with this key."""
        socket.curve_serverkey = self.server.encode()
        socket.curve_publickey = self.pair.public.encode()
        socket.curve_secretkey = self.pair.secret.encode()


def load_client_key(path: Path | str) -> ClientKey:
    """Read the file that `KeyRing.add` has written.

    Raises
    ------
    ValueError
        It is no such file; says what is missing.
    OSError
    """
    values = _read(Path(path), ("public", "secret", "server"))
    pair = KeyPair(values["public"], values["secret"])
    return ClientKey(values.get("name", "client"), pair, values["server"])


class KeyRing:
    """The folder of a service's keys.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._clients = self.folder / "clients"
        self._allowed: frozenset[str] = frozenset()
        self._seen: object = None

    @property
    def server(self) -> KeyPair:
        """Return the service's pair.

        Raises
        ------
        ValueError, OSError
        """
        values = _read(self.folder / "server.toml", ("public", "secret"))
        return KeyPair(values["public"], values["secret"])

    def create(self) -> KeyPair:
        """Make the folder and the service's pair, unless it is there; return it."""
        self._clients.mkdir(parents=True, exist_ok=True)
        self.folder.chmod(0o700)
        file = self.folder / "server.toml"
        if not file.exists():
            pair = _new_pair()
            _write(file, {"public": pair.public, "secret": pair.secret})
        return self.server

    def add(self, name: str, client_file: Path) -> ClientKey:
        """Let a new client in; write the file that it is to be given.

        Raises
        ------
        ValueError
            A name that is no file's, or of a client that is there already.
        OSError
            Also where the file is there already.
        """
        file = self._file_of(name)
        if file.exists():
            raise ValueError(f"there is a client {name!r} already: remove it first")
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
        """Let a client in no more; a running service notices.

        Raises
        ------
        ValueError
            There is none of that name.
        """
        file = self._file_of(name)
        if not file.exists():
            names = ", ".join(self.names()) or "nobody"
            raise ValueError(f"there is no client {name!r}; allowed in: {names}")
        file.unlink()

    def names(self) -> list[str]:
        """Return the names of the clients that may connect."""
        return sorted(file.stem for file in self._clients.glob("*.toml"))

    def allowed(self) -> frozenset[str]:
        """Return the public keys of all clients, read again when the folder changes."""
        files = sorted(self._clients.glob("*.toml"))
        seen = [(str(file), file.stat().st_mtime_ns) for file in files]
        if seen != self._seen:
            self._allowed = frozenset(_read(f, ("public",))["public"] for f in files)
            self._seen = seen
        return self._allowed

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


def _read(path: Path, wanted: tuple[str, ...]) -> dict[str, str]:
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no key file: {error}") from None
    for name in wanted:
        if not isinstance(values.get(name), str) or not KEY.fullmatch(values[name]):
            raise ValueError(f"{path}: {name!r} is no key of 40 characters (Z85)")
    return values


def _write(path: Path, values: dict[str, str]) -> None:
    """Write a file that is its owner's alone from the start, and new."""
    text = HEAD + "".join(f"{name} = '{value}'\n" for name, value in values.items())
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    with os.fdopen(os.open(path, flags, 0o600), "w", encoding="utf-8") as file:
        file.write(text)
