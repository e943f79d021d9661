"""Gaussian mixture of training stars: its distribution, fit, densities and posterior."""
