"""A worker's process: units come through a pipe, records go back.

    python -m clients.batch.worker DESCRIPTOR

It ends when the pipe does, between two frames at the latest.
"""

from __future__ import annotations

import sys
from multiprocessing.connection import Connection

from clients.batch.exact_filter import EngineUnusable
from clients.batch.work import UnitRunner


def main(descriptor: int) -> None:
    """Serve a pipe until it ends."""
    pipe = Connection(descriptor)
    try:
        runner = UnitRunner(*pipe.recv())
        while True:
            unit = pipe.recv()
            # while a unit runs nothing is sent: what can be read is the pipe's end
            for record in runner.run(unit, lambda: not pipe.poll()):
                pipe.send(("record", record))
            pipe.send(("done", unit.number))
    except EngineUnusable as error:
        pipe.send(("unusable", str(error)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


if __name__ == "__main__":
    main(int(sys.argv[1]))
