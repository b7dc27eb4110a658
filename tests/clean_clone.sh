#!/bin/sh
# Run make targets as a new user does: in a clone of the last commit, with the system's
# Python, the PATH of an ordinary account and an empty environment.
#
#   sh tests/clean_clone.sh FOLDER TARGET ...    clones into FOLDER if it does not exist
#   sh tests/clean_clone.sh                      only whether that is possible here
#
# Exit status: 77 if the system has no Python that can be used, or this is no clone.  The
# variables ORDER_SEED, OCUFILTER_DURATIONS and ARGS are passed on.
set -eu
cd "$(dirname "$0")/.."
account=/usr/local/bin:/usr/bin:/bin
python=$(PATH=$account command -v python3 || echo /usr/bin/python3)
usable='import sys, ensurepip, venv; sys.exit(sys.version_info < (3, 11))'
if ! "$python" -c "$usable" 2>/dev/null; then
    echo "clean clone: $python is not Python 3.11 or newer with the module venv" >&2
    exit 77
fi
git rev-parse --quiet --verify HEAD >/dev/null || exit 77
[ $# = 0 ] && exit
folder=$1
shift
if [ ! -e "$folder" ]; then git clone --quiet . "$folder"; fi
for target in "$@"; do
    echo "clean clone: make $target with $("$python" --version)"
    env -i HOME="$HOME" PATH="$account" \
        OCUFILTER_SETUP_YES="${OCUFILTER_SETUP_YES:-}" ORDER_SEED="${ORDER_SEED:-1}" \
        OCUFILTER_DURATIONS="${OCUFILTER_DURATIONS:-}" ARGS="${ARGS:-}" \
        make -C "$folder" "$target" || status=$?
done
exit "${status:-0}"
