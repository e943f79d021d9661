"""Errors of estimates with their uncertainty: tables, comparisons and figures."""
