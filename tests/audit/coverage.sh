#!/bin/sh
# Record which lines of the product each test executes, child processes included.
#
#   sh tests/audit/coverage.sh FOLDER [PYTEST ARGUMENT ...]
#   python -m tests.audit.faults run FOLDER
#
# Without arguments for pytest, the tests are those of `make test`.  FOLDER/combined is a
# file for `coverage`; the table of packages is printed at the end.
set -eu
cd "$(dirname "$0")/../.."
export OCUFILTER_COVERAGE="$1"
shift
settings=tests/audit/coverage.ini
rm -rf "$OCUFILTER_COVERAGE"
mkdir -p "$OCUFILTER_COVERAGE"
export OCUFILTER_DURATIONS="$OCUFILTER_COVERAGE/durations.json"
if [ $# = 0 ]; then
    often="not clock and not slow and not gpu"
    set -- -m "$often and (brief or not (gl or clients or tools))" \
        tests/unit tests/numerical tests/end_to_end
fi
.venv/bin/python -m coverage run --rcfile $settings -m pytest -q -n 2 \
    --dist loadfile "$@" || status=$?
unset OCUFILTER_DURATIONS
.venv/bin/python -m coverage combine --quiet --rcfile $settings \
    --data-file="$OCUFILTER_COVERAGE/combined" "$OCUFILTER_COVERAGE"/data.*
.venv/bin/python -m tests.audit.coverage_table "$OCUFILTER_COVERAGE"
exit ${status:-0}
