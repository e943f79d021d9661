"""What `snakemake` runs in this folder. Another project takes workflow/Snakefile as a module."""


include: "workflow/Snakefile"


# An included file has no say in this.
workflow.default_target = "all"


# Snakemake takes a mistyped target for a file that no rule makes: the target that is like it.
for word in sys.argv[1:]:
    names = [rule.name for rule in workflow.rules]
    if word.isidentifier() and word not in names and not os.path.exists(word):
        if hint := did_you_mean(word, names):
            print(f"psfdae: no target {word}{hint}", file=sys.stderr)
