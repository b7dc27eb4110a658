"""The project's source files and what each imports, read without importing them."""

import ast
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("estimator", "filter_service", "training", "clients", "ocufilter")


@dataclass(frozen=True)
class Import:
    """One imported module: the file (relative to the root), line, dotted name."""

    file: str
    line: int
    module: str

    @property
    def top(self) -> str:
        return self.module.split(".")[0]


def python_files(package: str) -> list[Path]:
    """Return the files of a folder, or of a module without one."""
    module = ROOT / f"{package}.py"
    return [module] if module.is_file() else sorted((ROOT / package).rglob("*.py"))


def imports_of(path: Path) -> list[Import]:
    """Every module a file imports, inside functions too; ``from a import b`` is a.b."""
    name = path.relative_to(ROOT).as_posix()
    return [Import(name, line, module) for line, module in _imports(path, name)]


@cache
def _imports(path: Path, name: str) -> list[tuple[int, str]]:
    """Return line and module of each import; files do not change in a session."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}:{node.lineno}: relative import"
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        found += [(node.lineno, module) for module in modules]
    return found


def package_imports(package: str) -> list[Import]:
    return [entry for path in python_files(package) for entry in imports_of(path)]
