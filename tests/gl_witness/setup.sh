#!/bin/sh
# Gets what `make gl-witness` and `make check` ask for, beside the system: nothing is
# installed and no rights are needed; Debian's packages are unpacked into .gl_witness.
#
#   sh tests/gl_witness/setup.sh drivers    Mesa with its Vulkan driver lavapipe, and the
#                                           validation layers of Vulkan; 160 MB
#   sh tests/gl_witness/setup.sh glslang    the reference compiler of GLSL; 20 MB
#
# Zink, OpenGL over Vulkan, comes with libgl1-mesa-dri; llvmpipe does so too, and both
# are then of one version.  Running this again costs a fraction of a second.
#
# 0: made, or there already.  77: it cannot be made here.
set -eu
cd "$(dirname "$0")/../.."

what=${1:-drivers}
root=$(pwd)/.gl_witness
folder=$root/$what

case $what in
drivers)
    PACKAGES="libgl1-mesa-dri libegl-mesa0 mesa-vulkan-drivers libvulkan1
        vulkan-validationlayers libvulkan-dev spirv-tools"
    ;;
glslang) PACKAGES="glslang-tools spirv-tools" ;;
*)
    echo "gl-witness: '$what': there are drivers and glslang" >&2
    exit 2
    ;;
esac

say() { printf 'gl-witness: %s\n' "$*" >&2; }

cannot() {
    say "$*"
    exit 77
}

if [ "$what" = glslang ] && command -v glslangValidator >/dev/null &&
    command -v spirv-val >/dev/null; then
    exit 0
fi
if ! command -v apt-get >/dev/null || ! command -v dpkg-query >/dev/null; then
    cannot "$what: only where apt-get and dpkg are (Debian, Ubuntu)"
fi

# Another Mesa in the system asks for another one here: packages of one source fit only
# each other.
installed=$(dpkg-query -W libgl1-mesa-dri libegl1 libc6 2>/dev/null || true)
wanted="$(cksum <tests/gl_witness/setup.sh) $installed"
if [ "$(cat "$folder/.made" 2>/dev/null || true)" = "$wanted" ]; then exit 0; fi

mkdir -p "$root"
echo '*' >"$root/.gitignore"
rm -rf "$folder" "$folder.new"
mkdir -p "$folder.new/archives"
cd "$folder.new/archives"

apt() { # with lists of its own where those of the system do not do
    command=$1
    shift
    apt-get -q -o APT::Sandbox::User=root ${lists:-} "$command" "$@"
}

plan() { # name=version of what is missing, or older in the system
    apt install --simulate --no-install-recommends $PACKAGES 2>/dev/null |
        sed -n 's/^Inst \([^ ]*\) .*(\([^ ]*\) .*/\1=\2/p' | grep -v -e '-dev=' || true
}

download() {
    planned=$(plan)
    for package in $PACKAGES; do
        case " $(echo $planned)" in *" $package="*) ;; *) planned="$planned $package" ;; esac
    done
    apt download $planned >log 2>&1
}

say "$what: downloading Debian's packages (seconds)"
if ! download; then
    mkdir -p "$root/apt/lists/partial" "$root/apt/cache/archives/partial"
    lists="-o Dir::State::Lists=$root/apt/lists -o Dir::Cache=$root/apt/cache"
    apt update >log 2>&1 || true
    if ! download; then
        tail -n 5 log >&2
        cannot "$what: apt-get cannot download $(echo $PACKAGES)"
    fi
fi
for archive in *.deb; do dpkg -x "$archive" ..; done
cd "$folder.new"
rm -rf archives "$root/apt"

if [ "$what" = drivers ]; then # found by name: the package says where it would lie
    for icd in usr/share/vulkan/icd.d/lvp_icd*.json; do
        if [ ! -e "$icd" ]; then cannot "drivers: the packages have no lavapipe"; fi
        sed 's#"[^"]*/\(libvulkan_lvp\.so\)"#"\1"#' "$icd" >lavapipe.json
    done
fi
cd "$root"
mv "$folder.new" "$folder"
printf '%s\n' "$wanted" >"$folder/.made"
