"""Sweeps: points of a search space, each trained and tested as models of the main workflow."""
