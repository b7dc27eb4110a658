#!/bin/sh
# Runs a command in the root that setup_root.sh made, this checkout at /checkout.
#
#   sh tests/headset/run_in_root.sh python -m pytest tests/headset
#   sh tests/headset/run_in_root.sh --online apt-get update
#
# The command starts in /checkout, which follows the checkout and is read-only; /tmp and
# the caches of the root are kept.  It reaches no network but its own loopback, so that
# what the runtime opens to everyone stays inside, and has the environment that stands
# below: more is given by  env NAME=value COMMAND.  With --online, to install something,
# it has the network and the environment of the host.
#
# HEADSET_ROOT names another root than .headset in the checkout.  Mounts are the
# command's own and vanish with it; signals reach it, and its exit code comes back.
# 77 says that it may not run here, or that there is no root.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(cd "$here/../.." && pwd)

if [ "${1:-}" != --mounting ]; then
    root=${HEADSET_ROOT:-$checkout/.headset}
    network=--net
    if [ "${1:-}" = --online ]; then
        network=
        shift
    fi
    if [ ! -x "$root/bin/sh" ]; then
        echo "headset: no root in $root; to make it:  sh $here/setup_root.sh" >&2
        exit 77
    fi
    prefix=
    if [ "$(id -u)" != 0 ]; then
        prefix="sudo -n"
        if ! $prefix true 2>/dev/null; then
            echo "headset: only root may run commands in $root" >&2
            exit 77
        fi
    fi
    exec $prefix unshare --mount $network \
        sh "$here/run_in_root.sh" --mounting "${network:-online}" "$root" "$@"
fi

network=$2 root=$3
shift 3

mount -t proc proc "$root/proc"
mount -t sysfs -o ro sysfs "$root/sys"
mount --rbind /dev "$root/dev"
mount -t tmpfs -o mode=1777 tmpfs "$root/dev/shm"
mount -t tmpfs -o mode=0755 tmpfs "$root/run"
mkdir -p "$root/checkout"
mount --bind "$checkout" "$root/checkout"
mount -o remount,bind,ro "$root/checkout"

path=/opt/venv/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
if [ "$network" = online ]; then
    exec chroot "$root" env PATH=$path HOME=/root LC_ALL=C.UTF-8 \
        sh -c 'cd /checkout && exec "$@"' sh "$@"
fi
chroot "$root" /usr/sbin/ip link set lo up
exec chroot "$root" env -i PATH=$path HOME=/root LC_ALL=C.UTF-8 TERM="${TERM:-dumb}" \
    PYTHONPYCACHEPREFIX=/var/cache/ocufilter/python \
    NUMBA_CACHE_DIR=/var/cache/ocufilter/numba \
    OCUFILTER_NATIVE_LIBRARY=/opt/ocufilter/loops.so \
    PYTEST_ADDOPTS="-o cache_dir=/var/cache/ocufilter/pytest" \
    sh -c 'cd /checkout && exec "$@"' sh "$@"
