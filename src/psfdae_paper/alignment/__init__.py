"""Estimating the misalignment of a secondary mirror from its stamps."""
