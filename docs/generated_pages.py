"""MkDocs hook that generates reference pages from the code.

``reference/api.md`` contains the docstrings and types of the names of `ocufilter`.
``reference/settings.md`` contains the fields of `FilterSettings` and `ServiceConfig`.
``reference/command-line.md`` contains the help text of every command.
``reference/benchmarks.md`` contains the benchmarks with their results and figures.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from filter_service.service.config import RANGES, ServiceConfig
from filter_service.settings import DEFAULTS, setting_help, setting_types
from filter_service.validation import allowed_values
from tests.benchmarks.harness import KEPT_RESULTS

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "estimator": "Estimate an eye; compute its PSFs, MTF and acuity",
    "filter_service": "Filter frames in your own process",
    "clients": "Connect to a service",
}
FIRST = {"estimator": ("Eye", "LabeledArray")}
"""Names that precede the others of their package."""
RESULTS = "tests/benchmarks/results"


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Return `files` with the generated pages and the benchmark results added."""
    for uri, text in (
        ("reference/api.md", _api_page()),
        ("reference/settings.md", _settings_page()),
        ("reference/command-line.md", _command_line_page()),
        ("reference/benchmarks.md", _benchmarks_page()),
    ):
        files.append(File.generated(config, uri, content=text))
    for path in (ROOT / RESULTS).iterdir():
        uri = f"results/{path.name}"
        files.append(File.generated(config, uri, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return the Markdown with links to benchmark results adapted to the built site."""
    return markdown.replace(f"](../{RESULTS}/", "](results/")


def _api_page() -> str:
    lines = [
        "# Python API",
        "",
        "The public API consists of the names below, as in `from ocufilter import "
        "Camera`. Everything else may change without notice. `ocufilter.errors` "
        "contains the exceptions of the filter and the service. Importing `ocufilter` "
        "is fast, because each name is loaded when it is first used.",
        "",
    ]
    for package, purpose in PACKAGES.items():
        lines += [f"## {purpose}", ""]
        module = importlib.import_module(package)
        first = FIRST.get(package, ())
        names = sorted(set(module.__all__) - set(first), key=str.lower)
        for name in (*first, *names):
            found = getattr(module, name)
            if inspect.ismodule(found):  # a section of its own
                continue
            is_code = inspect.isclass(found) or inspect.isroutine(found)
            if is_code and not inspect.getdoc(found):
                raise PluginError(f"{package}.{name} has no docstring")
            lines += [f"::: ocufilter.{name}", ""]
    lines += ["## Draw stimuli", "", "As in `from ocufilter import stimuli`.", ""]
    for name in importlib.import_module("clients.stimuli").__all__:
        lines += [f"::: clients.stimuli.{name}", ""]
    lines += ["## Differentiate in PyTorch", "", "::: ocufilter.torch.SeeThrough", ""]
    return "\n".join(lines)


def _settings_page() -> str:
    lines = [
        "# Settings",
        "",
        "## Filter",
        "",
        "These are the fields of `FilterSettings` and of `settings` in the wire "
        "protocol, and options of `ocufilter filter`.",
        "",
        "| setting | default | allowed | meaning |",
        "|---|---|---|---|",
    ]
    for name, kind in setting_types().items():
        default = _shown(getattr(DEFAULTS, name))
        allowed = allowed_values(kind)
        meaning = " ".join(setting_help(name).split())
        lines.append(f"| `{name}` | {default} | {allowed} | {meaning} |")
    lines += [
        "",
        "## Service",
        "",
        "These are the fields of the file for `ocufilter serve --config FILE.toml`.",
        "",
        "| setting | default | allowed | meaning |",
        "|---|---|---|---|",
    ]
    meanings = _attributes_of(ServiceConfig.__doc__ or "")
    for field in fields(ServiceConfig):
        low_high = RANGES.get(field.name)
        allowed = "" if low_high is None else f"{low_high[0]:g} to {low_high[1]:g}"
        default = _shown(field.default)
        lines.append(
            f"| `{field.name}` | {default} | {allowed} | {meanings[field.name]} |"
        )
    return "\n".join(lines) + "\n"


def _shown(value: object) -> str:
    if value is None or value in ("", ()):
        return "none"
    return f"`{list(value) if isinstance(value, tuple) else value}`"


def _attributes_of(docstring: str) -> dict[str, str]:
    """Return the descriptions in the Attributes section of a numpydoc docstring."""
    meanings: dict[str, str] = {}
    section = docstring.partition("Attributes")[2]
    for names, text in re.findall(
        r"^    (\w[\w, ]*) : .*\n((?:^        .*\n|^\n)+)", section, re.MULTILINE
    ):
        for name in names.split(", "):
            meanings[name] = " ".join(text.replace("``", "`").split())
    return meanings


def _command_line_page() -> str:
    lines = [
        "# Command line",
        "",
        "Every command has a `--help` option. With `--json`, a command prints one JSON "
        "object. The exit code is 0 for success, 1 for a failure and 2 for invalid "
        "input.",
        "",
    ]
    main = _help()
    names = re.findall(r"^  ([a-z-]+)  ", main.partition("Commands:")[2], re.MULTILINE)
    for name in names:
        lines += [f"## ocufilter {name}", "", "```text", _help(name), "```", ""]
    return "\n".join(lines)


def _benchmarks_page() -> str:
    lines = [
        "# Benchmarks",
        "",
        "In a clone, `ocufilter bench NAME` runs one benchmark; `--quick` runs fewer "
        "cases. Each benchmark reports speed together with error and writes JSON that "
        "includes hardware and commit. [Speed and accuracy](../benchmarks.md) lists "
        "the main results.",
        "",
    ]
    for path in sorted((ROOT / "tests" / "benchmarks").glob("bench_*.py")):
        name = path.stem.removeprefix("bench_")
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        lines += [f"## {name}", "", docstring.splitlines()[0].replace("``", "`"), ""]
        results = sorted((ROOT / RESULTS).glob(f"{name}*.json"))
        lines += [*map(_result_line, results), ""]
        for suffix in ("png", "jpg"):
            if (ROOT / RESULTS / f"{name}.{suffix}").exists():
                lines += [f"![{name}](../results/{name}.{suffix})", ""]
    return "\n".join(lines)


def _result_line(path: Path) -> str:
    content = json.loads(path.read_text(encoding="utf-8"))
    facts = [f"commit {content['commit']}" if "commit" in content else ""]
    facts += [content.get("date") or "", content.get("machine", {}).get("cpu", "")]
    if path.stem in KEPT_RESULTS:
        facts.append("not repeated by `make results`")
    return f"- [{path.name}](../results/{path.name}) {', '.join(filter(None, facts))}"


def _help(*command: str) -> str:
    finished = subprocess.run(
        [sys.executable, "-m", "ocufilter", *command, "--help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return finished.stdout.rstrip()
