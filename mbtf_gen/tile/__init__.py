"""Tiles: one period of a material, its shape and its reflectance, whatever it is made of."""
