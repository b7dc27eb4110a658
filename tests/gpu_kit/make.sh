#!/bin/sh
# Build a kit for a GPU machine without a network: a folder and an archive of it.
#
#   sh tests/gpu_kit/make.sh [FOLDER]     default FOLDER: out/gpu_kit
#
# The kit contains wheels, the OpenGL loaders, the source tree of the last commit, and
# run.sh.  Environment variables:
#   PYTHON_VERSION  Python version of the GPU machine (default: 3.12)
#   WITH            packages to include, with their dependencies, that the GPU machine
#                   is otherwise expected to have
#   PYTHON          Python whose pip downloads the wheels (default: .venv/bin/python)
set -eu
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(cd "$here/../.." && pwd)
cd "$checkout"
kit=${1:-out/gpu_kit}
version=${PYTHON_VERSION:-3.12}
python=${PYTHON:-.venv/bin/python}

# packages that a machine for numerical work often lacks or has in an old version
CARRIED="moderngl glcontext pyzmq msgpack msgspec lz4 lazy-loader packaging OpenEXR
    typer rich shellingham annotated-doc markdown-it-py mdurl Pygments pydantic
    pydantic-core annotated-types typing-extensions typing-inspection
    trimesh networkx glfw
    pytest pluggy iniconfig hypothesis sortedcontainers"
# packages that the GPU machine is expected to have: large, with many dependencies
EXPECTED="numpy scipy matplotlib pillow onnxruntime"
# and optionally torch; without it, the training step is skipped
PLATFORMS="manylinux_2_28_x86_64 manylinux_2_27_x86_64 manylinux_2_17_x86_64
    manylinux2014_x86_64 manylinux1_x86_64"
# libglvnd, and the libraries that its GLX links to
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
        fail "a wheel for Python $version is missing; see its name above"
}

fetch_loaders() { # copy shared libraries into one folder, named by their sonames
    if ! command -v apt-get >/dev/null || [ "$(dpkg --print-architecture)" != amd64 ]; then
        say "cannot include the OpenGL loaders without apt-get on amd64 Debian;" \
            "the GPU machine must have libEGL.so.1, libGL.so.1 and libOpenGL.so.0"
        return
    fi
    packages=$(mktemp -d)
    if ! (cd "$packages" && apt-get download $LOADERS) >"$packages/log" 2>&1; then
        tail -n 3 "$packages/log" >&2
        fail "apt-get cannot download the loaders; try 'apt-get update' first"
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
        say "uncommitted changes are not included; commit: $(cat "$kit/COMMIT")"
    fi
    git archive --format=tar.gz -o "$kit/tree.tar.gz" HEAD
}

rm -rf "$kit"
mkdir -p "$kit/wheels"
kit=$(cd "$kit" && pwd)
say "downloading wheels for Python $version"
fetch_wheels
say "downloading the OpenGL loaders"
fetch_loaders
pack_tree
echo "$version" >"$kit/PYTHON_VERSION"
cp "$here/run.sh" "$here/README.md" "$kit/"
tar -czf "$kit.tar.gz" -C "$(dirname "$kit")" "$(basename "$kit")"
say "$kit: $(du -sh "$kit" | cut -f1); archive: $(du -h "$kit.tar.gz" | cut -f1)"
say "on the GPU machine, run:  sh $(basename "$kit")/run.sh [--quick]"
