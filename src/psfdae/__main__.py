"""`python -m psfdae` is the command line."""

from psfdae.cli import main

main(prog_name="psfdae")
