"""Print the installed sizes of the packages that ocufilter requires, in 10^6 bytes.

    python -m tests.release.sizes

The first size is that of the package's own files.  The second also counts packages that
no other requirement needs: an installation without that requirement would save it.
"""

from __future__ import annotations

from importlib.metadata import Distribution
from pathlib import Path

from tests.release.requirements import USER_EXTRAS, declared, installed, project

BYTES_PER_MB = 1e6


def size_mb(package: Distribution | None) -> float:
    """Return the size of a package's files; compiled Python files are not counted."""
    if package is None:
        return 0.0
    paths = [
        Path(str(package.locate_file(f)))
        for f in package.files or ()
        if f.suffix != ".pyc"
    ]
    sizes = [path.stat().st_size for path in paths if path.is_file()]
    return sum(sizes) / BYTES_PER_MB


def main() -> None:
    """Print the table."""
    required = declared()
    whole = installed(required)
    print(
        f"required: {sum(map(size_mb, whole.values())):.1f} MB, {len(whole)} packages"
    )
    for name in required:
        without = installed(other for other in required if other != name)
        _print(name, whole.keys() - without.keys(), whole)
    for extra in USER_EXTRAS:
        more = installed(project()["optional-dependencies"][extra])
        added = more.keys() - whole.keys()
        total_mb = sum(size_mb(more[other]) for other in added)
        print(f"extra {extra}: {total_mb:.1f} MB more, {len(added)} packages")
        for name in declared([extra]):
            if name not in required:
                _print(name, installed([name]).keys() - whole.keys(), more)


def _print(
    name: str, removed: set[str], packages: dict[str, Distribution | None]
) -> None:
    package = packages[name]
    version = "missing" if package is None else package.version
    saved_mb = sum(size_mb(packages[other]) for other in removed)
    print(f"  {name:18} {version:12} {size_mb(package):7.1f} {saved_mb:7.1f}")


if __name__ == "__main__":
    main()
