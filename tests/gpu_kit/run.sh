#!/bin/sh
# Measures ocufilter on this machine; no network is needed.
#
#   sh run.sh [--quick] [--out DIR] [--steps NAME ...]     run.sh --help tells more
#
# PYTHON names another Python than python3.
set -eu
kit=$(cd "$(dirname "$0")" && pwd)
commit=$(cat "$kit/COMMIT")
tree=$kit/work/tree-$commit
if [ ! -e "$tree/.whole" ]; then
    mkdir -p "$tree"
    tar -xzf "$kit/tree.tar.gz" -C "$tree"
    touch "$tree/.whole"
fi
cd "$tree"
exec "${PYTHON:-python3}" -m tests.gpu_kit.run --kit "$kit" "$@"
