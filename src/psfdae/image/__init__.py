"""An image and its stars: files, catalogues, detection, stamps, stars to learn from."""
