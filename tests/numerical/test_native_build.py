"""The C sources: numbers, records, functions, warnings, sanitizers, threads."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from estimator.field import interpolation
from estimator.native import LibraryUnavailable, core
from estimator.native import functions as core_functions
from estimator.native import library as core_library
from estimator.native import records as core_records
from estimator.optics import zernike
from estimator.wavefront import field_wavefronts
from filter_service import constants
from filter_service.native import functions, library, loops, records
from filter_service.psfs import store_cache
from tests.native_build import COMPILER, build_libraries, build_library, runtime_of
from tests.source_tree import ROOT

SOURCE = ROOT / "filter_service" / "native" / "source"
CORE = ROOT / "estimator" / "native" / "source"

FRAMES = (
    "tests/numerical/test_renderer_hard.py",
    "tests/numerical/test_renderer_frames.py",
    "tests/numerical/test_renderer_hidden.py",
    "tests/numerical/test_renderer_hdr.py",
    "tests/numerical/test_renderer_wide.py",
    "tests/numerical/test_native_random.py",
    "tests/numerical/test_native_light.py",
    "tests/numerical/test_edge_light.py",
    "tests/numerical/test_field_layers.py",
    "tests/numerical/test_native_psfs.py",
    "tests/numerical/test_native_tracer.py",
    "tests/numerical/test_moved_plane.py",
    "tests/numerical/test_fixed_defocus.py",
    "tests/numerical/test_defocus_nodes.py",
    "tests/numerical/test_frame_layers.py",
    "tests/numerical/test_psf_enz.py",
)
"""Every size and radius, odd depths, hidden layers, kernels over the field, PSFs, rays
of every form."""

SELECTED = "native or moved_plane or defocus or frame_layers or psf_enz"
"""Without the cases of the engine gl."""

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
    if not cpuinfo.exists():
        pytest.skip("needs Linux")
    flags = re.search(r"^flags\s*:(.*)$", cpuinfo.read_text(), re.MULTILINE)
    has_avx2 = flags is not None and {"avx2", "fma"} <= set(flags[1].split())
    is_portable = os.environ.get("OCUFILTER_NATIVE_VARIANT") == "portable"
    expected = "avx2" if has_avx2 and not is_portable else "portable"
    assert core().variant == loops().variant == expected


def run_with_variant(variant):
    """A new process that prints the variant which it uses."""
    code = (
        "from filter_service.native import loops\n"
        "from estimator.native import core\n"
        "print(loops().variant, core().variant)"
    )
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "OCUFILTER_NATIVE_VARIANT": variant},
        capture_output=True,
        text=True,
    )


def test_the_environment_selects_the_variant():
    assert run_with_variant("portable").stdout == "portable portable\n"
    refused = run_with_variant("sse9")
    assert "OCUFILTER_NATIVE_VARIANT='sse9'; allowed: auto, portable" in refused.stderr


def test_packed_words_are_those_of_python():
    text = (SOURCE / "frame.h").read_text(encoding="utf-8")
    defined = dict(re.findall(r"#define (\w+) (0x[0-9A-Fa-f]+|\d+)u?\n", text))
    assert int(defined["LEVEL_SHIFT"], 0) == constants.LEVEL_SHIFT
    assert int(defined["KERNEL_MASK"], 0) == constants.KERNEL_MASK
    assert int(defined["EDGE_BIT"], 0) == constants.EDGE_BIT
    assert int(defined["RESOLUTIONS"], 0) == records.RESOLUTIONS


def test_numbers_of_rims_are_those_of_python():
    text = (CORE / "field_defocus.h").read_text(encoding="utf-8")
    defined = dict(re.findall(r"#define (\w+) ([\d.]+)\b", text))
    expected = {
        "N_DEGREES": zernike.HIGHEST_ORDER // 2,
        "N_RIM": field_wavefronts.N_RIM,
        "SMOOTH_PUPILS": interpolation.SMOOTH_NODES,
        "RIM_SAMPLES": field_wavefronts.N_SAMPLED,
        "NEWTON_STEPS": field_wavefronts.N_NEWTON_STEPS,
        "NEWTON_STEP_RAD": field_wavefronts.NEWTON_STEP_RAD,
    }
    assert {name: float(defined[name]) for name in expected} == expected


@pytest.mark.parametrize(
    ("file", "name", "record"),
    [
        (SOURCE / "frame.h", "frame", records.Frame),
        (SOURCE / "kernel_job.h", "store_tables", records.StoreTables),
        (SOURCE / "kernel_job.h", "state_reads", records.StateReads),
        (SOURCE / "kernel_job.h", "map_tables", records.MapTables),
        (SOURCE / "kernel_job.h", "list_job", records.ListJob),
        (SOURCE / "kernel_job.h", "recipe_job", records.RecipeJob),
        (SOURCE / "kernel_job.h", "size_job", records.SizeJob),
        (SOURCE / "edge_job.h", "visibility_job", records.VisibilityJob),
        (SOURCE / "edge_job.h", "omitted_job", records.OmittedJob),
        (SOURCE / "edge_job.h", "light_job", records.LightJob),
        (SOURCE / "edge_job.h", "tails_job", records.TailsJob),
        (SOURCE / "edge_job.h", "spread_job", records.SpreadJob),
        (SOURCE / "added_light.h", "added_light", records.AddedLight),
        (SOURCE / "node_job.h", "node_job", records.NodeJob),
        (CORE / "psf_job.h", "psf_job", core_records.PsfJob),
        (CORE / "psf_job.h", "psf_tables", core_records.PsfTables),
        (CORE / "defocus_job.h", "defocus_grid", core_records.DefocusGrid),
        (CORE / "defocus_job.h", "defocus_job", core_records.DefocusJob),
        (CORE / "wavefront_job.h", "wavefront_job", core_records.WavefrontJob),
    ],
)
def test_fields_of_records_are_those_of_the_source_in_order(file, name, record):
    text = file.read_text(encoding="utf-8")
    before = text[: text.index(f"}} {name};")]
    body = before[before.rindex("typedef struct {") :]
    body = re.sub(r"/\*.*?\*/", "", body, flags=re.S)
    declared = []
    for line in body.split(";")[:-1]:
        names = line.split("{")[-1].strip().split(None, 1)[1]
        for field in names.split(","):
            declared.append(re.sub(r"\[.*?\]", "", field).split("*")[-1].split()[-1])
    assert declared == [field for field, *_ in record._fields_]


@pytest.mark.parametrize(
    ("source", "own"),
    [(CORE / "core.h", core_functions), (SOURCE / "loops.h", functions)],
)
def test_signatures_are_those_of_the_source(source, own):
    """Every function of the table, with parameters of the same kinds in C."""
    table = re.findall(r"FUNCTION\((\w+)\)", source.read_text(encoding="utf-8"))
    assert set(table) == set(own.FUNCTIONS)
    texts = [path.read_text(encoding="utf-8") for path in source.parent.glob("*.h")]
    for name, signature in own.FUNCTIONS.items():
        pattern = rf"^static (\w+) {name}\(([^)]*)\)\s*\{{"
        found = [re.search(pattern, text, re.MULTILINE) for text in texts]
        result, parameters = next(match for match in found if match).groups()
        head, arrow, _ = signature.partition("->")
        assert (result == "void") != bool(arrow), name
        kinds = [kind_in_c(each) for each in parameters.split(",")]
        assert kinds == head.split(), name


C_TYPES = {
    "uint8_t": "u1",
    "uint16_t": "u2",
    "uint32_t": "u4",
    "uint64_t": "u8",
    "int8_t": "i1",
    "int16_t": "i2",
    "int32_t": "i4",
    "int64_t": "i8",
    "float": "f4",
    "double": "f8",
    "_Bool": "?",
    "bool": "?",
}


def kind_in_c(parameter):
    """The kind of a parameter, as `FUNCTIONS` has it."""
    words = parameter.replace("const", "").replace("*", " * ").split()
    if words[0] == "pool":
        return "pool"
    if "*" not in words:
        return C_TYPES[words[0]]
    return f"{C_TYPES[words[0]]}[]" if words[0] in C_TYPES else "record"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((), "takes 2 arguments, not 0"),
        ((core_records.PsfJob(), np.zeros(3)), r"argument 1: .*uint16, got float64"),
        ((core_records.PsfJob(), np.zeros((4, 4), np.uint16).T), "contiguous"),
        ((core_records.PsfJob(), [1]), "got list"),
        ((np.zeros(3), None), "argument 0"),
    ],
)
def test_arguments_of_another_kind_are_refused(arguments, reason):
    with pytest.raises(TypeError, match=reason):
        core().call("take_psfs", *arguments)


def test_a_library_of_another_version_is_refused(monkeypatch):
    paths = core().path, loops().path  # loaded before the version changes
    monkeypatch.setattr(core_library, "ABI", 0)
    for kind, path in zip((core_library.Core, library.Loops), paths, strict=True):
        with pytest.raises(
            LibraryUnavailable, match=rf"{path.name} .*install the pack"
        ):
            kind(path)


def test_threads_start_again_after_the_last_handle():
    """Also if its loops ran in the caller alone."""
    code = (
        "import os, time\n"
        "from estimator.native import core\n"
        "core().end_threads(core().new_threads(1))\n"
        "before = len(os.listdir('/proc/self/task'))\n"
        "core().new_threads(3)\n"
        "time.sleep(0.05)\n"
        "print(len(os.listdir('/proc/self/task')) - before)\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert ran.stdout == "2\n"


def test_a_process_has_one_pool():
    """Frames, PSFs and a second engine share the threads of the largest handle."""
    code = (
        "import os, numpy as np\n"
        "from estimator.native import core\n"
        "from estimator.psf.compiled import compiled_psfs\n"
        "from filter_service.rendering.native import NativeRenderer\n"
        "from filter_service.rendering.perfect_eye import change_by_perfect_eye\n"
        "before = len(os.listdir('/proc/self/task'))\n"
        "engines = [NativeRenderer(n_threads=4), NativeRenderer(n_threads=3)]\n"
        "engines[0].begin, compiled_psfs()\n"
        "for engine in engines: change_by_perfect_eye(engine)\n"
        "print(len(os.listdir('/proc/self/task')) - before)\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "OCUFILTER_THREADS": "4"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ran.stdout == "3\n"  # and the caller


@needs_compiler
@pytest.mark.tools
@pytest.mark.parametrize("variant", ["-O3", "-O0"])
def test_sources_compile_without_a_warning(tmp_path, variant):
    flags = ("-Wall", "-Wextra", "-Wshadow", "-Wconversion", "-Wno-sign-conversion")
    build_libraries(tmp_path, *flags, "-Werror", variant)


@needs_compiler
@pytest.mark.tools
def test_a_changed_constant_changes_the_key_of_the_cache(tmp_path, monkeypatch):
    keys = set()
    for name, margin in (("same", "7.5 "), ("again", "7.5 "), ("other", "7.25")):
        tree, folder = tmp_path / f"tree-{name}", tmp_path / name
        folder.mkdir()
        shutil.copytree(CORE, tree / CORE.relative_to(ROOT))
        source = tree / CORE.relative_to(ROOT) / "psfs.h"
        text = source.read_text(encoding="utf-8")
        assert "#define RAYS_MARGIN_PX 7.5 " in text
        changed = text.replace("RAYS_MARGIN_PX 7.5 ", f"RAYS_MARGIN_PX {margin}")
        source.write_text(changed, encoding="utf-8")
        build_library("_core", folder, "-O0", source=tree)
        monkeypatch.setenv("OCUFILTER_LIBRARY_DIR", str(folder))
        store_cache.code_version.cache_clear()
        keys.add(store_cache.code_version())
    store_cache.code_version.cache_clear()
    assert len(keys) == 2


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("sanitizer", ["address,undefined", "thread"])
def test_hard_frames_pass_under_sanitizers(tmp_path, sanitizer):
    runtime = runtime_of(sanitizer)
    if runtime is None:
        pytest.skip(f"the compiler has no library for -fsanitize={sanitizer}")
    flags = ("-O1", "-g", f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all")
    build_libraries(tmp_path, *flags)
    environment = {
        **os.environ,
        "OCUFILTER_LIBRARY_DIR": str(tmp_path),
        "OCUFILTER_THREADS": "4",
        "LD_PRELOAD": str(runtime),
        # Python keeps memory to its end
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0",
        "TSAN_OPTIONS": "halt_on_error=1:exitcode=66:ignore_noninstrumented_modules=1",
    }
    finished = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"),
            *("-k", SELECTED, "-m", "not slow", *FRAMES),
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
