"""``python -m filter_service``: the `ocufilter` program."""

import importlib

if __name__ == "__main__":
    # By name, as no module of this package imports the clients.
    importlib.import_module("clients.commands.program").main()
