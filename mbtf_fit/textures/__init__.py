"""Periodic textures in PyTorch: lookups, blur, pyramids of parameters."""
