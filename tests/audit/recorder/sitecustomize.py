"""Record the project's functions that a process calls, while a flag is set.

Python imports this at its start in every process whose ``PYTHONPATH`` contains the
folder; `tests.audit.walks` sets it.
"""

import mmap
import os
import sys
import threading
from pathlib import Path

PACKAGES = ("filter_service", "estimator", "clients", "ocufilter")
OPTIMIZED = 1  # CO_OPTIMIZED: of functions, not of modules and classes


def record(folder, root):
    """Append file and function to a file of this process at each first call.

    The flag is 0, or the number of the recording.
    """
    with (folder / "flag").open("rb") as file:
        flag = mmap.mmap(file.fileno(), 1, prot=mmap.PROT_READ)
    prefixes = tuple(os.path.join(root, package) + os.sep for package in PACKAGES)
    seen = {}

    def note(frame, event, argument):
        code = frame.f_code
        number = flag[0]
        if not number or event != "call" or seen.get(code) == number:
            return
        seen[code] = number
        name = code.co_filename
        if code.co_flags & OPTIMIZED and name.startswith(prefixes):
            with (folder / f"{os.getpid()}.calls").open("a") as calls:
                calls.write(f"{name[len(root) + 1 :]}\t{code.co_qualname}\n")

    threading.setprofile(note)
    sys.setprofile(note)


if os.environ.get("OCUFILTER_WALK_FOLDER"):
    record(Path(os.environ["OCUFILTER_WALK_FOLDER"]), os.environ["OCUFILTER_WALK_ROOT"])
