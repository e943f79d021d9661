"""Reference pages and drawings made from the code itself: keys, commands, rules, modules."""
