#!/bin/sh
# Run a command in the chroot that setup_root.sh created, with this checkout at
# /checkout.
#
#   sh tests/headset/run_in_root.sh python -m pytest tests/headset
#   sh tests/headset/run_in_root.sh --online apt-get update
#
# The command starts in /checkout, a read-only mount of the checkout.  /tmp and the
# caches of the chroot persist.  The command can only reach its own loopback interface,
# so that ports that the runtime opens are not exposed.  It has the environment defined
# below; to set more variables, use  env NAME=value COMMAND.  With --online, which is
# for installing packages, it has the network and the environment of the host.
#
# HEADSET_ROOT selects the chroot (default: .headset in the checkout).  Mounts are
# private to the command.  Signals are passed on, and the exit status is the command's.
# It is 77 if the command may not run on this machine or if the chroot does not exist.
#
# The command runs as root.  As in setup_root.sh, sudo never runs unasked.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(cd "$here/../.." && pwd)
PATH=$PATH:/usr/sbin:/sbin # chroot; Debian's accounts lack it
export PATH

if [ "${1:-}" != --mounting ]; then
    root=${HEADSET_ROOT:-$checkout/.headset}
    network=--net
    if [ "${1:-}" = --online ]; then
        network=
        shift
    fi
    if [ ! -x "$root/bin/sh" ]; then
        echo "headset: no chroot in $root; to create it:  sh $here/setup_root.sh" >&2
        exit 77
    fi
    . "$checkout/ask_sudo.sh"
    if ! may_run_as_root "sudo sh $here/run_in_root.sh $*"; then
        echo "headset: running commands in $root requires root; run:" \
            "sudo HEADSET_ROOT=$root sh $here/run_in_root.sh $*" >&2
        exit 77
    fi
    exec $as_root unshare --mount $network \
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
    OCUFILTER_LIBRARY_DIR=/opt/ocufilter \
    OCUFILTER_DURATIONS=/var/cache/ocufilter/durations.json \
    PYTEST_ADDOPTS="-o cache_dir=/var/cache/ocufilter/pytest" \
    sh -c 'cd /checkout && exec "$@"' sh "$@"
