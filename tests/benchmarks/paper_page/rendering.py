"""Tables 6 to 10: textures, times and errors of rendering; and the PSFs of the text."""

from tests.benchmarks.paper_page.estimating import EYE_NAMES, SECONDS
from tests.benchmarks.paper_page.measured import Measured
from tests.benchmarks.paper_page.published import published, table
from tests.benchmarks.paper_page.rows import Block, Line, Measure, Section
from tests.benchmarks.paper_page.words import section
from tests.benchmarks.published_figures import CONDITIONS

LARGE, SMALL = "1280x720", "640x360"
MIB, GIB = 2**20, 2**30
MEMORY, LAYERS = Measure("memory", "MiB"), Measure("layers", "layers")
MILLISECONDS = Measure("time", "ms")
DECIBELS = Measure("PSNR", "dB", higher_is_better=True)

SYSTEMS = {
    # of the paper's tables 7, 8 and 10, by our names
    "Barsky": "Barsky [58]",
    "predecessor": "Csoba and Kunkli [49]",
    "paper on-axis": "The paper",
    "Celaya": "Rodríguez Celaya et al. [26]",
    "Gonzalez": "Gonzalez-Utrera [27]",
    "quality": "The paper (quality)",
    "dynamic": "The paper (dynamic)",
}
SCENES = {"Primitives": "primitives", "San Miguel": "courtyard"}
SCENE_TITLES = {
    "Primitives": "Primitives (ours: built after the paper's picture)",
    "San Miguel": "San Miguel (ours: Courtyard, as rich)",
}


def sections(measured: Measured) -> list[Section]:
    """Return the five tables."""
    return [
        _layouts(measured),
        _times_on_axis(measured),
        _errors_on_axis(measured),
        _field_textures(measured),
        _off_axis(measured),
    ]


def _field(measured, column, method, eye, scene, size) -> float | None:
    return measured.value(
        "field", column, method=method, case=eye, scene=scene, size=size
    )


def _layers(measured, column, method, eye, mode) -> float | str | None:
    for row in measured.rows("layers", method=method, case=eye):
        if row["setting"].startswith(mode):
            return row[column]
    return None


def _in(unit: int, megabytes: float | None) -> float | None:
    return None if megabytes is None else megabytes * 1e6 / unit


def _layouts(measured: Measured) -> Section:
    blocks = []
    for which, method in (("previous", "predecessor"), ("proposed", "paper on-axis")):
        system = SYSTEMS[method]
        layers, memory, times = [], [], []
        for eye in CONDITIONS:
            name = EYE_NAMES[eye]
            own = {key: values[which][eye] for key, values in table(6).items()}
            rebuilt = {"method": method, "case": eye}
            setting = _layers(measured, "setting", "frame kernels", eye, "on-axis")
            kernels = setting.split(": ")[1].split(";")[0] if setting else None
            atlas_mib = _in(
                MIB, _layers(measured, "memory_mb", "frame kernels", eye, "on-axis")
            )
            texture_mb = measured.value("paper_layouts", "memory_mb", **rebuilt)
            layers.append(
                Line(
                    name,
                    own["layers"],
                    kernels,
                    measured.value("paper_layouts", "n", **rebuilt),
                )
            )
            memory.append(
                Line(
                    name, own["memory_mib"], atlas_mib, _in(MIB, texture_mb), atlas_mib
                )
            )
            time_ms = _layers(measured, "median_ms", "frame kernels", eye, "on-axis")
            times.append(Line(name, own["interpolation_ms"], time_ms))
        is_own = which == "proposed"
        apart = "the paper's texture is dimensioned for all its pupils and foci"
        as_what = "the layout, for 5 mm and 0.5 dpt"
        blocks += [
            Block(
                *(system, LAYERS, tuple(layers)),
                is_own=is_own,
                is_contest=False,
                rebuilt_as=as_what,
            ),
            Block(
                *(system, MEMORY, tuple(memory)),
                is_own=is_own,
                incomparable=apart,
                rebuilt_as=as_what,
            ),
            Block(
                *(system, MILLISECONDS, tuple(times)),
                is_own=is_own,
                scene="making a frame's PSFs",
            ),
        ]
    return section("Table 6", ("layers", "paper_layouts"), blocks)


def _times_on_axis(measured: Measured) -> Section:
    blocks = []
    for scene, own_scene in SCENES.items():
        for method, own in table(7).items():
            lines = []
            for eye in CONDITIONS:
                ours = _field(
                    measured, "median_ms", "ours on-axis", eye, own_scene, LARGE
                )
                rebuilt = _field(measured, "median_ms", method, eye, own_scene, LARGE)
                lines.append(Line(EYE_NAMES[eye], own[scene][eye], ours, rebuilt, ours))
            blocks.append(
                Block(
                    *(SYSTEMS[method], MILLISECONDS, tuple(lines)),
                    is_own=method == "paper on-axis",
                    scene=SCENE_TITLES[scene],
                    rebuilt_as="by FFT, two cores",
                )
            )
    return section("Table 7", ("field",), blocks)


def _errors_on_axis(measured: Measured) -> Section:
    blocks = []
    for scene, own_scene in SCENES.items():
        for method, own in table(8).items():
            lines = []
            for eye in CONDITIONS:
                at = (eye, own_scene)
                column = "psnr_srgb8_db"
                lines.append(
                    Line(
                        EYE_NAMES[eye],
                        own[scene][eye],
                        _field(measured, column, "ours on-axis", *at, LARGE),
                        _field(measured, column, method, *at, SMALL),
                        _field(measured, column, "ours on-axis", *at, SMALL),
                    )
                )
            blocks.append(
                Block(
                    *(SYSTEMS[method], DECIBELS, tuple(lines)),
                    is_own=method == "paper on-axis",
                    scene=SCENE_TITLES[scene],
                    rebuilt_as="640x360, our scenes",
                )
            )
    return section("Table 8", ("field",), blocks)


def _field_textures(measured: Measured) -> Section:
    gib = Measure("memory", "GiB")
    quality, cache, texture, times = [], [], [], []
    for eye in CONDITIONS:
        name, own = EYE_NAMES[eye], table(9)

        def memory(method, size, eye=eye):
            at = (method, eye, "courtyard", size)
            return _in(GIB, _field(measured, "memory_mb", *at))

        quality.append(
            Line(
                name,
                own["quality"]["memory_gib"][eye],
                memory("ours quality", LARGE),
                memory("paper quality", SMALL),
                memory("ours quality", SMALL),
            )
        )
        cache_mb = _layers(measured, "memory_mb", "cache", eye, "dynamic")
        cache.append(
            Line(
                name,
                own["dynamic"]["cache_gib"][eye],
                _in(GIB, cache_mb),
                memory("paper dynamic", SMALL),
                memory("ours dynamic", SMALL),
            )
        )
        atlas_mb = _layers(measured, "memory_mb", "frame kernels", eye, "dynamic")
        texture.append(
            Line(name, own["dynamic"]["texture_mib"][eye], _in(MIB, atlas_mb))
        )
        time_ms = _layers(measured, "median_ms", "frame kernels", eye, "dynamic")
        times.append(Line(name, own["dynamic"]["interpolation_ms"][eye], time_ms))
    as_what = "640x360"
    blocks = (
        Block(
            *(SYSTEMS["quality"], gib, tuple(quality)),
            is_own=True,
            scene="texture of one pupil and focus",
            rebuilt_as=as_what,
        ),
        Block(
            *(SYSTEMS["dynamic"], gib, tuple(cache)),
            is_own=True,
            scene="cache for all pupils and foci",
            rebuilt_as=as_what,
        ),
        Block(
            *(SYSTEMS["dynamic"], MEMORY, tuple(texture)),
            is_own=True,
            scene="texture of a frame",
        ),
        Block(
            *(SYSTEMS["dynamic"], MILLISECONDS, tuple(times)),
            is_own=True,
            scene="making the texture of a frame",
        ),
    )
    return section("Table 9", ("layers", "field"), blocks)


def _cell(text: str) -> tuple[float, str]:
    number, unit = text.split()
    return float(number), unit


CELL_MEASURES = {
    "h": Measure("time", "h"),
    "ms": MILLISECONDS,
    "dB": DECIBELS,
}
OURS_OFF_AXIS = {"quality": "ours quality", "dynamic": "ours dynamic"}
REBUILT = {"quality": "paper quality", "dynamic": "paper dynamic"}
MS_PER_HOUR = 3.6e6


def _off_axis_block(measured: Measured, scene: str, method: str) -> Block:
    own_scene = SCENES[scene]
    ours_name = OURS_OFF_AXIS.get(method, "ours quality")
    lines, unit = [], ""
    for eye in CONDITIONS:
        theirs, unit = _cell(table(10)[scene][method][eye])
        at = (eye, own_scene)
        if unit == "dB":
            column = "psnr_srgb8_db"
            large = _field(measured, column, ours_name, *at, LARGE)
            small = _field(measured, column, ours_name, *at, SMALL)
            rebuilt = _field(measured, column, REBUILT.get(method, method), *at, SMALL)
            ours = large if large is not None else small
        else:
            per_unit = MS_PER_HOUR if unit == "h" else 1.0
            ours = _field_time(measured, ours_name, *at, LARGE, per_unit)
            rebuilt = _field_time(measured, method, *at, SMALL, per_unit)
            small = _field_time(measured, ours_name, *at, SMALL, per_unit)
        lines.append(
            Line(
                EYE_NAMES[eye],
                theirs,
                ours,
                rebuilt,
                small if rebuilt is not None else None,
            )
        )
    unclear = (method, unit) in (("quality", "dB"), ("Gonzalez", "dB"))
    return Block(
        *(SYSTEMS[method], CELL_MEASURES[unit], tuple(lines)),
        is_own=method in OURS_OFF_AXIS,
        scene=SCENE_TITLES[scene],
        incomparable="our copy of the table does not say which method this is of"
        if unclear
        else "",
        rebuilt_as="640x360",
    )


def _field_time(measured, method, eye, scene, size, per_unit) -> float | None:
    time_ms = _field(measured, "median_ms", method, eye, scene, size)
    return None if time_ms is None else time_ms / per_unit


def _courtyard_blocks(measured: Measured) -> list[Block]:
    """Times of the paper's quality setup beside frames of Courtyard over the field."""
    theirs = table(10)["Primitives"]["quality"]
    gpu_cases = {
        "emmetropia": "emmetropia",
        "myopia": "-6 dpt",
        "keratoconus": "keratoconus",
    }
    quality, dynamic, on_gpu = [], [], []
    for eye in CONDITIONS:
        name, (published_ms, _) = EYE_NAMES[eye], _cell(theirs[eye])
        at = (eye, "courtyard", LARGE)
        quality.append(
            Line(name, published_ms, _field(measured, "median_ms", "ours quality", *at))
        )
        walk = {"method": "frame", "case": eye, "setting": f"{LARGE} 2 cores"}
        dynamic.append(
            Line(name, published_ms, measured.value("live", "median_ms", **walk))
        )
        if eye in gpu_cases:
            frame = {"case": gpu_cases[eye], "setting": f"{LARGE} moving"}
            ours_ms = measured.value("gpu", "median_ms", method="frame", **frame)
            on_gpu.append(Line(name, published_ms, ours_ms))
    return [
        Block(
            *(f"{SYSTEMS['quality']}, {mode}", MILLISECONDS, tuple(lines)),
            is_own=True,
            scene="Primitives (ours: Courtyard)",
            incomparable=why,
        )
        for mode, lines, why in (
            ("ocufilter's quality", quality, ""),
            ("ocufilter's dynamic mode", dynamic, ""),
            (
                "ocufilter's dynamic mode on an NVIDIA H100",
                on_gpu,
                "that card has five times the arithmetic and six times the bandwidth "
                "of the TITAN Xp",
            ),
        )
    ]


def _off_axis(measured: Measured) -> Section:
    blocks = [
        _off_axis_block(measured, scene, method)
        for scene in SCENES
        for method in table(10)[scene]
        if (scene, method) != ("Primitives", "quality")  # times, of which we have none
    ]
    blocks += _courtyard_blocks(measured)
    return section("Table 10", ("field", "live", "gpu"), blocks)


def psf_section(measured: Measured) -> Section:
    """The PSFs that the text counts, section 7.2: how many, and how long they take."""
    own = published()["text"]
    names = {
        "on-axis psfs": ("on the axis, all pupils and foci", "ours on-axis wide"),
        "quality psfs": ("quality: over the field, one state", "ours quality"),
        "dynamic psfs": ("dynamic: over the field, all states", "ours dynamic"),
    }
    seconds, psfs = [], []
    for key, (case, method) in names.items():
        rows = [
            row
            for row in measured.rows("field", method=method, size=LARGE)
            if row["scene"] == "courtyard"
        ]
        slowest = max(rows, key=lambda row: row["prepare_ms"], default=None)
        time_s = None if slowest is None else slowest["prepare_ms"] / 1e3
        count = None if slowest is None else slowest["psf_count"]
        if key == "dynamic psfs":
            caches = measured.rows("layers", method="cache")
            caches = [row for row in caches if row["setting"].startswith("dynamic")]
            slowest = max(caches, key=lambda row: row["median_ms"])
            time_s = slowest["median_ms"] / 1e3
            count = int(slowest["setting"].split(": ")[1].split()[0])
        seconds.append(Line(case, own[key]["seconds"], time_s))
        psfs.append(Line(case, own[key]["count"], count))
    return section(
        "Section 7.2",
        ("field", "layers"),
        (
            Block(
                *("The paper", SECONDS, tuple(seconds)),
                is_own=True,
                scene="before the first frame",
            ),
            Block(
                *("The paper", Measure("PSFs", "PSFs"), tuple(psfs)),
                is_own=True,
                is_contest=False,
                scene="how many",
            ),
        ),
    )


PIPELINE_MEASURES = {
    "error": DECIBELS,
    "prepare_ms": Measure("time to the first frame", "ms"),
    "median_ms": Measure("time of a frame", "ms"),
}


def pipeline_section(measured: Measured) -> Section:
    """The whole published pipeline, which one setting runs, beside the default."""
    blocks = []
    for column, measure in PIPELINE_MEASURES.items():
        lines = []
        for eye in CONDITIONS:
            rebuilt, ours = (
                measured.value("published", column, method=pipeline, case=eye)
                for pipeline in ("published", "exact")
            )
            lines.append(Line(EYE_NAMES[eye], None, None, rebuilt, ours))
        blocks.append(
            Block(
                *("The paper, end to end", measure, tuple(lines)),
                is_own=True,
                rebuilt_as='pipeline="published", 128x72, two cores',
            )
        )
    return section("Section 4", ("published",), blocks)
