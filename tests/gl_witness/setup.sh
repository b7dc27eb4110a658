#!/bin/sh
# Download the tools for `make gl-witness` and `make check`.  The script unpacks Debian
# packages into .gl_witness; it installs nothing and needs no special permissions.
#
#   sh tests/gl_witness/setup.sh drivers    Mesa with its Vulkan driver lavapipe, and
#                                           Vulkan's validation layers; 160 MB
#   sh tests/gl_witness/setup.sh glslang    the GLSL reference compiler; 20 MB
#
# libgl1-mesa-dri contains both zink (OpenGL over Vulkan) and llvmpipe, so their
# versions match.  Running the script again takes a fraction of a second.
#
# Exit status: 0 if the tools are available, 77 if they cannot be set up on this
# machine.
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
    echo "gl-witness: unknown argument '$what'; expected drivers or glslang" >&2
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
    cannot "$what: requires apt-get and dpkg (Debian, Ubuntu)"
fi

# Download again if the system's Mesa has changed, because packages from the same source
# must have the same version.
installed=$(dpkg-query -W libgl1-mesa-dri libegl1 libc6 2>/dev/null || true)
wanted="$(cksum <tests/gl_witness/setup.sh) $installed"
if [ "$(cat "$folder/.made" 2>/dev/null || true)" = "$wanted" ]; then exit 0; fi

mkdir -p "$root"
echo '*' >"$root/.gitignore"
rm -rf "$folder" "$folder.new"
mkdir -p "$folder.new/archives"
cd "$folder.new/archives"

apt() { # run apt-get, with separate package lists if $lists is set
    command=$1
    shift
    apt-get -q -o APT::Sandbox::User=root ${lists:-} "$command" "$@"
}

plan() { # print name=version of packages that are missing or outdated
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

say "$what: downloading Debian packages (seconds)"
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

if [ "$what" = drivers ]; then # replace the absolute path of the driver by its name
    for icd in usr/share/vulkan/icd.d/lvp_icd*.json; do
        if [ ! -e "$icd" ]; then cannot "drivers: lavapipe is not in the packages"; fi
        sed 's#"[^"]*/\(libvulkan_lvp\.so\)"#"\1"#' "$icd" >lavapipe.json
    done
fi
cd "$root"
mv "$folder.new" "$folder"
printf '%s\n' "$wanted" >"$folder/.made"
