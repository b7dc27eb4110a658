"""Write a software bill of materials (CycloneDX JSON) of what users install.

    python -m tests.release.sbom out/ocufilter.cdx.json
    python -m tests.release.sbom out/ocufilter.cdx.json --python /path/to/python

The versions are those of an environment, by default the one that runs this program.  It
should contain the extras for users.  Requires the packages of `sh setup.sh release`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name

from tests.release.notices import STATED_ELSEWHERE
from tests.release.requirements import USER_EXTRAS, declared
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


def restricted(bom: dict[str, Any], names: set[str]) -> dict[str, Any]:
    """Return an SBOM without packages that only other requirements of the root need.

    Parameters
    ----------
    names : set of str
        Direct requirements that stay.
    """
    names_by_ref = {
        c["bom-ref"]: canonicalize_name(c["name"]) for c in bom["components"]
    }
    required = {d["ref"]: d.get("dependsOn", []) for d in bom["dependencies"]}
    root = bom["metadata"]["component"]["bom-ref"]
    required[root] = [ref for ref in required[root] if names_by_ref[ref] in names]
    kept, pending = set(), [root]
    while pending:
        ref = pending.pop()
        if ref not in kept:
            kept.add(ref)
            pending += required.get(ref, ())
    components = [c for c in bom["components"] if c["bom-ref"] in kept]
    for component in components:
        license_ = STATED_ELSEWHERE.get(canonicalize_name(component["name"]))
        if license_ is not None:
            component["licenses"] = [{"expression": license_}]
    dependencies = [
        {"ref": ref, "dependsOn": required[ref]} if required.get(ref) else {"ref": ref}
        for ref in sorted(kept)
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
    arguments = parser.parse_args()
    names = set(declared(USER_EXTRAS))
    bom = restricted(whole_environment(arguments.python), names)
    text = validated(json.dumps(bom, indent=1, ensure_ascii=False) + "\n")
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(text, encoding="utf-8")
    found = {canonicalize_name(component["name"]) for component in bom["components"]}
    print(f"sbom: {len(found)} packages in {arguments.output}")
    if names - found:
        print(f"sbom: not installed: {', '.join(sorted(names - found))}")


if __name__ == "__main__":
    main()
