"""Held-out validation: checks, figures and the report page."""
