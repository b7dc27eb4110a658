#!/bin/sh
# Makes a folder for a GPU machine without a network, and an archive of it.
#
#   sh tests/gpu_kit/make.sh [FOLDER]     FOLDER is out/gpu_kit
#
# It has wheels, the loaders of OpenGL, the tree of the last commit, and run.sh.
# From the environment:
#   PYTHON_VERSION  the Python of that machine; 3.12
#   WITH            more packages to carry, with what they need, of those that it is
#                   expected to have
#   PYTHON          whose pip fetches the wheels; .venv/bin/python
set -eu
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(cd "$here/../.." && pwd)
cd "$checkout"
kit=${1:-out/gpu_kit}
version=${PYTHON_VERSION:-3.12}
python=${PYTHON:-.venv/bin/python}

# what a machine for numerical work lacks, or has too old
CARRIED="moderngl glcontext pyzmq msgpack msgspec lz4 lazy-loader packaging OpenEXR
    typer rich shellingham annotated-doc markdown-it-py mdurl Pygments pydantic
    pydantic-core annotated-types typing-extensions typing-inspection
    pyrender PyOpenGL trimesh freetype-py pyglet imageio six networkx glfw
    pytest pluggy iniconfig hypothesis sortedcontainers"
# what it is expected to have: large, and bound to its other packages
EXPECTED="numpy scipy numba matplotlib pillow onnxruntime"
# torch too, for training; without it that step is left out
PLATFORMS="manylinux_2_28_x86_64 manylinux_2_27_x86_64 manylinux_2_17_x86_64
    manylinux2014_x86_64 manylinux1_x86_64"
# libglvnd, and what its GLX links to
LOADERS="libegl1 libglvnd0 libopengl0 libgl1 libglx0
    libx11-6 libxcb1 libxau6 libxdmcp6 libbsd0 libmd0"

say() { printf 'gpu-kit: %s\n' "$*" >&2; }

fail() {
    say "$*"
    exit 1
}

fetch_wheels() {
    set --
    for platform in $PLATFORMS; do set -- "$@" --platform "$platform"; done
    set -- "$@" --only-binary=:all: --implementation cp --python-version "$version" \
        -c constraints.txt -d "$kit/wheels"
    "$python" -m pip --disable-pip-version-check download -qq --no-deps "$@" $CARRIED &&
        { [ -z "${WITH:-}" ] ||
            "$python" -m pip --disable-pip-version-check download -qq "$@" $WITH; } ||
        fail "a wheel for Python $version is missing; its name stands above"
}

fetch_loaders() { # shared libraries under their sonames, side by side
    if ! command -v apt-get >/dev/null || [ "$(dpkg --print-architecture)" != amd64 ]; then
        say "without apt-get of an amd64 Debian no loaders go along:" \
            "that machine must have libEGL.so.1, libGL.so.1 and libOpenGL.so.0"
        return
    fi
    packages=$(mktemp -d)
    if ! (cd "$packages" && apt-get download $LOADERS) >"$packages/log" 2>&1; then
        tail -n 3 "$packages/log" >&2
        fail "apt-get cannot download the loaders; does 'apt-get update' help?"
    fi
    mkdir -p "$kit/loaders"
    for package in "$packages"/*.deb; do dpkg -x "$package" "$packages/root"; done
    find "$packages/root/usr/lib" "$packages/root/lib" -name '*.so.[0-9]' 2>/dev/null |
        while read -r library; do cp -L "$library" "$kit/loaders/"; done
    rm -rf "$packages"
}

pack_tree() {
    git rev-parse --short HEAD >"$kit/COMMIT"
    if [ -n "$(git status --porcelain)" ]; then
        say "what is not committed stays behind: the tree is that of $(cat "$kit/COMMIT")"
    fi
    git archive --format=tar.gz -o "$kit/tree.tar.gz" HEAD
}

rm -rf "$kit"
mkdir -p "$kit/wheels"
kit=$(cd "$kit" && pwd)
say "fetching wheels for Python $version"
fetch_wheels
say "fetching the loaders of OpenGL"
fetch_loaders
pack_tree
echo "$version" >"$kit/PYTHON_VERSION"
cp "$here/run.sh" "$here/README.md" "$kit/"
tar -czf "$kit.tar.gz" -C "$(dirname "$kit")" "$(basename "$kit")"
say "$(du -sh "$kit" | cut -f1) in $kit, $(du -h "$kit.tar.gz" | cut -f1) in its archive"
say "there:  sh $(basename "$kit")/run.sh [--quick]"
