"""Write a software bill of materials (CycloneDX JSON) of what users install.

    python -m tests.release.sbom out/ocufilter.cdx.json
    python -m tests.release.sbom out/ocufilter.cdx.json --python /path/to/python
    python -m tests.release.sbom out/ocufilter.cdx.json --install

The versions are those of an environment, by default the one that runs this program, and
the licenses those of NOTICE.  --install creates a temporary environment with the
versions in constraints.txt and all extras for users (1.3 GB).  Packages that NOTICE
does not list, such as tools for developers, are left out; missing extras are
reported.  Requires the packages of `sh setup.sh release`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from itertools import chain
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name

from tests.release.notices import NOTICE, PACKAGES, section
from tests.release.requirements import USER_EXTRAS, project
from tests.source_tree import ROOT


def whole_environment(python: str) -> dict[str, Any]:
    """Return the SBOM of all packages of an environment; its root is ocufilter."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "all.json"
        subprocess.run(
            [
                *(sys.executable, "-m", "cyclonedx_py", "environment"),
                *("--pyproject", str(ROOT / "pyproject.toml")),
                *("--mc-type", "application", "--output-reproducible"),
                *("--output-format", "JSON", "--output-file", str(output), python),
            ],
            check=True,
        )
        found: dict[str, Any] = json.loads(output.read_text(encoding="utf-8"))
        return found


def new_environment(folder: Path) -> str:
    """Create an environment with what users install; return its interpreter."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    python = str(folder / "bin/python")
    table = project()
    extras = (table["optional-dependencies"][extra] for extra in USER_EXTRAS)
    required = sorted({*table["dependencies"], *chain.from_iterable(extras)})
    pip = (python, "-m", "pip", "-qq", "--disable-pip-version-check", "install")
    constraints = str(ROOT / "constraints.txt")
    subprocess.run([*pip, "-c", constraints, *required], check=True)
    return python


def restricted(bom: dict[str, Any], licenses: dict[str, str]) -> dict[str, Any]:
    """Return an SBOM with those packages only that have a license in NOTICE.

    The environment may also contain tools for developers.

    Parameters
    ----------
    licenses : dict of str
        SPDX expressions, by normalized name.
    """
    components = [
        {**c, "licenses": [{"expression": licenses[canonicalize_name(c["name"])]}]}
        for c in bom["components"]
        if canonicalize_name(c["name"]) in licenses
    ]
    kept = {component["bom-ref"] for component in components}
    root = bom["metadata"]["component"]["bom-ref"]
    dependencies = [
        {"ref": d["ref"], "dependsOn": [r for r in d.get("dependsOn", ()) if r in kept]}
        for d in bom["dependencies"]
        if d["ref"] in kept | {root}
    ]
    return {**bom, "components": components, "dependencies": dependencies}


def validated(text: str) -> str:
    """Return the text of an SBOM.

    Raises
    ------
    ValueError
        If it violates the schema of CycloneDX.
    """
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import JsonStrictValidator

    version = SchemaVersion.from_version(json.loads(text)["specVersion"])
    error = JsonStrictValidator(version).validate_str(text)
    if error is not None:
        raise ValueError(f"not valid CycloneDX {version.to_version()}: {error}")
    return text


def main() -> None:
    """Write the SBOM and report what the environment lacks."""
    parser = argparse.ArgumentParser(description="Write an SBOM.")
    parser.add_argument("output", type=Path)
    parser.add_argument("--python", default=sys.executable, help="of the environment")
    parser.add_argument("--install", action="store_true", help="create an environment")
    arguments = parser.parse_args()
    entries = section(NOTICE.read_text(encoding="utf-8"), PACKAGES)
    licenses = dict(line.split(" | ")[:2] for line in entries)
    with tempfile.TemporaryDirectory() as folder:
        python = arguments.python
        if arguments.install:
            python = new_environment(Path(folder))
        bom = restricted(whole_environment(python), licenses)
    text = validated(json.dumps(bom, indent=1, ensure_ascii=False) + "\n")
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(text, encoding="utf-8")
    found = {canonicalize_name(component["name"]) for component in bom["components"]}
    print(f"sbom: {len(found)} packages in {arguments.output.name}")
    if licenses.keys() - found:
        missing = sorted(licenses.keys() - found)
        print(f"sbom: not installed: {', '.join(missing)}")


if __name__ == "__main__":
    main()
