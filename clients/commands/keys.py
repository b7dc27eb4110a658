"""`ocufilter keys`: manage the client keys of a service on a network."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from clients.commands.console import Json, print_json, print_line

if TYPE_CHECKING:
    from filter_service.keys import KeyRing

Folder = Annotated[
    Path | None,
    typer.Option(
        "--dir",
        metavar="DIR",
        help="Key folder; by default ocufilter/keys in $XDG_CONFIG_HOME.",
    ),
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Client name.")]

keys = typer.Typer(
    help="Create and revoke client keys, for a service that accepts other machines.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


def default_folder() -> Path:
    """Return the default key folder."""
    home = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(home) / "ocufilter" / "keys"


def _ring(folder: Path | None) -> "KeyRing":
    from filter_service.keys import KeyRing

    return KeyRing(folder or default_folder())


@keys.command()
def add(
    name: Name,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Key file to write; by default NAME.toml."),
    ] = None,
    folder: Folder = None,
    json_output: Json = False,
) -> None:
    """Authorize a client and write the key file that it connects with.

    Send the file to the client, and only to the client, over a secure channel.  A
    service that runs with this folder (keys_dir in its configuration) accepts the key
    at once.

    ocufilter keys add lab
    """
    ring, file = _ring(folder), out or Path(f"{name}.toml")
    key = ring.add(name, file)
    if json_output:
        print_json({"name": name, "public": key.pair.public, "file": str(file)})
        return
    print_line(
        f"{name} may connect with {file}; the service needs keys_dir = '{ring.folder}'"
    )


@keys.command()
def remove(name: Name, folder: Folder = None, json_output: Json = False) -> None:
    """Remove a client's key; a connected client is disconnected.

    ocufilter keys remove lab
    """
    _ring(folder).remove(name)
    if json_output:
        print_json({"removed": name})
    else:
        print_line(f"{name} can no longer connect")


@keys.command(name="list")
def list_names(folder: Folder = None, json_output: Json = False) -> None:
    """List the clients that may connect.

    ocufilter keys list
    """
    names = _ring(folder).names()
    if json_output:
        print_json({"names": names})
    else:
        print("\n".join(names) if names else "no client may connect yet")
