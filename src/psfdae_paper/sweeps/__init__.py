"""Sweeps: points of a search space, each trained and tested like the main workflow's models."""
