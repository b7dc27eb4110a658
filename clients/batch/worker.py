"""Worker process: receives units through a pipe and returns records.

    python -m clients.batch.worker DESCRIPTOR

It exits when the pipe closes, at the latest between two frames.
"""

from __future__ import annotations

import sys
from multiprocessing.connection import Connection

from clients.batch.exact_filter import EngineUnusable
from clients.batch.work import UnitRunner


def main(descriptor: int) -> None:
    """Serve a pipe until it closes."""
    pipe = Connection(descriptor)
    try:
        runner = UnitRunner(*pipe.recv())
        while True:
            unit = pipe.recv()
            # while a unit runs nothing is sent: a readable pipe has been closed
            for record in runner.run(unit, lambda: not pipe.poll()):
                pipe.send(("record", record))
            pipe.send(("done", unit.number))
    except EngineUnusable as error:
        pipe.send(("unusable", str(error)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


if __name__ == "__main__":
    main(int(sys.argv[1]))
