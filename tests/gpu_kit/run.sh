#!/bin/sh
# Run the tests and benchmarks of ocufilter on this machine, without a network.
#
#   sh run.sh [--quick] [--out DIR] [--steps NAME ...]     see run.sh --help
#
# PYTHON selects the Python to use (default: python3).
set -eu
kit=$(cd "$(dirname "$0")" && pwd)
commit=$(cat "$kit/COMMIT")
wanted=$(cat "$kit/PYTHON_VERSION")
python=${PYTHON:-python3}
found=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
if [ "$found" != "$wanted" ]; then
    echo "gpu-kit: the wheels are for Python $wanted, but $python is $found; set" \
        "PYTHON, or build the kit with PYTHON_VERSION=$found" >&2
    exit 1
fi
tree=$kit/unpacked/tree-$commit
if [ ! -e "$tree/.whole" ]; then
    mkdir -p "$tree"
    tar -xzf "$kit/tree.tar.gz" -C "$tree"
    touch "$tree/.whole"
fi
cd "$tree"
exec "$python" -m tests.gpu_kit.run --kit "$kit" "$@"
