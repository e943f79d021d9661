"""`python -m psfdae` is the command line."""

from psfdae.commands.cli import main

main(prog_name="psfdae")
