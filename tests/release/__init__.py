"""Release of the package: `make release` and `make release-check`.

    python -m tests.release [--python PATH ...]    everything; writes dist/
    python -m tests.release --quick                the part for continuous integration

build         the sdist and the wheels, reproducible
headers.sh    the headers that the OpenXR layer is compiled with
contents      what must be in a wheel and in the sdist
smoke         the installed commands, in an environment of their own
pythons       environments of each Python, with the oldest and newest dependencies
environment   an empty environment, of this system or of another one in a folder
commands      child processes
aarch64       the native engine for aarch64 under emulation, with recorded calls
metadata      metadata of the repository and of distributions, citation, license
notices       NOTICE: an entry for every dependency and data file
sbom          bill of materials of what users install
sizes         installed sizes of dependencies
requirements  what the package requires, as declared and as installed
"""
