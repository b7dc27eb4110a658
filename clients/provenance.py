"""What made a picture: version of the program, profile, and state of the eye."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from clients.version import __version__

CHECKOUT = Path(__file__).resolve().parents[1]
METADATA_KEY = "ocufilter"
"""Key of the JSON object in the metadata of a picture."""

_NAME = re.compile(r"[^\w.+-]+")


def fingerprint(plain: Mapping[str, Any]) -> str:
    """Return the SHA-256 of JSON-compatible values, in any order of keys."""
    text = json.dumps(plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def code_version() -> dict[str, str | None]:
    """Return the version of the package and, in a checkout, its commit."""
    return {"version": __version__, "commit": _commit()}


def _commit() -> str | None:
    if shutil.which("git") is None or not (CHECKOUT / ".git").exists():
        return None
    answer = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=12"],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=False,
    )
    return answer.stdout.strip() or None


def profile_name(text: str, body: Mapping[str, Any]) -> str:
    """Return a name for a profile that may be shown, and that a file may have.

    It is the name of a preset or schematic eye, the name of a file without its suffix,
    or the field ``name`` of JSON text.  The field ``name`` in a file is not used: it
    may be the name of a person.

    Parameters
    ----------
    text : str
        The profile on the command line.
    body : mapping
        The profile that was read from it.
    """
    if text.lstrip().startswith("{"):  # JSON
        name = str(body.get("name", "profile"))
    else:
        is_known = body.get("kind") in ("preset", "published")
        name = text if is_known else Path(text).stem
    return folder_name(name)


def folder_name(name: str) -> str:
    """Return a name without characters that are special in the names of folders."""
    return _NAME.sub("_", name).lstrip(".")


def profile_identity(name: str, body: Mapping[str, Any]) -> dict[str, str]:
    """Return the name of a profile and the SHA-256 of its fields."""
    return {"name": name, "sha256": fingerprint(body)}


def picture_metadata(
    made_by: Mapping[str, str | None],
    profile: Mapping[str, str],
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    more: Mapping[str, Any] | None = None,
) -> dict[str, str]:
    """Return the metadata of a filtered picture, as text by key.

    Parameters
    ----------
    made_by : mapping
        As `code_version` returns.
    profile : mapping
        As `profile_identity` returns.
    more : mapping, optional
        More facts, as JSON-compatible values.
    """
    facts = {
        "profile": dict(profile),
        "pupil_diameter_mm": pupil_diameter_mm,
        "focus_dpt": focus_dpt,
        **(more or {}),
    }
    return metadata_of(made_by, facts)


def metadata_of(
    made_by: Mapping[str, str | None], facts: Mapping[str, Any]
) -> dict[str, str]:
    """Return the program and JSON-compatible facts as metadata, as text by key."""
    commit, software = made_by.get("commit"), f"ocufilter {made_by.get('version')}"
    return {
        "Software": f"{software} ({commit})" if commit else software,
        METADATA_KEY: json.dumps({**made_by, **facts}),
    }
