"""The native engine's sources: numbers, files, warnings, sanitizers."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from filter_service import constants
from filter_service.native import records
from filter_service.native.library import compiled_library, library_path
from tests.native_build import COMPILER, build_library, runtime_of
from tests.source_tree import ROOT

SOURCE = ROOT / "filter_service" / "native" / "source"

FRAMES = (
    "tests/numerical/test_renderer_hard.py",
    "tests/numerical/test_renderer_frames.py",
    "tests/numerical/test_renderer_hidden.py",
    "tests/numerical/test_renderer_hdr.py",
    "tests/numerical/test_renderer_wide.py",
    "tests/numerical/test_native_random.py",
    "tests/numerical/test_field_layers.py",
    "tests/numerical/test_native_psfs.py",
)
"""Every size and radius, odd depths, hidden layers, kernels over the field, PSFs."""

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")


def test_numbers_of_the_sources_are_those_of_python():
    text = (SOURCE / "constants.h").read_text(encoding="utf-8")
    defined = dict(re.findall(r"#define (\w+) (-?[\d.e-]+)f?\n", text))
    assert len(defined) > 10
    for name, value in defined.items():
        assert float(value) == getattr(constants, name), name


def test_processors_with_avx2_use_it():
    """However the library was linked: one that says no is correct but slow."""
    cpuinfo = Path("/proc/cpuinfo")
    if not cpuinfo.exists() or library_path() is None:
        pytest.skip("needs Linux and the native engine")
    flags = re.search(r"^flags\s*:(.*)$", cpuinfo.read_text(), re.MULTILINE)
    has_avx2 = flags is not None and {"avx2", "fma"} <= set(flags[1].split())
    is_portable = os.environ.get("OCUFILTER_NATIVE_VARIANT") == "portable"
    expected = "avx2" if has_avx2 and not is_portable else "portable"
    assert compiled_library().variant == expected


def run_with_variant(variant):
    """A new process that prints the variant which it uses."""
    code = (
        "from filter_service.native.library import compiled_library as library\n"
        "print(library().variant)"
    )
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "OCUFILTER_NATIVE_VARIANT": variant},
        capture_output=True,
        text=True,
    )


def test_the_environment_selects_the_variant():
    if library_path() is None:
        pytest.skip("needs the native engine")
    assert run_with_variant("portable").stdout == "portable\n"
    refused = run_with_variant("sse9")
    assert "OCUFILTER_NATIVE_VARIANT='sse9'; allowed: auto, portable" in refused.stderr


def test_packed_words_are_those_of_python():
    text = (SOURCE / "frame.h").read_text(encoding="utf-8")
    defined = dict(re.findall(r"#define (\w+) (0x[0-9A-Fa-f]+|\d+)u?\n", text))
    assert int(defined["LEVEL_SHIFT"], 0) == constants.LEVEL_SHIFT
    assert int(defined["KERNEL_MASK"], 0) == constants.KERNEL_MASK
    assert int(defined["EDGE_BIT"], 0) == constants.EDGE_BIT
    assert int(defined["RESOLUTIONS"], 0) == records.RESOLUTIONS


@pytest.mark.parametrize(
    ("file", "name", "record"),
    [
        ("frame.h", "frame", records.Frame),
        ("psf_job.h", "psf_job", records.PsfJob),
        ("psf_job.h", "psf_tables", records.PsfTables),
    ],
)
def test_fields_of_records_are_those_of_the_source_in_order(file, name, record):
    text = (SOURCE / file).read_text(encoding="utf-8")
    before = text[: text.index(f"}} {name};")]
    body = before[before.rindex("typedef struct {") :]
    body = re.sub(r"/\*.*?\*/", "", body, flags=re.S)
    declared = []
    for line in body.split(";")[:-1]:
        names = line.split("{")[-1].strip().split(None, 1)[1]
        for field in names.split(","):
            declared.append(re.sub(r"\[.*?\]", "", field).split("*")[-1].split()[-1])
    assert declared == [field for field, *_ in record._fields_]


@needs_compiler
@pytest.mark.tools
@pytest.mark.parametrize("variant", ["-O3", "-O0"])
def test_sources_compile_without_a_warning(tmp_path, variant):
    flags = ("-Wall", "-Wextra", "-Wshadow", "-Wconversion", "-Wno-sign-conversion")
    build_library(tmp_path, *flags, "-Werror", variant)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("sanitizer", ["address,undefined", "thread"])
def test_hard_frames_pass_under_sanitizers(tmp_path, sanitizer):
    runtime = runtime_of(sanitizer)
    if runtime is None:
        pytest.skip(f"the compiler has no library for -fsanitize={sanitizer}")
    flags = ("-O1", "-g", f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all")
    library = build_library(tmp_path, *flags)
    environment = {
        **os.environ,
        "OCUFILTER_NATIVE_LIBRARY": str(library),
        "OCUFILTER_THREADS": "4",
        "LD_PRELOAD": str(runtime),
        # Python and numba keep memory to their end
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0",
        "TSAN_OPTIONS": "halt_on_error=1:exitcode=66:ignore_noninstrumented_modules=1",
    }
    finished = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"),
            *("-k", "native", "-m", "not slow", *FRAMES),
        ],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,
    )
    report = finished.stdout[-4000:] + finished.stderr[-4000:]
    assert finished.returncode == 0, report
    assert "Sanitizer" not in report, report
    assert " passed" in finished.stdout
