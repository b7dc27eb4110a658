"""Resolve the pins of each extra and suite for the supported Pythons.

    python -m tests.release.pins

pip resolves `constraints.txt` only for the Python that runs it.  This check resolves it
with uv for the oldest patch release of each supported Python and for that of Debian 12.
"""

from __future__ import annotations

import os
import re
import subprocess
from concurrent.futures import ThreadPoolExecutor

from tests.release.commands import ROOT, TOOLS, Failed, say
from tests.release.requirements import project

PYTHONS = ("3.11.0", "3.11.2", "3.12.0", "3.13.0", "3.14.0")
PLATFORM = "x86_64-manylinux_2_28"
SOURCE_ONLY = ("prysm", "pyopengl")
"""Packages without wheels; all others must have one for each Python."""

SETUP_LISTS = ("DOCS", "RELEASE_CHECK", "RELEASE", "WORKFLOWS", "WITNESS", "PEERS")
"""setup.sh's lists of Python packages."""

SETUP_LISTS_OF = {"3.12.0": ("PEERS_312",)}
"""Lists that setup.sh installs with one Python only."""


def requirements(python: str) -> list[str]:
    """Return what all extras and suites require.

    Every version is pinned, so that packages that can be installed together can also
    be installed in parts.
    """
    table = project()
    found = [*table["dependencies"]]
    for listed in table["optional-dependencies"].values():
        found += listed
    text = (ROOT / "setup.sh").read_text(encoding="utf-8")
    for name in (*SETUP_LISTS, *SETUP_LISTS_OF.get(python, ())):
        words = re.search(rf'^{name}_PACKAGES="(.*)"$', text, re.MULTILINE)[1].split()
        found += [word for word in words if "$" not in word]
    return found


def resolve(python: str) -> str | None:
    """Return why the pins cannot be installed, or None."""
    environment = dict(os.environ)
    for pip_name, uv_name in (
        ("PIP_INDEX_URL", "UV_DEFAULT_INDEX"),
        ("PIP_CERT", "SSL_CERT_FILE"),
    ):
        if pip_name in environment:
            environment.setdefault(uv_name, environment[pip_name])
    command = [TOOLS / "uv", "pip", "compile", "--quiet", "--no-header", "-"]
    command += ["--system-certs"]  # as pip does
    command += ["--python-version", python, "--python-platform", PLATFORM]
    command += ["--constraints", "constraints.txt", "--only-binary", ":all:"]
    for name in SOURCE_ONLY:
        command += ["--no-binary", name]
    ran = subprocess.run(
        command,
        cwd=ROOT,
        env=environment,
        input="\n".join(requirements(python)),
        capture_output=True,
        text=True,
        timeout=600,
    )
    if ran.returncode == 0:
        return None
    return f"Python {python}: {ran.stderr.strip()}"


def check_pins() -> str:
    """Resolve all pins for all Pythons; return a line that says so.

    Raises
    ------
    Failed
        With the Pythons and causes.
    """
    say(f"resolving all pins for Python {', '.join(PYTHONS)}")
    with ThreadPoolExecutor(len(PYTHONS)) as pool:
        failures = [failure for failure in pool.map(resolve, PYTHONS) if failure]
    if failures:
        raise Failed("pins that cannot be installed:\n\n" + "\n\n".join(failures))
    return f"all pins install on Python {', '.join(PYTHONS)}"


if __name__ == "__main__":
    try:
        print(check_pins())
    except Failed as error:
        raise SystemExit(f"release: {error}") from None
