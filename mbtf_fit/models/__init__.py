"""Neural material models: textures, networks, encodings, and the three architectures."""
