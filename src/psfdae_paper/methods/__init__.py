"""Methods of the paper and of its studies, in addition to the methods of the library."""
