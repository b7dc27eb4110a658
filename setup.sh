#!/bin/sh
# Makes a bare Debian or Ubuntu machine ready; the Makefile calls it first.
#
#   sh setup.sh         the Python environment in .venv and the system libraries
#   sh setup.sh test    the same, a virtual screen for the window test, and Node
#   sh setup.sh training  the first, and what training the networks needs (torch)
#   sh setup.sh batch-ray the first, and Ray in an environment of its own
#   sh setup.sh examples  an environment of its own that has the package and Jupyter
#   sh setup.sh page    the first, and what `ocufilter web` needs
#   sh setup.sh web     the same, and a browser for its tests
#   sh setup.sh docs    the first, and what builds the documentation
#   sh setup.sh witness   the first, and a path tracer in an environment of its own
#
# Running it again costs a fraction of a second: the environment is installed anew only
# when this file, setup.py, pyproject.toml, constraints.txt, the sources in C or the
# folder has changed.
set -eu
cd "$(dirname "$0")"

SYSTEM_PACKAGES="libegl1 libgl1 libgl1-mesa-dri libgomp1"
C_PACKAGES="gcc libc6-dev"
TEST_PACKAGES="xvfb"
NODE_PACKAGES="nodejs npm"
# what the modules with compiled loops import
COMPILER_PACKAGES="numpy scipy numba msgspec lazy-loader moderngl"
# of `make witness`: nothing of the project imports it
WITNESS_PACKAGES="mitsuba==3.9.1 numpy"
WITNESS_LLVM_PACKAGES="libllvm19 libllvm18 libllvm17 libllvm16"
WITNESS_VENV=.witness
RAY_VENV=.batch_ray
DOCS_VENV=.docs
EXAMPLES_VENV=.examples
# of `make docs`
DOCS_PACKAGES="mkdocs-material mkdocstrings[python]"
# of `make test-web`
BROWSER_PACKAGES="chromium fonts-dejavu-core"
VENV=.venv
STAMP=$VENV/.ocufilter-installed
EXAMPLES_STAMP=$EXAMPLES_VENV/.ocufilter-installed
TRAINING_STAMP=$VENV/.ocufilter-training-installed
PAGE_STAMP=$VENV/.ocufilter-page-installed

say() { printf 'setup: %s\n' "$*" >&2; }

# --- system libraries --------------------------------------------------------

missing_packages() {
    for package in "$@"; do
        status=$(dpkg-query -W -f '${Status}' "$package" 2>/dev/null || true)
        case $status in *"ok installed") ;; *) echo "$package" ;; esac
    done | xargs # on one line
}

apt_prefix() { # what to put before apt-get, or failure when we may not run it
    if [ "$(id -u)" = 0 ]; then
        echo env
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        echo sudo -n env
    else
        return 1
    fi
}

apt_install() {
    prefix=$(apt_prefix) || return 1
    say "installing $* with apt-get"
    log=$(mktemp)
    if { $prefix apt-get update &&
        $prefix DEBIAN_FRONTEND=noninteractive \
            apt-get install -y --no-install-recommends "$@"; } >"$log" 2>&1; then
        rm -f "$log"
    else
        tail -n 5 "$log" >&2
        rm -f "$log"
        return 1
    fi
}

install_command() { echo "sudo apt-get update && sudo apt-get install -y $*"; }

install_system_libraries() {
    if ! command -v dpkg-query >/dev/null; then
        say "not a Debian system: EGL, OpenGL (Mesa) and libgomp must be there already"
        return
    fi
    missing=$(missing_packages $SYSTEM_PACKAGES)
    if [ -n "$missing" ] && ! apt_install $missing; then
        say "these system packages are missing: $missing"
        say "install them, then start again:  $(install_command "$missing")"
        exit 1
    fi
}

can_compile() { echo 'int main(void) { return 0; }' | cc -x c -o /dev/null - 2>/dev/null; }

install_c_compiler() { # for the native engine; without it Mesa filters, 20 times slower
    if can_compile; then return; fi
    if command -v dpkg-query >/dev/null && apt_install $C_PACKAGES; then return; fi
    say "without a C compiler frames go through OpenGL alone, slowly where there is no" \
        "GPU; to have one:  $(install_command "$C_PACKAGES")"
}

install_test_packages() { # worth having, but the tests run without
    command -v dpkg-query >/dev/null || return 0
    missing=$(missing_packages $TEST_PACKAGES)
    if [ -n "$missing" ] && ! apt_install $missing; then
        say "without $missing the window test is skipped;" \
            "to run it:  $(install_command "$missing")"
    fi
}

install_javascript_client() { # its packages, for its test
    if ! command -v npm >/dev/null; then
        apt_install $NODE_PACKAGES || true
    fi
    if ! command -v npm >/dev/null; then
        say "without Node the test of the JavaScript client is skipped;" \
            "to run it:  $(install_command "$NODE_PACKAGES")"
        return
    fi
    stamp=clients/js/node_modules/.ocufilter-installed
    if cmp -s clients/js/package.json $stamp; then return; fi
    say "installing the packages of the JavaScript client"
    (cd clients/js && npm install --no-package-lock --silent --no-fund --no-audit)
    cp clients/js/package.json $stamp
}

# --- Python environment ------------------------------------------------------

find_python() { # the first Python 3.11 or newer; asked, as a name alone may lie
    for name in python3 python3.13 python3.12 python3.11; do
        if "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
            2>/dev/null; then
            echo "$name"
            return
        fi
    done
    say "Python 3.11 or newer is needed:  $(install_command python3 python3-venv)"
    exit 1
}

make_venv() {
    python=$(find_python)
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        say "$python has no venv module:  $(install_command python3-venv)"
        exit 1
    fi
    "$python" -m venv --clear $VENV
}

install_packages() {
    sources=$(echo filter_service/native/source/* filter_service/service/*.c)
    wanted=$(pwd; cat setup.sh setup.py pyproject.toml constraints.txt $sources | cksum)
    if [ "$(cat $STAMP 2>/dev/null || true)" = "$wanted" ]; then return; fi
    if ! $VENV/bin/python -m pip --version >/dev/null 2>&1; then make_venv; fi
    rm -f $STAMP $TRAINING_STAMP $PAGE_STAMP
    say "installing the pinned Python packages into $VENV (a minute or two)"
    pip="$VENV/bin/python -m pip -qq --disable-pip-version-check"
    $pip install -c constraints.txt $COMPILER_PACKAGES
    compile_beside
    say "installing the other packages meanwhile"
    $pip install -c constraints.txt setuptools
    $pip install -c constraints.txt --no-build-isolation -e '.[clients,batch,dev]'
    # apart and without its dependencies: it pins a PyOpenGL that is too old
    $pip install --no-deps pyrender==0.1.45
    say "the packages are installed"
    trap - EXIT
    wait "$compiling" || say "compiling failed: the service will do it when it starts"
    echo "$wanted" >$STAMP
}

compile_beside() { # numba's loops, a minute of two cores, while packages come
    $VENV/bin/python -m filter_service.filtering.compile_loops &
    compiling=$!
    trap 'kill "$compiling" 2>/dev/null || true' EXIT
}

install_training_packages() { # on top of the others; the service never needs them
    if [ "$(cat $TRAINING_STAMP 2>/dev/null || true)" = "$(cat $STAMP)" ]; then return; fi
    say "installing torch and what exports networks (a few minutes)"
    $VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt --no-build-isolation -e '.[training]'
    cp $STAMP $TRAINING_STAMP
}

install_ray() { # in an environment of its own that sees the first
    if [ -x $RAY_VENV/bin/python ] &&
        $RAY_VENV/bin/python -c 'import ray, clients' 2>/dev/null; then return; fi
    say "installing Ray into $RAY_VENV (half a minute)"
    beside_venv $RAY_VENV
    $RAY_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt ray
}

install_page() { # what `ocufilter web` needs; make test does not
    if [ "$(cat $PAGE_STAMP 2>/dev/null || true)" = "$(cat $STAMP)" ]; then return; fi
    say "installing the packages of the page"
    $VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt --no-build-isolation -e '.[web]'
    cp $STAMP $PAGE_STAMP
}

beside_venv() { # an environment of its own that sees the packages of the first
    $VENV/bin/python -m venv --clear "$1"
    where='import sysconfig; print(sysconfig.get_path("purelib"))'
    echo "import site; site.addsitedir('$($VENV/bin/python -c "$where")')" \
        >"$("$1/bin/python" -c "$where")/ocufilter.pth"
}

install_docs() { # MkDocs
    if cmp -s constraints.txt $DOCS_VENV/constraints.txt; then return; fi
    say "installing MkDocs into $DOCS_VENV"
    beside_venv $DOCS_VENV
    $DOCS_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt $DOCS_PACKAGES
    cp constraints.txt $DOCS_VENV/constraints.txt
}

install_browser() { # and what drives it
    missing=$(missing_packages $BROWSER_PACKAGES)
    if [ -n "$missing" ] && ! apt_install $missing; then
        say "the browser's tests need one:  $(install_command "$missing")"
    fi
    $VENV/bin/python -c 'import playwright' 2>/dev/null ||
        $VENV/bin/python -m pip -qq --disable-pip-version-check \
            install -c constraints.txt playwright
}

has_new_llvm() { # Dr.Jit compiles with LLVM 16 or newer
    PATH="$PATH:/sbin:/usr/sbin" ldconfig -p | grep -Eq 'libLLVM(-|\.so\.)(1[6-9]|[2-9][0-9])'
}

install_witness() { # Mitsuba: a path tracer that the frames are compared with
    if ! has_new_llvm; then
        for package in $WITNESS_LLVM_PACKAGES; do
            if apt_install "$package"; then break; fi
        done
        has_new_llvm || say "the path tracer needs LLVM 16 or newer:" \
            "$(install_command "${WITNESS_LLVM_PACKAGES%% *}")"
    fi
    if [ -x $WITNESS_VENV/bin/python ] &&
        $WITNESS_VENV/bin/python -c 'import mitsuba' 2>/dev/null; then return; fi
    say "installing $WITNESS_PACKAGES into $WITNESS_VENV"
    $VENV/bin/python -m venv --clear $WITNESS_VENV
    $WITNESS_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install $WITNESS_PACKAGES
}

install_examples() { # the package as users install it, apart from the checkout
    wanted=$(pwd; cksum setup.sh setup.py pyproject.toml constraints.txt
        find estimator filter_service clients shaders -type f ! -name '*.so' \
            ! -path '*/__pycache__/*' ! -path '*/node_modules/*' -exec cksum {} +)
    wanted=$(echo "$wanted" | sort | cksum)
    if [ "$(cat $EXAMPLES_STAMP 2>/dev/null || true)" = "$wanted" ]; then return; fi
    say "installing the package and Jupyter into $EXAMPLES_VENV (a minute)"
    $(find_python) -m venv --clear $EXAMPLES_VENV
    pip="$EXAMPLES_VENV/bin/python -m pip -qq --disable-pip-version-check"
    $pip install -c constraints.txt setuptools pytest
    $pip install -c constraints.txt --no-build-isolation '.[clients,examples]'
    echo "$wanted" >$EXAMPLES_STAMP
}

install_system_libraries
install_c_compiler
if [ "${1:-}" = examples ]; then
    install_examples
    exit
fi
install_packages
if [ "${1:-}" = training ]; then install_training_packages; fi
if [ "${1:-}" = test ]; then
    install_test_packages
    install_javascript_client
fi
if [ "${1:-}" = batch-ray ]; then install_ray; fi
if [ "${1:-}" = page ]; then install_page; fi
if [ "${1:-}" = docs ]; then install_docs; fi
if [ "${1:-}" = web ]; then
    install_page
    install_browser
fi
if [ "${1:-}" = witness ]; then install_witness; fi
