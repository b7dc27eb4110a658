"""The commands of the `ocufilter` program, one module each.

Heavy libraries are imported inside the functions, so that ``--help`` stays quick.
"""
