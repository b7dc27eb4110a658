"""One page: goals beside what was measured, and how each step went."""

from tests.gpu_kit.goals import NOT_JUDGED, Goal
from tests.gpu_kit.runner import DONE, FAILED, TOO_LONG, Outcome

LINE_LENGTH = 100
ENDED_BADLY = (FAILED, TOO_LONG)


def report_text(
    outcomes: list[Outcome],
    goals: list[Goal],
    *,
    hardware: dict,
    commit: str,
    is_quick: bool,
) -> str:
    """Return the page, in Markdown."""
    is_judged = not is_quick and not hardware.get("is_software", True)
    parts = [
        f"# ocufilter {commit} on {hardware.get('gl_renderer') or 'no GPU'}",
        _machine_line(hardware),
        _why_not_judged(hardware, is_quick=is_quick),
        _goal_table(outcomes, goals, is_quick=is_quick, is_judged=is_judged),
        _step_table(outcomes),
        *_tails(outcomes),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _machine_line(hardware: dict) -> str:
    names = ("device", "cpu", "n_cores", "python", "numpy", "torch", "date")
    names += ("shares",)
    told = [f"{name} {hardware[name]}" for name in names if hardware.get(name)]
    return ", ".join(told)


def _why_not_judged(hardware: dict, *, is_quick: bool) -> str:
    if is_quick:
        return "A quick run: small frames, one repeat; goals are not judged."
    if hardware.get("is_software", True):
        return "No hardware GPU was seen: goals are not judged."
    return ""


def _goal_table(outcomes, goals: list[Goal], *, is_quick, is_judged) -> str:
    contents = {outcome.name: outcome.content for outcome in outcomes}
    rows = ["| goal | wanted | measured | | from |", "|---|---|---|---|---|"]
    for goal in goals:
        content = contents.get(goal.step, {})
        value = goal.measured(content, is_quick=is_quick)
        verdict = goal.verdict(value, is_judged=is_judged)
        told = "-" if value is None else f"{value:.4g} {goal.unit}"
        if is_quick and goal.quick_row and value is not None:
            told += f" ({', '.join(goal.quick_row.values())})"
        shown = "" if verdict == NOT_JUDGED else verdict
        rows.append(
            f"| {goal.what} | {goal.wanted} | {told} | {shown} | {goal.source} |"
        )
    return "\n".join(rows)


def _step_table(outcomes: list[Outcome]) -> str:
    rows = ["| step | what | state | s | of |", "|---|---|---|---|---|"]
    rows += [
        f"| {outcome.name} | {_told(outcome)} | {outcome.state} "
        f"| {outcome.seconds:.1f} | {outcome.limit_s:.0f} |"
        for outcome in outcomes
    ]
    total_s = sum(outcome.seconds for outcome in outcomes)
    return "\n".join([*rows, f"| all | | | {total_s:.1f} | |"])


def _told(outcome: Outcome) -> str:
    """What a step measures; why it did not; of one without rows what it said last."""
    is_silent = outcome.state == DONE and outcome.content
    if is_silent or outcome.state in ENDED_BADLY or not outcome.tail:
        return outcome.what
    return f"{outcome.what}: {outcome.tail[-1][:LINE_LENGTH]}"


def _tails(outcomes: list[Outcome]) -> list[str]:
    """Last lines of what did not end well."""
    blocks = []
    for outcome in outcomes:
        if outcome.state in ENDED_BADLY and outcome.tail:
            text = "\n".join("    " + line[:LINE_LENGTH] for line in outcome.tail)
            blocks.append(f"{outcome.name}, {outcome.state}:\n\n{text}")
    return blocks
