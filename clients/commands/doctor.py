"""`ocufilter doctor`: check what works on this machine and what to install."""

from typing import Any

from clients.commands.console import CommandFailed, Json, print_json, say


def doctor(json_output: Json = False) -> None:
    """Check this machine for what the program needs and list what is missing.

    The exit code is 0 if the service can run here and 1 if it cannot.

    ocufilter doctor --json
    """
    from clients.commands.doctor_checks import examine

    report = examine()
    if json_output:
        print_json(report)
    else:
        _print_report(report)
    if not report["ok"]:
        fails = ", ".join(name for name, ok in report["works"].items() if not ok)
        raise CommandFailed(f"the service cannot run here; what fails: {fails}")


def _print_report(report: dict[str, Any]) -> None:
    machine = report["machine"]
    say(f"{machine['system']}, {machine['processor']}, {machine['n_cores']} cores")
    for check in report["checks"]:
        say(f"  {'ok ' if check['ok'] else 'NO '} {check['name']}: {check['detail']}")
    for name, value in report["gl"]["limits"].items():
        say(f"      {name}: {value}")
    for device in report["gl"]["devices"]:
        said = device["renderer"] or f"no context: {device['error']}"
        say(f"      EGL device {device['index']} ({device['name']}): {said}")
    works = [name for name, ok in report["works"].items() if ok]
    fails = [name for name, ok in report["works"].items() if not ok]
    say("works here: " + (", ".join(works) or "nothing"))
    if fails:
        say("does not work here: " + ", ".join(fails))
    for command in report["install"]:
        say(f"install: {command}")
