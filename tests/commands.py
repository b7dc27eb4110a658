"""Run `ocufilter` in the process of the tests.

A process of its own takes 1 to 3 s to import the program.  Tests start one only where
the process is the subject: signals, the environment, exit by the interpreter.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import resource
import subprocess
import sys
import warnings
from pathlib import Path
from unittest import mock

from tests.source_tree import ROOT


@contextlib.contextmanager
def full_disk(n_bytes: int = 1000):
    """Let no file grow beyond a size, as on a disk that becomes full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class _Captured(io.TextIOWrapper):
    """A text stream with a buffer, as ``sys.stdout`` is."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO(), encoding="utf-8", write_through=True)

    def text(self) -> str:
        return self.buffer.getvalue().decode("utf-8")


def run_command(*arguments, cwd: Path = ROOT, **environment: str):
    """Run the program; return what it prints and its exit code.

    Parameters
    ----------
    *arguments : object
        Arguments of ``ocufilter``, converted to str.
    cwd : path, optional
        Working directory; the checkout by default.
    **environment : str
        Variables that the program reads when it runs, not when it is imported.

    Returns
    -------
    subprocess.CompletedProcess
    """
    from clients.commands.program import main

    return run_main(with_arguments(main), *arguments, cwd=cwd, **environment)


def with_arguments(main):
    """Return a function of the arguments that `main` takes from ``sys.argv``."""

    def run(words):
        with mock.patch.object(sys, "argv", ["ocufilter", *words]):
            main()

    return run


def run_main(main, *arguments, cwd: Path = ROOT, **environment: str):
    """Call a program's main function with its arguments, as `run_command` does."""
    words = [str(word) for word in arguments]
    out, err = _Captured(), _Captured()
    before, folder = dict(os.environ), Path.cwd()
    handlers = logging.getLogger().handlers[:]
    os.environ.update(environment)
    os.chdir(cwd)
    try:
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("default")
            warnings.simplefilter("ignore", DeprecationWarning)  # as Python does
            try:
                code = main(words)
            except SystemExit as ended:
                code = ended.code
                if isinstance(code, str):
                    sys.stderr.write(code + "\n")
                    code = 1
    finally:
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(before)
        logging.getLogger().handlers[:] = handlers
    return subprocess.CompletedProcess(words, code or 0, out.text(), err.text())
