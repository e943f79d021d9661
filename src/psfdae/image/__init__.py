"""An image and its stars: files, catalogues, detection, stamps, and which stars can be learnt from."""
