#!/bin/sh
# Makes a root with OpenXR's runtime Monado, Xvfb and this project, to run tests in.
#
#   sh tests/headset/setup_root.sh [ROOT]     ROOT is .headset in the checkout, or what
#                                             HEADSET_ROOT says; 2.5 GB, a few minutes
#
# Debian has Monado from trixie on; the root is a trixie whatever the host is, from the
# mirror that the host's apt uses (or DEBIAN_MIRROR).  run_in_root.sh runs commands in
# it.  Running this again costs a fraction of a second: packages are installed anew only
# when this file, pyproject.toml, constraints.txt or the sources in C have changed.
#
# 0: made.  1: a step failed, its last lines stand above.  77: it cannot be made here.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(cd "$here/../.." && pwd)
root=${1:-${HEADSET_ROOT:-$checkout/.headset}}
case $root in /*) ;; *) root=$(pwd)/$root ;; esac

RELEASE=trixie
SYSTEM_PACKAGES="monado-service monado-cli libopenxr1-monado libopenxr-loader1
    mesa-vulkan-drivers libegl1 libgl1 libglx-mesa0 libgl1-mesa-dri libgles2
    libopengl0 xvfb xauth python3 python3-venv gcc libc6-dev libgomp1 iproute2"
PYTHON_PACKAGES="pytest pyopenxr>=1.1,<1.2 trimesh networkx"
MARK=$root/.ocufilter-root
SYSTEM_STAMP=$root/.ocufilter-system
PYTHON_STAMP=$root/.ocufilter-python

say() { printf 'headset: %s\n' "$*" >&2; }

cannot() {
    say "$*"
    exit 77
}

log=$(mktemp)
trap 'rm -f "$log"' EXIT

step() { # what it is, and the command
    say "$1"
    shift
    if ! "$@" >"$log" 2>&1; then
        tail -n 15 "$log" >&2
        say "that failed"
        exit 1
    fi
}

in_root() { HEADSET_ROOT=$root sh "$here/run_in_root.sh" --online "$@"; }

# --- whether it can be made ---------------------------------------------------

check_rights() {
    if [ "$(id -u)" != 0 ]; then
        if ! sudo -n true 2>/dev/null; then
            cannot "only root, or who may use sudo without a password, can make a root"
        fi
        sudo -n --preserve-env sh "$here/setup_root.sh" "$root" || exit $?
        exit 0
    fi
    if ! unshare --mount --net sh -c 'mount -t tmpfs tmpfs /mnt && chroot / true' \
        2>/dev/null; then
        cannot "mounts and networks of one's own, and chroot, are not permitted here"
    fi
}

install_debootstrap() {
    if command -v debootstrap >/dev/null; then return; fi
    say "installing debootstrap with apt-get"
    if ! { apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y \
        --no-install-recommends debootstrap debian-archive-keyring; } >"$log" 2>&1; then
        cannot "debootstrap is missing, and apt-get cannot install it"
    fi
}

find_mirror() { # what apt takes Debian from
    mirror=${DEBIAN_MIRROR:-}
    if [ -n "$mirror" ]; then return; fi
    mirror=$(apt-get indextargets --format '$(REPO_URI) $(LABEL)' \
        'Created-By: Packages' 2>/dev/null | sed -n '/ Debian$/ { s/ .*//p; q; }')
    case $mirror in
    mirror+file:*) mirror=$(sed -n '/^http/ { s/[[:space:]].*//p; q; }' "${mirror#*:}") ;;
    esac
    if [ -z "$mirror" ]; then
        cannot "apt on this machine knows no mirror of Debian; name one in DEBIAN_MIRROR"
    fi
}

# --- the system -----------------------------------------------------------------

make_base() {
    if [ -e "$MARK" ]; then
        rm -rf "$root" # ours, and not finished
    elif [ -n "$(ls -A "$root" 2>/dev/null)" ]; then
        say "$root holds something else; nothing is changed"
        exit 1
    fi
    mkdir -p "$root"
    touch "$MARK"
    echo '*' >"$root/.gitignore"
    step "installing Debian $RELEASE into $root (half a minute)" \
        unshare --mount debootstrap --variant=minbase --include=ca-certificates \
        $RELEASE "$root" "$mirror"
}

copy_from_host() { # files and folders, to where they lie on the host
    for path in "$@"; do
        if [ ! -e "$path" ]; then continue; fi
        mkdir -p "$root$(dirname "$path")"
        cp -RL "$path" "$root$(dirname "$path")/"
    done
}

copy_host_settings() { # how the host reaches mirrors and package indices
    apt-config dump | grep -E '^Acquire::(http|https|Check|Retries)' \
        >"$root/etc/apt/apt.conf.d/90host" || true
    copy_from_host /etc/apt/auth.conf /etc/apt/auth.conf.d /etc/resolv.conf /etc/hosts \
        /etc/pip.conf /etc/xdg/pip /etc/ssl/certs/ca-certificates.crt \
        ${PIP_CONFIG_FILE:-} ${PIP_CERT:-} ${SSL_CERT_FILE:-} ${REQUESTS_CA_BUNDLE:-}
    for folder in .config/pip .pip; do
        if [ ! -d "$HOME/$folder" ]; then continue; fi
        mkdir -p "$root/root/$folder"
        cp -RL "$HOME/$folder/." "$root/root/$folder/"
    done
}

install_system() {
    wanted=$(echo $RELEASE $SYSTEM_PACKAGES)
    if [ "$(cat "$SYSTEM_STAMP" 2>/dev/null || true)" = "$wanted" ]; then return; fi
    install_debootstrap
    find_mirror
    make_base
    copy_host_settings
    step "installing Monado, Mesa and Xvfb (half a minute)" \
        in_root sh -c 'apt-get update && DEBIAN_FRONTEND=noninteractive \
            apt-get install -y --no-install-recommends "$@" && apt-get clean' \
        sh $SYSTEM_PACKAGES
    echo "$wanted" >"$SYSTEM_STAMP"
}

# --- this project ---------------------------------------------------------------

install_packages() { # those of the service, and those of the tests
    in_root /usr/bin/python3 -c 'import tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
print(*project["dependencies"], sep="\n")' >"$root/tmp/requirements.txt" &&
        in_root pip install -q --no-cache-dir --disable-pip-version-check \
            -c constraints.txt -r /tmp/requirements.txt $PYTHON_PACKAGES
}

follow_checkout() { # what is edited there is seen here at once
    for packages in "$root"/opt/venv/lib/python3*/site-packages; do
        echo /checkout >"$packages/checkout.pth"
    done
}

build_loops() { # of the native engine: those of the host are for its own Python
    in_root python -c 'from pathlib import Path
from tests.native_build import build_library
build_library(Path("/opt/ocufilter"))'
}

install_project() {
    wanted=$(cd "$checkout"; cat tests/headset/setup_root.sh pyproject.toml \
        constraints.txt filter_service/native/source/* | cksum)
    if [ "$(cat "$PYTHON_STAMP" 2>/dev/null || true)" = "$wanted" ]; then return; fi
    rm -f "$PYTHON_STAMP"
    copy_host_settings
    mkdir -p "$root/opt/ocufilter" "$root/var/cache/ocufilter"
    step "making an environment of Python" \
        in_root /usr/bin/python3 -m venv --clear /opt/venv
    step "installing the pinned Python packages (half a minute)" install_packages
    follow_checkout
    step "compiling the loops in C" build_loops
    step "compiling numba's loops (a minute of two cores)" \
        sh "$here/run_in_root.sh" python -m filter_service.filtering.compile_loops
    echo "$wanted" >"$PYTHON_STAMP"
    say "the root is ready"
}

export HEADSET_ROOT="$root"
check_rights
install_system
install_project
