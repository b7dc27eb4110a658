#!/bin/sh
# Create a chroot with the OpenXR runtime Monado, X servers and this project, for tests.
#
#   sh tests/headset/setup_root.sh [ROOT]     default: $HEADSET_ROOT, or .headset in the
#                                             checkout; 2.5 GB, a few minutes
#   sh tests/headset/setup_root.sh --applications [ROOT]
#                                             with the OpenXR applications Qt Quick 3D,
#                                             Psychtoolbox and Blender; default:
#                                             $HEADSET_APPLICATIONS_ROOT, or
#                                             .headset-applications; 4 GB
#
# Creating a chroot requires root.  For other users, the script asks on a terminal before it
# runs sudo.  Otherwise it prints the command.  With --yes as the first argument, or
# OCUFILTER_SETUP_YES=1 in the environment, it does not ask.
#
# Monado is available in Debian since trixie, so the chroot is trixie on any host.  Its
# packages come from the mirror that the host's apt uses, or from DEBIAN_MIRROR.  Use
# run_in_root.sh to run commands in it.  Running this script again takes a fraction of a
# second: it reinstalls packages only if this file, pyproject.toml, constraints.txt or
# the C sources have changed.
#
# Exit status: 0 on success, 1 if a step failed (its last lines are printed), and 77 if
# the chroot cannot be created on this machine; the reason is also written to the file
# OCUFILTER_SKIP_REASON.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(cd "$here/../.." && pwd)
. "$checkout/ask_sudo.sh"
PATH=$PATH:/usr/sbin:/sbin # chroot and debootstrap; Debian's accounts lack them
export PATH
kind=
if [ "${1:-}" = --yes ]; then
    OCUFILTER_SETUP_YES=1
    shift
fi
if [ "${1:-}" = --applications ]; then
    kind=$1
    shift
    root=${1:-${HEADSET_APPLICATIONS_ROOT:-$checkout/.headset-applications}}
else
    root=${1:-${HEADSET_ROOT:-$checkout/.headset}}
fi
case $root in /*) ;; *) root=$(pwd)/$root ;; esac

RELEASE=trixie
SYSTEM_PACKAGES="monado-service monado-cli libopenxr1-monado libopenxr-loader1
    mesa-vulkan-drivers libegl1 libgl1 libglx-mesa0 libgl1-mesa-dri libgles2
    libopengl0 xvfb xauth python3 python3-venv gcc libc6-dev iproute2
    libopenxr-dev libopenxr-utils libgl-dev libegl-dev libx11-dev
    libvulkan-dev vulkan-validationlayers
    openxr-layer-apidump openxr-layer-corevalidation
    xserver-xorg-core xserver-xorg-video-dummy"
# setuptools and prometheus_client for the steps of Containerfile
PYTHON_PACKAGES="pytest pyopenxr>=1.1,<1.2 trimesh networkx setuptools prometheus_client"
APPLICATION_PACKAGES="octave-psychtoolbox-3 blender libdbus-1-3 libfontconfig1
    libglib2.0-0t64 libxcb-cursor0 libxcb-icccm4 libxcb-image0 libxcb-keysyms1
    libxcb-randr0 libxcb-render-util0 libxcb-render0 libxcb-shape0 libxcb-util1
    libxcb-xkb1 libxkbcommon-x11-0"
QT_PACKAGES="PySide6_Addons==6.12.0" # Debian's 6.8 cannot create a session in Monado
if [ -n "$kind" ]; then SYSTEM_PACKAGES="$SYSTEM_PACKAGES $APPLICATION_PACKAGES"; fi
MARK=$root/.ocufilter-root
SYSTEM_STAMP=$root/.ocufilter-system
PYTHON_STAMP=$root/.ocufilter-python
QT_STAMP=$root/.ocufilter-qt

say() { printf 'headset: %s\n' "$*" >&2; }

cannot() { # .ci/run reports the reason of a skipped suite
    say "$*"
    echo "$*" >"${OCUFILTER_SKIP_REASON:-/dev/null}"
    exit 77
}

log=$(mktemp)
trap 'rm -f "$log"' EXIT

step() { # run a command and describe it; exit with its last lines if it fails
    say "$1"
    shift
    if ! "$@" >"$log" 2>&1; then
        tail -n 15 "$log" >&2
        say "this step failed"
        exit 1
    fi
}

in_root() { HEADSET_ROOT=$root sh "$here/run_in_root.sh" --online "$@"; }

# --- requirements -------------------------------------------------------------

check_rights() {
    command="sudo --preserve-env sh $here/setup_root.sh${kind:+ $kind} $root"
    if ! may_run_as_root "$command"; then
        cannot "creating a chroot requires root; run:  $command"
    fi
    if [ -n "$as_root" ]; then
        $as_root --preserve-env sh "$here/setup_root.sh" $kind "$root" || exit $?
        exit 0
    fi
    for program in unshare mount chroot; do
        command -v $program >/dev/null || cannot "$program is not in PATH ($PATH)"
    done
    if ! refusal=$(unshare --mount --net sh -c \
        'mount -t tmpfs tmpfs /mnt && chroot / true' 2>&1); then
        cannot "the kernel permits no private mounts, network or chroot: $refusal"
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

find_mirror() { # set mirror to the Debian mirror of the host's apt
    mirror=${DEBIAN_MIRROR:-}
    if [ -n "$mirror" ]; then return; fi
    mirror=$(apt-get indextargets --format '$(REPO_URI) $(LABEL)' \
        'Created-By: Packages' 2>/dev/null | sed -n '/ Debian$/ { s/ .*//p; q; }')
    case $mirror in
    mirror+file:*) mirror=$(sed -n '/^http/ { s/[[:space:]].*//p; q; }' "${mirror#*:}") ;;
    esac
    if [ -z "$mirror" ]; then
        cannot "apt on this machine has no Debian mirror; set DEBIAN_MIRROR"
    fi
}

# --- the system -----------------------------------------------------------------

make_base() {
    if [ -e "$MARK" ]; then
        rm -rf "$root" # created by this script, but incomplete
    elif [ -n "$(ls -A "$root" 2>/dev/null)" ]; then
        say "$root contains other files; nothing was changed"
        exit 1
    fi
    mkdir -p "$root"
    touch "$MARK"
    echo '*' >"$root/.gitignore"
    step "installing Debian $RELEASE into $root (half a minute)" \
        unshare --mount debootstrap --variant=minbase --include=ca-certificates \
        $RELEASE "$root" "$mirror"
}

copy_from_host() { # copy files and folders to the same path in the chroot
    for path in "$@"; do
        if [ ! -e "$path" ]; then continue; fi
        mkdir -p "$root$(dirname "$path")"
        cp -RL "$path" "$root$(dirname "$path")/"
    done
}

copy_host_settings() { # copy the settings for mirrors and package indices
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
    step "installing Monado, Mesa and X servers (half a minute)" \
        in_root sh -c 'apt-get update && DEBIAN_FRONTEND=noninteractive \
            apt-get install -y --no-install-recommends "$@" && apt-get clean' \
        sh $SYSTEM_PACKAGES
    echo "$wanted" >"$SYSTEM_STAMP"
}

# --- this project ---------------------------------------------------------------

install_packages() { # for the service and for the tests
    in_root /usr/bin/python3 -c 'import tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
print(*project["dependencies"], sep="\n")' >"$root/tmp/requirements.txt" &&
        in_root pip install -q --no-cache-dir --disable-pip-version-check \
            -c constraints.txt -r /tmp/requirements.txt $PYTHON_PACKAGES
}

follow_checkout() { # import the project from the mounted checkout
    for packages in "$root"/opt/venv/lib/python3*/site-packages; do
        echo /checkout >"$packages/checkout.pth"
    done
}

build_loops() { # for the native engine; the host's build is for its own Python
    in_root python -c 'from pathlib import Path
from tests.native_build import build_libraries
build_libraries(Path("/opt/ocufilter"))'
}

install_project() {
    wanted=$(cd "$checkout"; cat tests/headset/setup_root.sh pyproject.toml \
        constraints.txt estimator/native/source/* filter_service/native/source/* | cksum)
    if [ "$(cat "$PYTHON_STAMP" 2>/dev/null || true)" = "$wanted" ]; then return; fi
    rm -f "$PYTHON_STAMP"
    copy_host_settings
    mkdir -p "$root/opt/ocufilter" "$root/var/cache/ocufilter"
    step "creating a Python environment" \
        in_root /usr/bin/python3 -m venv --clear /opt/venv
    step "installing the pinned Python packages (half a minute)" install_packages
    follow_checkout
    step "compiling the C code" build_loops
    echo "$wanted" >"$PYTHON_STAMP"
    say "the chroot is ready"
}

# --- Qt ---------------------------------------------------------------------------

install_qt() { # in an environment of its own, at /opt/pyside
    if [ "$(cat "$QT_STAMP" 2>/dev/null || true)" = "$QT_PACKAGES" ]; then return; fi
    rm -f "$QT_STAMP"
    copy_host_settings
    step "creating a Python environment for Qt" \
        in_root /usr/bin/python3 -m venv --clear /opt/pyside
    step "installing Qt (half a minute)" in_root /opt/pyside/bin/pip install -q \
        --no-cache-dir --disable-pip-version-check $QT_PACKAGES
    echo "$QT_PACKAGES" >"$QT_STAMP"
}

export HEADSET_ROOT="$root"
check_rights
install_system
install_project
if [ -n "$kind" ]; then install_qt; fi
