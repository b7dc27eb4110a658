"""`ocufilter prepare`: what a machine compiles once, compiled now."""

from filter_service.commands.console import Json, print_json, say
from filter_service.progress import Progress


def prepare(json_output: Json = False) -> None:
    """Compile the loops that trace eyes and plan frames, once on a machine.

    A minute on two cores; later it only looks.  Without it the first start of the
    service compiles while it is idle, and the first eye waits for that.

    ocufilter prepare
    """
    import time

    from filter_service.filtering.compile_loops import compile_loops

    started_s = time.monotonic()
    with Progress(quiet=json_output) as progress:
        compile_loops(progress)
    spent_s = time.monotonic() - started_s
    if json_output:
        print_json({"ok": True, "seconds": round(spent_s, 1)})
    else:
        say(f"prepared in {spent_s:.0f} s")
