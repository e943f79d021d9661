"""Foundations of all rooms: refusals, files, settings, random streams, progress, figures."""
