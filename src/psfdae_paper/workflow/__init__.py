"""Functions for the rules of `workflow/`: files of a run, settings of its jobs, their threads.

`run` has the run of the command line, whose object `Run` all other functions receive. Modules of
the rules' subjects name files: `datasets`, `fits`, `bounds`, `alignment`, `timings`, `sweeps` and
`night`. Every job of a cluster reads all rules at its start, so that none of these modules imports
more than it needs, and settings are composed when a job needs them.
"""
