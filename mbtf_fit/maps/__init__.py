"""Texture maps for other tools: base color, roughness and normals that look like a fitted material."""
