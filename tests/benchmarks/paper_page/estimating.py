"""Tables 3, 4, 5 and 11: networks, the time and error of estimating eyes, the data."""

from tests.benchmarks.paper_page.measured import Measured
from tests.benchmarks.paper_page.published import published, table
from tests.benchmarks.paper_page.rows import Block, Line, Measure, Section
from tests.benchmarks.paper_page.words import section
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.published_networks import STEPS

SECONDS = Measure("time", "s")
STEP_TITLES = {
    "eye": "Eye structure (1 eye)",
    "focus": "Focus (42 states)",
    "on-axis": "Aberrations on the axis (126 nodes)",
    "off-axis": "Aberrations over the field (627 nodes)",
}
PREVIOUS_TITLES = {
    "eye": "Previous: pattern search [49]",
    "focus": "Previous: smallest spot [49]",
    "on-axis": "Previous: ray tracing [49]",
    "off-axis": "Previous: ray tracing [49]",
}
PREVIOUS_AS = {
    "eye": "search",
    "focus": "search",
    "on-axis": "exact",
    "off-axis": "exact",
}
EYE_NAMES = {
    "emmetropia": "Emmetropia",
    "myopia": "Myopia",
    "astigmatism": "Astigmatism",
    "keratoconus": "Keratoconus",
    "cataract": "Cataract",
    "post_lasik": "LASIK",
}

NETWORKS = {
    # the paper's name: ours in training/results, its card, unit
    "Eye structure estimator": ("eye", "um"),
    "Discriminator": ("discriminator", "um"),
    "Focused eye estimator": ("focus", "mm"),
    "Aberration estimator": ("aberration", "um"),
}
ARCHITECTURES = {
    "FFN": "ffn",
    "ResNet [79]": "resnet",
    "ResNet (ours)": "ours",
    "ResNet (ours) (no discriminator)": "ours, parameters loss",
}


def sections(measured: Measured) -> list[Section]:
    """Return all four."""
    return [
        _networks(measured),
        _times(measured),
        _errors(measured),
        _statistics(measured),
    ]


def _unit(name: str) -> str:
    return {"um": "µm"}.get(name, name)


def shipped_error(card: dict) -> float:
    """Mean absolute error of a network of ours over the domain of the paper's Table 2.

    Of the focus with the rows whose lens is at a bound, as the paper's has them.
    """
    found = card["error_by_rows"]["table_2"]
    return found.get("mean_abs_with_bounded", found["mean_abs"])


def _networks(measured: Measured) -> Section:
    blocks = []
    for title, (name, unit) in NETWORKS.items():
        rows = table(3)[title]
        ours = shipped_error(measured.cards[name])
        for architecture, own in rows.items():
            run = f"{name}: {ARCHITECTURES[architecture]}"
            rebuilt = measured.rows("table3", run=run)
            lines = (
                Line(
                    title,
                    own["mean_abs"],
                    ours,
                    rebuilt[0]["error"]["mean_abs"] if rebuilt else None,
                ),
            )
            is_last = architecture == "ResNet (ours)"
            blocks.append(
                Block(
                    f"{architecture}: {own['parameters_millions']:.0f} M weights",
                    Measure("mean abs. error", _unit(unit)),
                    lines,
                    "",
                    is_own=is_last,
                    rebuilt_as="0.3 M weights, 1 M rows",
                )
            )
    millions = sorted(c["n_parameters"] / 1e6 for c in measured.cards.values())
    bounded = measured.cards["focus"]["error_by_rows"]["table_2"]
    return section(
        "Table 3",
        ("table3",),
        blocks,
        low=f"{millions[0]:.1f}",
        high=f"{millions[-1]:.1f}",
        unbounded=f"{bounded['mean_abs']:.5f}",
    )


def _step_value(measured: Measured, column: str, step: str, eye: str, method: str):
    names = {"mean_abs_um", "mean_abs_mm"}
    for row in measured.rows("networks", step=step, case=eye, method=method):
        if row["error_name"] in names:
            return row[column]
    return None


def _seconds(measured: Measured, step: str, eye: str, method: str) -> float | None:
    time_ms = _step_value(measured, "median_ms", step, eye, method)
    return None if time_ms is None else time_ms / 1e3


def _times(measured: Measured) -> Section:
    blocks = []
    for step in STEPS:
        for which, title, method in (
            ("previous", PREVIOUS_TITLES[step], PREVIOUS_AS[step]),
            ("proposed", "The paper: network", "network"),
        ):
            is_stopped = (step, which) == ("eye", "previous")
            lines = []
            for eye in CONDITIONS:
                ours = _seconds(measured, step, eye, "exact")
                rebuilt = _seconds(measured, step, eye, method)
                lines.append(
                    Line(
                        EYE_NAMES[eye],
                        table(4)[step][which][eye],
                        ours,
                        f"{rebuilt:.1f}, stopped"
                        if is_stopped and rebuilt
                        else rebuilt,
                        ours,
                    )
                )
            blocks.append(
                Block(
                    title,
                    SECONDS,
                    tuple(lines),
                    "",
                    is_own=which == "proposed",
                    scene=STEP_TITLES[step],
                    rebuilt_as={
                        "eye": "search cut off at 8 s",
                        "focus": "smallest spot, anew",
                    }.get(step, "the method itself")
                    if which == "previous"
                    else "our network",
                )
            )
    return section("Table 4", ("networks",), blocks)


def _errors(measured: Measured) -> Section:
    blocks = []
    for step in STEPS:
        measure = Measure("mean abs. error", "mm" if step == "focus" else "µm")
        for which, title, method in (
            ("target", "Target: what was to be found", "exact"),
            ("previous", PREVIOUS_TITLES[step], PREVIOUS_AS[step]),
            ("proposed", "The paper: network", "network"),
        ):
            column = "target" if which == "target" else "error"
            lines = []
            for eye in CONDITIONS:
                ours = _step_value(measured, column, step, eye, "exact")
                rebuilt = _step_value(measured, column, step, eye, method)
                if which == "target":
                    rebuilt = None
                lines.append(
                    Line(
                        EYE_NAMES[eye], table(5)[step][which][eye], ours, rebuilt, ours
                    )
                )
            is_reference = which == "previous" and step != "eye"
            blocks.append(
                Block(
                    title,
                    measure,
                    tuple(lines),
                    "",
                    is_own=which == "proposed",
                    scene=STEP_TITLES[step],
                    is_contest=which != "target",
                    incomparable="it is the paper's reference: zero by definition"
                    if is_reference
                    else "",
                    rebuilt_as="our network"
                    if which == "proposed"
                    else "search cut off at 8 s"
                    if step == "eye"
                    else "anew",
                )
            )
    zeros = published()["tables"]["5"]["note"]
    return section("Table 5", ("networks",), blocks, zeros=zeros)


STATISTIC_NAMES = {
    "min": "Min",
    "max": "Max",
    "mean": "Mean",
    "abs_mean": "Abs. mean",
    "std": "Std. dev.",
    "q1": "Q1",
    "q2": "Q2",
    "q3": "Q3",
}
DOMAIN_TITLES = {
    "on_axis": "Discriminator",
    "field": "Aberration estimator",
    "focus": "Focus estimator",
}
GROUP_TITLES = {
    "lens_diameter_change_mm": "change of lens diameter",
    "aqueous_thickness_change_mm": "change of chamber depth",
}


def _statistics(measured: Measured) -> Section:
    blocks = []
    for domain, groups in table(11).items():
        found = measured.rows("table11", domain=domain)
        chains = list(dict.fromkeys(row["chain"] for row in found))
        last = [chain for chain in chains if chain != "paper"][-1]
        for group, own in groups.items():
            by_chain = {
                row["chain"]: row["statistics"]
                for row in found
                if row["group"] == group
            }
            lines = tuple(
                Line(
                    STATISTIC_NAMES[name],
                    value,
                    by_chain["ours"][name],
                    by_chain[last][name],
                )
                for name, value in own.items()
            )
            blocks.append(
                Block(
                    GROUP_TITLES.get(group, f"radial orders {group[2:]}"),
                    Measure("targets", "mm" if domain == "focus" else "µm"),
                    lines,
                    "",
                    is_own=True,
                    scene=DOMAIN_TITLES[domain],
                    is_contest=False,
                    rebuilt_as="ours, with their chain's properties",
                )
            )
    n_rows = measured.results("table11")["n_rows"]
    return section("Table 11", ("table11",), blocks, n_rows=f"{n_rows:,}")
