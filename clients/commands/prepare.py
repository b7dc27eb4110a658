"""`ocufilter prepare`: compile ahead what a machine compiles once."""

from clients.commands.console import Json, print_json, say
from filter_service.progress import Progress


def prepare(json_output: Json = False) -> None:
    """Compile the loops that trace eyes and plan frames, once per machine.

    This takes a minute on two cores; later runs only check.  Without it, the service
    compiles while idle at its first start, and the first eye waits for that.

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
