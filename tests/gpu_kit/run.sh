#!/bin/sh
# Measures ocufilter on this machine; no network is needed.
#
#   sh run.sh [--quick] [--out DIR] [--steps NAME ...]     run.sh --help tells more
#
# PYTHON names another Python than python3.
set -eu
kit=$(cd "$(dirname "$0")" && pwd)
commit=$(cat "$kit/COMMIT")
wanted=$(cat "$kit/PYTHON_VERSION")
python=${PYTHON:-python3}
found=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
if [ "$found" != "$wanted" ]; then
    echo "gpu-kit: the wheels are for Python $wanted, and $python is $found:" \
        "name another in PYTHON, or make the kit with PYTHON_VERSION=$found" >&2
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
