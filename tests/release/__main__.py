"""Build, check and test a release; write dist/ with checksums and a checklist."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.release import aarch64, build, contents, pins, pythons, results
from tests.release.commands import BUILD, ROOT, TOOLS, Failed, run, say

DIST = ROOT / "dist"
SUMS = "SHA256SUMS"
CHECKLIST = "CHECKLIST.md"
MISSING_COMPILER = "/nonexistent/cc"
COLUMNS = {
    "python": "Python",
    "dependencies": "dependencies",
    "install_s": "install, s",
    "first_filter_s": "first picture, s",
    "second_filter_s": "next picture, s",
    "doctor_s": "doctor, s",
    "demo_s": "demo, s",
    "pages_s": "commands of pages, s",
    "serve_s": "serve, s",
    "web_s": "web, s",
    "report_s": "report, s",
    "batch_s": "batch, s",
    "installed_mb": "MB",
    "installed_with_page_mb": "MB with page",
}


def check_metadata(built: list[Path]) -> str:
    """Check NOTICE and the metadata of distributions; return what they report."""
    found = run(sys.executable, "-m", "tests.release.notices")
    return found + run(TOOLS / "python", "-m", "tests.release.metadata", *built)


def warn_of_changes() -> None:
    """Say so if the release, which is the last commit, lacks changes."""
    if run("git", "status", "--porcelain").strip():
        say("uncommitted changes are not part of the release")


def check_without_compiler(sdist: Path, folder: Path) -> None:
    """Check that a build without a compiler says what to install, or uses ziglang's."""
    has_zig = "import importlib.util as u; print(u.find_spec('ziglang') is not None)"
    uses_zig = run(TOOLS / "python", "-c", has_zig).strip() == "True"
    command = ("pip", "wheel", "--no-deps", "--no-build-isolation", "--verbose")
    said = subprocess.run(
        [TOOLS / "python", "-m", *command, "-w", folder, sdist],
        env={**os.environ, "CC": MISSING_COMPILER},
        capture_output=True,
        text=True,
    )
    text = said.stdout + said.stderr
    is_refused = "_core was not built: install a C compiler" in text
    if (said.returncode == 0) != uses_zig or is_refused == uses_zig:
        raise Failed(f"build without a compiler: {text[-2000:]}")


def quick() -> None:
    """Build with this machine's compiler, twice, and check the contents."""
    warn_of_changes()
    os.umask(0o022)
    commit, time_s = build.last_commit()
    built = []
    for name in ("first", "second"):
        out = BUILD / name / name
        shutil.rmtree(out.parent, ignore_errors=True)
        out.mkdir(parents=True)
        source = build.export(commit, BUILD / name / "source")
        sdist = build.build_sdist(source, out, time_s)
        built.append([sdist, build.build_local_wheel(sdist, out, time_s)])
    build.compare(*built)
    sdist, wheel = built[0]
    has_headers = Path("/usr/include/openxr/openxr_loader_negotiation.h").exists()
    layer = {name for name in contents.LIBRARIES if name.endswith("_layer.so")}
    contents.check_wheel(wheel, contents.LIBRARIES - (set() if has_headers else layer))
    contents.check_sdist(sdist)
    contents.check_description(sdist, wheel)
    check_without_compiler(sdist, BUILD / "first")
    for path in built[0]:
        print(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB; two builds are equal")
    if lines := results.differing(results.commits()):
        say("\n  ".join(["`make release` requires results of one commit", *lines]))
    print(check_metadata(built[0]), end="")
    print(pins.check_pins())


def table(rows: list[dict]) -> str:
    """Return a Markdown table of test runs."""
    lines = [list(COLUMNS.values()), ["---"] * len(COLUMNS)]
    lines += [[str(row.get(name, "")) for name in COLUMNS] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def checklist(
    commit: str, built: list[Path], checks: list[str], rows: list[dict]
) -> str:
    """Return the checklist of a release, Markdown."""
    untested = set(pythons.VERSIONS) - {row["python"] for row in rows}
    open_choices = [check for check in checks if " chosen (" in check]
    failures = [
        f"failed: Python {row['python']}, {row['dependencies']}: "
        f"{error.splitlines()[0]}"
        for row in rows
        for error in row["errors"]
    ]
    steps = [
        *open_choices,
        *(f"test with Python {version}: none here" for version in sorted(untested)),
        *failures,
        "compare the version with the changelog and tag the commit",
        f"upload the files of {SUMS}",
    ]
    parts = [
        f"# Checklist of {built[0].name.removesuffix('.tar.gz')}\n",
        f"Commit {commit}\n",
        *(f"- {p.name}: {p.stat().st_size / 1e6:.1f} MB" for p in built),
        "\n## Passed\n",
        *(f"- [x] {check}" for check in checks if check not in open_choices),
        "\n## Environments\n",
        "Times without network.\n",
        table(rows),
        "\n## To do\n",
        *(f"- [ ] {step}" for step in steps),
    ]
    return "\n".join(parts) + "\n"


def release(options: argparse.Namespace) -> None:
    """Build, check and test everything."""
    warn_of_changes()
    if lines := results.differing(results.commits()):
        raise Failed("\n".join(["run `make results`", *lines]))
    os.umask(0o022)
    commit, built = build.build_twice(BUILD / "dist")
    sdist, x86_64, for_aarch64 = built
    checks = ["two builds in different folders have the same bytes"]
    for wheel in (x86_64, for_aarch64):
        contents.check_wheel(wheel)
        checks.append(f"auditwheel: {wheel.name} needs {contents.audit(wheel)}")
    contents.check_sdist(sdist)
    contents.check_description(*built)
    checks.append("the contents are complete; twine check --strict")
    checks += check_metadata(built).splitlines()
    checks.append(pins.check_pins())
    check_without_compiler(sdist, BUILD / "without-compiler")
    checks.append("results of benchmarks are those of one commit")
    checks.append("the sdist builds without a compiler and says what is missing")
    say("comparing the library for aarch64, under emulation, with that for x86-64")
    found = aarch64.compare(for_aarch64, x86_64)
    checks.append(
        f"aarch64 under emulation: light of {found['frames']} frames at most "
        f"{found['light']:.1e} of white from the portable variant of x86-64, "
        f"{found['psfs']} PSFs at most {found['psf']:.1e} (L2)"
    )
    rows = []
    for python in pythons.find_pythons(options.python, options.root):
        for which in ("oldest", "newest"):
            rows.append(pythons.test_wheel(x86_64, python, which))
    shutil.rmtree(DIST, ignore_errors=True)
    DIST.mkdir()
    for path in built:
        shutil.copy2(path, DIST)
    say("writing the bill of materials")
    bom = DIST / f"{sdist.name.removesuffix('.tar.gz')}.cdx.json"
    checks += run(
        *(TOOLS / "python", "-m", "tests.release.sbom", bom, "--install")
    ).splitlines()
    sums = "".join(f"{build.sha256(path)}  {path.name}\n" for path in [*built, bom])
    (DIST / SUMS).write_text(sums, encoding="utf-8")
    text = checklist(commit, built, checks, rows)
    (DIST / CHECKLIST).write_text(text, encoding="utf-8")
    (BUILD / "environments.json").write_text(
        json.dumps(rows, indent=1), encoding="utf-8"
    )
    print(text)
    if any(row["errors"] for row in rows):
        raise Failed("the wheel failed in an environment; see the checklist")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.release", description=__doc__
    )
    parser.add_argument("--quick", action="store_true", help="without environments")
    parser.add_argument("--python", action="append", default=[], help="an interpreter")
    parser.add_argument(
        "--root", action="append", default=[], type=Path, help="a system in a folder"
    )
    options = parser.parse_args()
    try:
        quick() if options.quick else release(options)
    except Failed as error:
        raise SystemExit(f"release: {error}") from None


if __name__ == "__main__":
    main()
