"""Stress tests: where the package breaks, and that it says so.

Every case states beforehand what must come out: a bound that follows from
rounding, counting statistics or optics, or the error that refuses the input.
"""
