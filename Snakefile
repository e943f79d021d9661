"""What `snakemake` runs in this folder. Another project takes workflow/Snakefile as a module."""


include: "workflow/Snakefile"


# An included file has no say in this.
workflow.default_target = "all"


# Snakemake takes a mistyped target for a file that no rule makes. The last line names the target that
# is like it. Words of options, such as mtime, are less like a target than a typing error is.
names = [rule.name for rule in workflow.rules]
for word in sys.argv[1:]:
    if word.isidentifier() and word not in names and not os.path.exists(word):
        for name in get_close_matches(word, names, n=1, cutoff=0.8):
            hint = f"psfdae: no target {word}; did you mean {name}?"
            atexit.register(print, hint, file=sys.stderr)
