"""Methods of the paper and of its studies, beside those of the library."""
