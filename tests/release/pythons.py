"""The wheel in empty environments of each Python at hand.

    python -m tests.release.pythons WHEEL [--python PATH ...] [--root FOLDER ...]
                                    [--only oldest|newest]

Without `--python`: each `python3.N` on the PATH, and those that pyenv installed.
`--root` names a folder with another system (`debootstrap`), whose `python3` is used;
this requires root.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import time
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tests.release import smoke
from tests.release.commands import BUILD, Failed, say
from tests.release.environment import Environment, Python

VERSIONS = ("3.11", "3.12", "3.13", "3.14")
ASK = "import sys; print('%d.%d' % sys.version_info[:2], sys.executable)"


def find_pythons(paths: list[str], roots: list[Path]) -> list[Python]:
    """Return one interpreter of each supported version."""
    candidates = list(paths)
    if not paths:
        pyenv = Path.home() / ".pyenv" / "versions"
        for version in VERSIONS:
            candidates += sorted(map(str, pyenv.glob(f"{version}.*/bin/python3")))
            candidates.append(f"python{version}")
    asked = [(None, [path]) for path in candidates]
    asked += [(root, ["chroot", str(root), "python3"]) for root in roots]
    found: dict[str, Python] = {}
    for root, command in asked:
        try:
            answer = subprocess.run(
                [*command, "-c", ASK], capture_output=True, text=True
            )
        except OSError:
            continue
        if answer.returncode == 0:
            version, path = answer.stdout.split()
            if version in VERSIONS:
                found.setdefault(version, Python(version, path, root))
    return [found[version] for version in VERSIONS if version in found]


def oldest_dependencies(wheel: Path) -> list[str]:
    """Return the requirements of a wheel without its extras."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        metadata = archive.read(name).decode()
    required = re.findall(r"^Requires-Dist: (.*)$", metadata, re.MULTILINE)
    return [requirement for requirement in required if "extra ==" not in requirement]


def _timed(row: dict, name: str, step: Callable[[], float | None]) -> None:
    started = time.perf_counter()
    try:
        value = step()
        row[name] = round(time.perf_counter() - started if value is None else value, 1)
    except (Failed, AssertionError) as error:
        row[name] = "failed"
        row["errors"].append(f"{name}: {error}")
        say(f"Python {row['python']} {row['dependencies']}: {error}")


def test_wheel(wheel: Path, python: Python, which: str) -> dict:
    """Run the commands of a wheel with its oldest or newest dependencies.

    Returns
    -------
    dict
        Durations, s, sizes, MB, and versions.
    """
    say(f"Python {python.version}, {which} dependencies")
    oldest = oldest_dependencies(wheel) if which == "oldest" else []
    row: dict = {"python": python.version, "dependencies": which, "errors": []}
    folder = BUILD / "environments" / f"{python.version}-{which}"
    # Installed twice: the first time fills uv's cache from the network.
    for name in ("download_s", "install_s"):
        environment = Environment(python, folder)
        _timed(row, name, partial(environment.install, wheel, *oldest))
        if row["errors"]:
            return row
    row["versions"] = environment.versions()
    row["installed_mb"] = round(environment.size_mb())
    _timed(row, "first_filter_s", lambda: smoke.filter_picture(environment))
    _timed(row, "second_filter_s", lambda: smoke.filter_picture(environment))
    _timed(row, "doctor_s", lambda: smoke.doctor(environment))
    if which == "newest":
        environment.install(wheel, extra="web")
        row["installed_with_page_mb"] = round(environment.size_mb())
    for name, command in smoke.COMMANDS.items():
        if which == "newest" or name != "web":
            _timed(row, f"{name}_s", partial(command, environment))
    environment.remove()
    return row


def main() -> None:
    """Test the wheel of the command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--python", action="append", default=[])
    parser.add_argument("--root", action="append", default=[], type=Path)
    parser.add_argument("--only", choices=("oldest", "newest"))
    options = parser.parse_args()
    failed = False
    for python in find_pythons(options.python, options.root):
        for which in (options.only,) if options.only else ("oldest", "newest"):
            row = test_wheel(options.wheel.resolve(), python, which)
            failed = failed or bool(row["errors"])
            print({name: value for name, value in row.items() if name != "versions"})
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
