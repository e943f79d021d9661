"""Star images: field points, random aberrations, framing, noise and splits."""
