"""`ocufilter eyes`: list and erase the eyes in the on-disk cache of a service."""

import os
import time
from pathlib import Path
from typing import Annotated

import typer

from clients.commands.console import Json, print_json, print_line
from filter_service.psfs.cache_folder import CACHE_VARIABLE

MB = 1e6
SHOWN_CHARACTERS = 12

Folder = Annotated[
    Path | None,
    typer.Option(
        "--dir",
        metavar="DIR",
        help=f"Cache folder (store_cache_dir of the service) [${CACHE_VARIABLE}].",
    ),
]

eyes = typer.Typer(
    help="List and erase the eyes cached on disk (`serve --keep-eyes DIR`).",
    no_args_is_help=True,
    rich_markup_mode=None,
)


def _folder(given: Path | None) -> Path:
    named = given or os.environ.get(CACHE_VARIABLE)
    if not named:
        raise ValueError(
            f"no cache folder; allowed: --dir DIR, or the variable {CACHE_VARIABLE}. A "
            "service caches eyes only with store_cache_dir or serve --keep-eyes"
        )
    return Path(named).expanduser()


@eyes.command(name="list")
def list_cached(folder: Folder = None, json_output: Json = False) -> None:
    """List the cached eyes by profile hash, most recently used first.

    ocufilter eyes list --dir ~/.cache/ocufilter
    """
    from filter_service.psfs.cached_eyes import cached_eyes

    found = cached_eyes(_folder(folder))
    if json_output:
        print_json({"eyes": [vars(eye) for eye in found]})
        return
    for eye in found:
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(eye.used_s))
        print(
            f"{eye.name[:SHOWN_CHARACTERS]}  {eye.n_files:3d} files  "
            f"{eye.size_bytes / MB:8.1f} MB  used {used}"
        )
    if not found:
        print("no eyes are cached")


@eyes.command()
def erase(
    profile: Annotated[
        str | None,
        typer.Argument(
            metavar="[PROFILE]", help="Preset or file, as for `ocufilter filter`."
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(metavar="HASH", help="Hash printed by `eyes list`.")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Erase all eyes.")] = False,
    folder: Folder = None,
    json_output: Json = False,
) -> None:
    """Erase the cached data of one eye, by profile or by hash, or of all eyes.

    ocufilter eyes erase anna.json --dir ~/.cache/ocufilter
    """
    from filter_service.psfs.cached_eyes import erase_eyes

    if (profile is not None) + (name is not None) + every != 1:
        raise ValueError(
            "no eye or several selected; allowed: one of PROFILE, --name HASH and --all"
        )
    prefix = name or ""
    if profile is not None:
        from estimator.profiles.files import load_profile
        from filter_service.psfs.store_cache import eye_name

        prefix = eye_name(load_profile(profile))
    elif name is not None and (not name or name.strip("0123456789abcdef")):
        raise ValueError(f"--name is {name!r}; allowed: a hash printed by `eyes list`")
    n_files = erase_eyes(_folder(folder), prefix)
    if json_output:
        print_json({"erased_files": n_files})
    else:
        print_line(f"{n_files} files erased" if n_files else "nothing was cached")
