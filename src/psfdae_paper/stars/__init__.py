"""Simulated stars: field points, random aberrations, framing."""
