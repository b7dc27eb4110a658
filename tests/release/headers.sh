#!/bin/sh
# Download the headers of OpenXR, OpenGL, EGL, Vulkan and X11 that the OpenXR layer is compiled
# with.  They are the same for every processor.  Nothing is installed.
#
#   sh tests/release/headers.sh FOLDER     writes FOLDER/usr/include
#
# The layer needs OpenXR 1.1, which Debian has since trixie.  The packages come from the
# mirror that the machine's apt uses, or from DEBIAN_MIRROR.
set -eu
RELEASE=trixie
PACKAGES="libopenxr-dev libgl-dev libglx-dev libegl-dev libvulkan-dev libx11-dev
    x11proto-dev"

folder=$1
if [ -e "$folder/.complete" ]; then exit 0; fi
rm -rf "$folder"
mkdir -p "$folder/apt/lists/partial" "$folder/apt/cache/archives/partial"
cd "$folder"

mirror=${DEBIAN_MIRROR:-}
if [ -z "$mirror" ]; then
    mirror=$(apt-get indextargets --format '$(REPO_URI) $(LABEL)' \
        'Created-By: Packages' | sed -n '/ Debian$/ { s/ .*//p; q; }')
fi
if [ -z "$mirror" ]; then
    echo "release: apt on this machine has no Debian mirror; set DEBIAN_MIRROR" >&2
    exit 1
fi
keys=/usr/share/keyrings/debian-archive-keyring.gpg
echo "deb [signed-by=$keys] $mirror $RELEASE main" >apt/sources.list

apt() {
    apt-get -q -o APT::Sandbox::User=root -o APT::Architecture=amd64 \
        -o Dir::State::Lists="$PWD/apt/lists" -o Dir::Cache="$PWD/apt/cache" \
        -o Dir::Etc::SourceList="$PWD/apt/sources.list" -o Dir::Etc::SourceParts=- "$@"
}

if ! { apt update && apt download $PACKAGES; } >log 2>&1; then
    tail -n 5 log >&2
    exit 1
fi
ls -- *.deb >versions
for package in *.deb; do dpkg -x "$package" .; done
rm -rf apt log -- *.deb
touch .complete
