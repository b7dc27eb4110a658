"""``python -m ocufilter``: the command line."""

from clients.commands.program import main

if __name__ == "__main__":
    main()
