"""The steps of `Containerfile` make a service, on the Debian of its base image.

The root of `setup_root.sh` has neither a container engine nor a network.  The image is
a folder of the test.  Packages of Debian are only looked up, and the dependencies are
those of the root.
"""

import json
import re
import shutil
import subprocess
import sysconfig
import time
from pathlib import Path

import pytest

from clients.filter_client import FilterClient
from filter_service.errors import FilterError
from filter_service.keys import KeyRing
from tests.end_to_end.conftest import make_view
from tests.source_tree import ROOT

START_S = 120.0
BUILT = ("__pycache__", "node_modules", "*.so")
"""What a checkout has and a clone has not."""


def steps() -> list[tuple[str, str]]:
    """Return instructions and arguments of the file, without comments."""
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    text = re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    lines = [line.split(maxsplit=1) for line in text.splitlines() if line.strip()]
    return [(instruction, " ".join(rest.split())) for instruction, rest in lines]


def stages() -> list[list[tuple[str, str]]]:
    """Return the steps of each stage."""
    found: list[list[tuple[str, str]]] = []
    for step in steps():
        if step[0] == "FROM":
            found.append([])
        elif found:
            found[-1].append(step)
    return found


def copy(arguments: str, folder: Path) -> None:
    """Copy sources from the checkout; each of them has to match."""
    *sources, target = arguments.split()
    for source in sources:
        paths = list(ROOT.glob(source))
        assert paths, f"COPY {source}: no such file"
        for path in paths:
            if path.is_dir():
                ignore = shutil.ignore_patterns(*BUILT)
                shutil.copytree(path, folder / target, ignore=ignore)
            else:
                shutil.copy(path, folder / target)


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """Run the steps; return the folder of the image."""
    image = tmp_path_factory.mktemp("image")
    source = image / "opt" / "source"
    source.mkdir(parents=True)
    packages = sysconfig.get_path("purelib")
    environment = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(image),
        "PYTHONPATH": packages,  # instead of an index: setuptools and dependencies
        "PIP_NO_BUILD_ISOLATION": "0",  # pip reads it as "no isolation"
        "PIP_NO_DEPS": "1",
        "PIP_NO_INDEX": "1",
    }
    build, final = stages()
    for instruction, arguments in build:
        if instruction == "COPY":
            copy(arguments, source)
        elif instruction == "RUN" and "apt-get" not in arguments:
            command = arguments.replace("/opt/ocufilter", str(image / "opt/ocufilter"))
            done = subprocess.run(
                ["sh", "-ec", command],
                cwd=source,
                env=environment,
                capture_output=True,
                text=True,
            )
            assert done.returncode == 0, done.stdout + done.stderr
    home = image / "home" / "ocufilter"
    home.mkdir(parents=True)
    (written,) = (rest for step, rest in final if step == "RUN" and "toml" in rest)
    subprocess.run(["sh", "-ec", written], cwd=home, check=True)
    return image


def test_every_package_that_a_stage_installs_is_in_debian():
    installed = [
        word
        for stage in stages()
        for step, rest in stage
        if step == "RUN" and "apt-get install" in rest
        for word in rest.split("--no-install-recommends")[1].split("&&")[0].split()
    ]
    _, final = stages()
    (default,) = (rest for step, rest in final if step == "ARG")
    installed += default.removeprefix("OPENGL_PACKAGES=").strip('"').split()
    installed.remove("${OPENGL_PACKAGES}")
    for name in installed:
        shown = subprocess.run(["dpkg-query", "-W", name], capture_output=True)
        assert shown.returncode == 0, name


def test_the_steps_of_the_image_make_a_service(image, tmp_path):
    _, final = stages()
    found = dict(final)
    own = f"{image}/opt/ocufilter/bin"
    assert found["ENV"] == "PATH=/opt/ocufilter/bin:$PATH"
    home = image / "home" / "ocufilter"
    config = home / "service.toml"
    settings = config.read_text(encoding="utf-8")
    port = int(found["EXPOSE"])
    assert f':{port}"' in settings
    KeyRing(tmp_path / "keys").add("lab", tmp_path / "lab.toml")
    config.write_text(settings.replace('"/keys"', f'"{tmp_path}/keys"'))
    entry = found["ENTRYPOINT"].replace("/home/ocufilter", str(home))
    command = json.loads(entry)
    environment = {
        "PATH": f"{own}:/usr/bin:/bin",
        "HOME": str(home),
        "PYTHONPATH": sysconfig.get_path("purelib"),
    }
    with subprocess.Popen(command, cwd=home, env=environment) as service:
        try:
            seen = filtered_when_ready(
                f"tcp://127.0.0.1:{port}", tmp_path / "lab.toml", service
            )
            _, health = found["HEALTHCHECK"].split(" CMD ")
            subprocess.run(json.loads(health), check=True, env=environment)
        finally:
            service.terminate()
        assert service.wait(20) == 0
    assert seen.color.shape == (36, 64, 3)
    # The libraries are those that the image's compiler has made.
    (package,) = (image / "opt/ocufilter").glob("lib/python3*/site-packages")
    assert (package / "filter_service/native/_loops.so").is_file()
    assert not list((image / "opt/ocufilter").glob("lib/python3*/site-packages/numpy"))


def filtered_when_ready(endpoint, key_file, service):
    """Filter a frame as soon as the service replies."""
    view = make_view()
    end_s = time.monotonic() + START_S
    while True:
        assert service.poll() is None, service.returncode
        try:
            with FilterClient(endpoint, key_file=key_file, timeout_s=5.0) as client:
                client.ping()
                client.set_profile("myopia", views=[view])
                return client.filter(view, pupil_diameter_mm=4.0, focus_dpt=0.0)
        except FilterError:
            assert time.monotonic() < end_s
