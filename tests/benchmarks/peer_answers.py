"""The loop of the scripts that `peer_process` starts; needs only the standard library.

A request is one line of JSON with a ``task`` and its arguments, an answer one line of
JSON.  What libraries print goes to stderr.
"""

import json
import os
import sys


def answer_requests(tasks):
    """Answer requests from stdin until it closes.

    Parameters
    ----------
    tasks : dict
        Functions by the name of their task; each returns what JSON can hold.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        request = json.loads(line)
        answer = tasks[request.pop("task")](**request)
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
