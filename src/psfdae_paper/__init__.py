"""The reproduction of the paper: simulated telescopes, its methods, tables and figures."""
