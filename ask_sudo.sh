# Sourced by the setup scripts, which never run sudo unasked.

# Whether a command may run as root; sets $as_root to what runs it.  Root needs no
# permission.  Other users give it with --yes or OCUFILTER_SETUP_YES=1, or by answering
# the question that this function asks on a terminal.  After one refusal, it does not
# ask again.
may_run_as_root() { # the command, as the user would type it
    as_root=
    if [ "$(id -u)" = 0 ]; then return; fi
    if ! command -v sudo >/dev/null; then return 1; fi
    as_root=sudo
    if [ "${OCUFILTER_SETUP_YES:-}" = 1 ]; then
        if [ ! -t 0 ]; then as_root="sudo -n"; fi # nobody can type a password
        return
    fi
    if [ ! -t 0 ] || [ -n "${is_refused:-}" ]; then return 1; fi
    printf 'setup: run this command?  %s  [y/N] ' "$1" >&2
    answer=
    read -r answer || true
    case $answer in
    y | Y | yes) ;;
    *)
        is_refused=yes
        return 1
        ;;
    esac
}
