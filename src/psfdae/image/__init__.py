"""An image and its stars: files, catalogues, detection, stamps, training stars."""
