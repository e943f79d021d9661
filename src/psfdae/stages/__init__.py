"""Stages: one step of the science each, from input files to output files."""
