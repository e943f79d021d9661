"""Commands of the library: each reads files, calls the functions of Python, and writes files."""
