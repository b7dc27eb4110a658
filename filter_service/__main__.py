"""``python -m filter_service``: the `ocufilter` program."""

import importlib

if __name__ == "__main__":
    # By name, because this package must not import the clients.
    importlib.import_module("clients.commands.program").main()
