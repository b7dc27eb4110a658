"""The README's Python example runs as printed, against `ocufilter serve`."""

import re
import signal
import subprocess
import sys
import time

from tests.source_tree import ROOT

START_LIMIT_S = 60
RUN_LIMIT_S = 60
STOP_LIMIT_S = 20


def test_the_python_example_prints_a_frame_of_the_size_it_sent(tmp_path):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    example = re.search(r"```python\n(.*?)```", readme, re.DOTALL)[1]
    ready_file = tmp_path / "endpoint"
    log = (tmp_path / "service.log").open("w+")
    service = subprocess.Popen(
        [
            *(sys.executable, "-m", "filter_service", "serve"),
            *("--bind", "tcp://127.0.0.1:*", "--ready-file", str(ready_file)),
        ],
        cwd=ROOT,
        stdout=log,
        stderr=log,
    )
    try:
        deadline_s = time.monotonic() + START_LIMIT_S
        while not ready_file.exists() and service.poll() is None:
            assert time.monotonic() < deadline_s, "the service did not become ready"
            time.sleep(0.05)
        assert service.poll() is None, (tmp_path / "service.log").read_text()
        endpoint = ready_file.read_text().strip()
        assert "tcp://127.0.0.1:5577" in example
        printed = subprocess.run(
            [sys.executable, "-c", example.replace("tcp://127.0.0.1:5577", endpoint)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=RUN_LIMIT_S,
        )
        assert printed.returncode == 0, printed.stderr
        assert printed.stdout.startswith("(270, 480, 3) ")
    finally:
        service.send_signal(signal.SIGINT)
        try:
            ended = service.wait(STOP_LIMIT_S)
        finally:
            service.kill()
            service.wait()
            log.close()
    assert ended in (0, 130)
    assert not ready_file.exists()
