"""The tables and figures of the paper beside ours: where each value comes from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from tests.benchmarks.paper_page.measured import Measured
from tests.benchmarks.paper_page.published import published, section, table, words
from tests.benchmarks.paper_page.rows import Block, Line, Measure, Section

NAMES = words()["names"]
EYES, SYSTEMS, SCENES = NAMES["eyes"], NAMES["systems"], NAMES["scenes"]
SCENE_TITLES, STEP_TITLES = NAMES["scene_titles"], NAMES["step_titles"]
LARGE, SMALL = "1280x720", "640x360"
MIB, GIB, HOUR = 1e6 / 2**20, 1e6 / 2**30, 1.0 / 3.6e6
SECONDS, MILLISECONDS = Measure("time", "s"), Measure("time", "ms")
DECIBELS = Measure("PSNR", "dB", higher_is_better=True)
LAYERS = Measure("layers", "layers")
MIBS, GIBS = Measure("memory", "MiB"), Measure("memory", "GiB")
MAKING = "making a frame's PSFs"
ERROR_NAMES = ("mean_abs_um", "mean_abs_mm")


@dataclass(frozen=True)
class From:
    """Where a value of each eye comes from.

    Attributes
    ----------
    file, column : str
    where : dict
        Other columns of the row and their values.
    scale : float
        From the column's unit to that of the block.
    cases : dict
        Names of eyes in the file, where they differ.
    otherwise : From or None
        Where to look if there is no such row.
    read : callable or None
        From the column to the value, instead of ``scale``.
    """

    file: str
    column: str
    where: Mapping
    scale: float = 1.0
    cases: Mapping[str, str] = field(default_factory=dict)
    otherwise: "From | None" = None
    read: Callable | None = None

    def value(self, measured: Measured, eye: str):
        """Return the value of an eye; None where there is none."""
        case = self.cases.get(eye, eye)
        found = measured.value(self.file, self.column, case=case, **self.where)
        if found is None:
            return self.otherwise and self.otherwise.value(measured, eye)
        return self.read(found) if self.read else found * self.scale


def in_field(column: str, method: str, scene: str, size: str, **more) -> From:
    """Return a column of field.json."""
    where = {"method": method, "scene": SCENES.get(scene, scene), "size": size}
    return From("field", column, where, **more)


def in_layers(column: str, method: str, mode: str, **more) -> From:
    """Return a column of layers.json."""
    return From("layers", column, {"method": method, "setting": f"{mode}*"}, **more)


def eye_block(
    measured: Measured,
    system: str,
    measure: Measure,
    own: Mapping[str, float] | None,
    sources: tuple[From | None, ...],
    **more,
) -> Block:
    """Make a block with a line for each eye.

    ``own`` are the published figures; ``sources`` are of ours, of the system built
    anew, and of ours in the same conditions, as many as there are.
    """
    lines = [
        Line(
            *(EYES[eye], own[eye] if own else None),
            *(source and source.value(measured, eye) for source in sources),
        )
        for eye in own or EYES
    ]
    return Block(system, measure, tuple(lines), **more)


# Table 3


def networks(measured: Measured) -> Section:
    """Table 3: errors of networks over the domain of the paper's Table 2."""
    blocks = []
    for title, (name, unit) in NAMES["networks"].items():
        found = measured.cards[name]["error_by_rows"]["table_2"]
        # of the focus with the rows whose lens is at a bound, as the paper has them
        ours = found.get("mean_abs_with_bounded", found["mean_abs"])
        for architecture, own in table(3)[title].items():
            run = f"{name}: {NAMES['architectures'][architecture]}"
            rebuilt = measured.value("table3", "error", run=run)
            line = Line(
                architecture, own["mean_abs"], ours, rebuilt and rebuilt["mean_abs"]
            )
            blocks.append(
                Block(
                    f"{architecture}: {own['parameters_millions']:.0f} M weights",
                    Measure("mean abs. error", unit),
                    (line,),
                    is_own=architecture == "ResNet (ours)",
                    scene=title,
                    rebuilt_as="0.3 M weights, 1 M rows",
                    rebuilt_is_same=False,
                )
            )
    millions = sorted(card["n_parameters"] / 1e6 for card in measured.cards.values())
    unbounded = measured.cards["focus"]["error_by_rows"]["table_2"]["mean_abs"]
    return section(
        *("Table 3", ("table3",), blocks),
        low=f"{millions[0]:.1f}",
        high=f"{millions[-1]:.1f}",
        unbounded=f"{unbounded:.5f}",
    )


# Tables 4 and 5


def _in_networks(
    step: str, method: str | None, column: str, scale: float = 1.0
) -> From:
    where = {"step": step, "method": method, "error_name": ERROR_NAMES}
    return From("networks", column, where, scale)


def _steps(measured: Measured, step: str, column: str) -> list[Block]:
    is_time = column == "median_ms"
    measure = Measure("mean abs. error", "mm" if step == "focus" else "µm")
    blocks = []
    scale = 1e-3 if is_time else 1.0
    for way in words()["ways"][step]:
        ours = _in_networks(step, way["ours"], column, scale)
        rebuilt = _in_networks(step, way.get("rebuilt"), column, scale)
        if is_time and step == "eye":
            rebuilt = None  # the time of a search that was cut off says nothing
        block = eye_block(
            *(measured, way["title"], SECONDS if is_time else measure),
            table(4 if is_time else 5)[step][way["which"]],
            (ours, rebuilt, ours),
            is_own=way["which"] == "proposed",
            scene=STEP_TITLES[step],
            incomparable="" if is_time else way.get("apart", ""),
            rebuilt_as=way.get("rebuilt_as", ""),
        )
        blocks.append(block)
    return blocks


def times(measured: Measured) -> Section:
    """Table 4: seconds of each step of estimating an eye."""
    blocks = [
        block for step in STEP_TITLES for block in _steps(measured, step, "median_ms")
    ]
    return section("Table 4", ("networks",), blocks)


def errors(measured: Measured) -> Section:
    """Table 5: their errors, and what was to be found."""
    blocks = []
    for step in STEP_TITLES:
        target = eye_block(
            *(measured, "Target: what was to be found"),
            Measure("mean abs. value", "mm" if step == "focus" else "µm"),
            table(5)[step]["target"],
            (_in_networks(step, "exact", "target"),),
            scene=STEP_TITLES[step],
            is_contest=False,
        )
        blocks += [target, *_steps(measured, step, "error")]
    zeros = published()["tables"]["5"]["note"]
    return section("Table 5", ("networks",), blocks, zeros=zeros)


# Tables 6 to 10


def layouts(measured: Measured) -> Section:
    """Table 6: layers and memory of a frame's PSFs, and the time to make them."""
    kernels = in_layers(
        *("setting", "frame kernels", "on-axis"),
        read=lambda setting: setting.split(": ")[1].split(";")[0],
    )
    atlas = in_layers("memory_mb", "frame kernels", "on-axis", scale=MIB)
    making = in_layers("median_ms", "frame kernels", "on-axis")
    apart = "the paper's texture is dimensioned for all its pupils and foci"
    blocks = []
    for which, method in (("previous", "predecessor"), ("proposed", "paper on-axis")):
        system, rebuilt = SYSTEMS[method], {"method": method}
        count = From("paper_layouts", "n", rebuilt)
        memory = From("paper_layouts", "memory_mb", rebuilt, MIB)
        blocks += [
            eye_block(
                *(measured, system, measure, table(6)[column][which], sources),
                is_own=which == "proposed",
                rebuilt_as="the layout, for 5 mm and 0.5 dpt",
                **more,
            )
            for column, measure, sources, more in (
                ("layers", LAYERS, (kernels, count), {"is_contest": False}),
                ("memory_mib", MIBS, (atlas, memory, atlas), {"incomparable": apart}),
                ("interpolation_ms", MILLISECONDS, (making,), {"scene": MAKING}),
            )
        ]
    return section("Table 6", ("layers", "paper_layouts"), blocks)


def _on_axis(measured: Measured, number: int, measure, column, sizes, as_what):
    large, small = sizes
    blocks = [
        eye_block(
            *(measured, SYSTEMS[method], measure, own[scene]),
            (
                in_field(column, "ours on-axis", scene, large),
                in_field(column, method, scene, small),
                in_field(column, "ours on-axis", scene, small),
            ),
            is_own=method == "paper on-axis",
            scene=SCENE_TITLES[scene],
            rebuilt_as=as_what,
        )
        for scene in SCENES
        for method, own in table(number).items()
    ]
    return section(f"Table {number}", ("field",), blocks)


def times_on_axis(measured: Measured) -> Section:
    """Table 7: times of frames."""
    how = ("median_ms", (LARGE, LARGE), "by FFT, two cores")
    return _on_axis(measured, 7, MILLISECONDS, *how)


def errors_on_axis(measured: Measured) -> Section:
    """Table 8: their errors."""
    how = ("psnr_srgb8_db", (LARGE, SMALL), "640x360, our scenes")
    return _on_axis(measured, 8, DECIBELS, *how)


def field_textures(measured: Measured) -> Section:
    """Table 9: memory and times of PSFs over the visual field."""

    def memory(method: str, size: str) -> From:
        return in_field("memory_mb", method, "courtyard", size, scale=GIB)

    one_state = (
        memory("ours quality", LARGE),
        memory("paper quality", SMALL),
        memory("ours quality", SMALL),
    )
    all_states = (
        in_layers("memory_mb", "cache", "dynamic", scale=GIB),
        memory("paper dynamic", SMALL),
        memory("ours dynamic", SMALL),
    )
    texture = (in_layers("memory_mb", "frame kernels", "dynamic", scale=MIB),)
    making = (in_layers("median_ms", "frame kernels", "dynamic"),)
    scenes = (
        *("texture of one pupil and focus", "cache for all pupils and foci"),
        *("texture of a frame", "making the texture of a frame"),
    )
    blocks = [
        eye_block(
            *(measured, SYSTEMS[mode], measure, table(9)[mode][column], sources),
            is_own=True,
            scene=scene,
            rebuilt_as=SMALL,
        )
        for mode, column, measure, scene, sources in (
            ("quality", "memory_gib", GIBS, scenes[0], one_state),
            ("dynamic", "cache_gib", GIBS, scenes[1], all_states),
            ("dynamic", "texture_mib", MIBS, scenes[2], texture),
            ("dynamic", "interpolation_ms", MILLISECONDS, scenes[3], making),
        )
    ]
    return section("Table 9", ("layers", "field"), blocks)


CELL_MEASURES = {"h": Measure("time", "h"), "ms": MILLISECONDS, "dB": DECIBELS}
OURS_OFF_AXIS = {"quality": "ours quality", "dynamic": "ours dynamic"}
REBUILT = {"quality": "paper quality", "dynamic": "paper dynamic"}
GPU_CASES = {eye: eye for eye in ("emmetropia", "keratoconus")} | {"myopia": "-6 dpt"}
UNCLEAR = "our copy of the table does not say which method this is of"
OTHER_CARD = (
    "that card has five times the arithmetic and six times the bandwidth of the TITAN "
    "Xp"
)


def _numbers(cells: Mapping[str, str]) -> dict[str, float]:
    return {eye: float(cell.split()[0]) for eye, cell in cells.items()}


def _off_axis_block(measured: Measured, scene: str, method: str) -> Block:
    cells = table(10)[scene][method]
    (unit,) = {cell.split()[1] for cell in cells.values()}
    ours = OURS_OFF_AXIS.get(method, "ours quality")
    column, scale, rebuilt = "median_ms", HOUR if unit == "h" else 1.0, method
    if unit == "dB":
        column, rebuilt = "psnr_srgb8_db", REBUILT.get(method, method)
    small = in_field(column, ours, scene, SMALL, scale=scale)
    large = in_field(
        *(column, ours, scene, LARGE),
        scale=scale,
        otherwise=small if unit == "dB" else None,
    )
    unclear = unit == "dB" and method in ("quality", "Gonzalez")
    return eye_block(
        *(measured, SYSTEMS[method], CELL_MEASURES[unit], _numbers(cells)),
        (large, in_field(column, rebuilt, scene, SMALL, scale=scale), small),
        is_own=method in OURS_OFF_AXIS,
        scene=SCENE_TITLES[scene],
        incomparable=UNCLEAR if unclear else "",
        rebuilt_as=SMALL,
    )


def off_axis(measured: Measured) -> Section:
    """Table 10: times and errors over the visual field."""
    blocks = [
        _off_axis_block(measured, scene, method)
        for scene in SCENES
        for method in table(10)[scene]
        if (scene, method) != ("Primitives", "quality")  # times, of which we have none
    ]
    own = _numbers(table(10)["Primitives"]["quality"])
    walk = {"method": "frame", "setting": f"{LARGE} 2 cores"}
    moving = {"method": "frame", "setting": f"{LARGE} moving"}
    quality = in_field("median_ms", "ours quality", "courtyard", LARGE)
    dynamic, on_gpu = (
        From("live", "median_ms", walk),
        From("gpu", "median_ms", moving, cases=GPU_CASES),
    )
    for mode, ours, eyes, why in (
        ("ocufilter's quality", quality, EYES, ""),
        ("ocufilter's dynamic mode", dynamic, EYES, ""),
        ("ocufilter's dynamic mode on an NVIDIA H100", on_gpu, GPU_CASES, OTHER_CARD),
    ):
        block = eye_block(
            *(measured, f"{SYSTEMS['quality']}, {mode}", MILLISECONDS),
            *({eye: own[eye] for eye in EYES if eye in eyes}, (ours,)),
            is_own=True,
            scene="Primitives (ours: Courtyard)",
            incomparable=why,
        )
        blocks.append(block)
    return section("Table 10", ("field", "live", "gpu"), blocks)


# Table 11


def statistics(measured: Measured) -> Section:
    """Table 11: the data of the training."""
    blocks = []
    for domain, groups in table(11).items():
        scene, unit = NAMES["domains"][domain]
        chains = [row["chain"] for row in measured.rows("table11", domain=domain)]
        last = [chain for chain in chains if chain != "paper"][-1]
        for group, own in groups.items():
            ours, rebuilt = (
                measured.value(
                    "table11", "statistics", domain=domain, group=group, chain=chain
                )
                for chain in ("ours", last)
            )
            lines = [
                Line(NAMES["statistics"][name], value, ours[name], rebuilt[name])
                for name, value in own.items()
            ]
            blocks.append(
                Block(
                    NAMES["groups"].get(group, f"radial orders {group[2:]}"),
                    *(Measure("targets", unit), tuple(lines)),
                    is_own=True,
                    scene=scene,
                    is_contest=False,
                    rebuilt_as="ours, with their chain's properties",
                )
            )
    n_rows = measured.results("table11")["n_rows"]
    return section("Table 11", ("table11",), blocks, n_rows=f"{n_rows:,}")


# Figures

SIDES = {
    # of figure 1: what is in its time of estimation, and the method of ours
    "left: the PSFs of the axis everywhere": ("on-axis", "ours on-axis"),
    "right: over the visual field": ("off-axis", "ours dynamic"),
}


def first_figure(measured: Measured) -> Section:
    """Figure 1, with the two times of its caption."""
    own = published()["figures"]["1"]
    estimation, rendering = [], []
    for k, (case, (step, method)) in enumerate(SIDES.items()):
        steps = [
            _in_networks(name, "exact", "median_ms", 1e-3).value(measured, "myopia")
            for name in ("eye", "focus", step)
        ]
        ours_s = None if None in steps else sum(steps)
        estimation.append(Line(case, own["estimation_s"][k], ours_s))
        frame = in_field("median_ms", method, "courtyard", LARGE)
        rendering.append(
            Line(case, own["rendering_ms"][k], frame.value(measured, "myopia"))
        )
    blocks = [
        Block("The paper", measure, tuple(lines), is_own=True, scene=scene)
        for measure, lines, scene in (
            (SECONDS, estimation, "estimating the eye and its aberrations"),
            (MILLISECONDS, rendering, "rendering a frame"),
        )
    ]
    picture = "paper_figure_1.jpg"
    return section("Figure 1", ("networks", "field"), blocks, picture=picture)


def picture_section(measured: Measured, number: int) -> Section:
    """Figures 9 to 12, with the errors of the parts that they show large."""
    found = measured.rows("paper_figures", figure=number)
    names = dict.fromkeys(name for row in found for name in row["psnr_db"])
    (ours,) = (name for name in names if name.startswith("ours"))
    titles = {scene: scene.capitalize() for scene in SCENES.values()}
    blocks = [
        Block(
            SYSTEMS.get(name.removeprefix("paper "), SYSTEMS.get(name, name)),
            DECIBELS,
            tuple(
                Line(
                    f"{row['eye']}, {titles[row['scene']]}",
                    *(None, None, row["psnr_db"][name], row["psnr_db"][ours]),
                )
                for row in found
            ),
            is_own=name.startswith("paper"),
            scene="part of the picture, linear light",
            rebuilt_as="part of the picture",
        )
        for name in names
        if name != ours
    ]
    content = measured.results("paper_figures")
    return section(
        *(f"Figure {number}", ("paper_figures",), blocks),
        entry="pictures",
        picture=f"paper_figure_{number}.jpg",
        field="over the visual field" if number in (11, 12) else "on the axis",
        eyes="with mixed aberrations" if number in (10, 12) else "of low order only",
        size=content["size"],
        state=content["state"],
    )


# Numbers of the text


def psf_section(measured: Measured) -> Section:
    """Section 7.2: how many PSFs there are before the first frame, and their time."""
    own = published()["text"]
    seconds, counts = [], []
    for key, case, method in (
        ("on-axis psfs", "on the axis, all pupils and foci", "ours on-axis wide"),
        ("quality psfs", "quality: over the field, one state", "ours quality"),
        ("dynamic psfs", "dynamic: over the field, all states", ""),
    ):
        if method:
            where = {"method": method, "size": LARGE, "scene": "courtyard"}
            found = [
                (row["prepare_ms"], row["psf_count"])
                for row in measured.rows("field", **where)
            ]
        else:
            found = [
                (row["median_ms"], int(row["setting"].split(": ")[1].split()[0]))
                for row in measured.rows("layers", method="cache", setting="dynamic*")
            ]
        time_ms, count = max(found, default=(None, None))
        seconds.append(Line(case, own[key]["seconds"], time_ms and time_ms / 1e3))
        counts.append(Line(case, own[key]["count"], count))
    blocks = [
        Block("The paper", measure, tuple(lines), is_own=True, **more)
        for measure, lines, more in (
            (SECONDS, seconds, {"scene": "before the first frame"}),
            (
                *(Measure("PSFs", "PSFs"), counts),
                {"scene": "how many", "is_contest": False},
            ),
        )
    ]
    return section("Section 7.2", ("field", "layers"), blocks)


def pipeline_section(measured: Measured) -> Section:
    """Section 4: the published pipeline, which one setting runs, and the default."""
    blocks = [
        eye_block(
            *(measured, "The paper, end to end", measure, None),
            (
                None,
                From("published", column, {"method": "published"}),
                From("published", column, {"method": "exact"}),
            ),
            is_own=True,
            rebuilt_as='pipeline="published", 128x72, two cores',
        )
        for column, measure in (
            ("error", DECIBELS),
            ("prepare_ms", Measure("time to the first frame", "ms")),
            ("median_ms", Measure("time of a frame", "ms")),
        )
    ]
    return section("Section 4", ("published",), blocks)


def all_sections(measured: Measured) -> list[Section]:
    """Return every figure and table, by number, and numbers of the text."""
    return [
        first_figure(measured),
        *(picture_section(measured, number) for number in (9, 10, 11, 12)),
        *(
            make(measured)
            for make in (
                *(networks, times, errors, layouts, times_on_axis, errors_on_axis),
                *(field_textures, off_axis, statistics, pipeline_section, psf_section),
            )
        ),
    ]
