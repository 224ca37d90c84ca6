"""Previews of a material: its mesh, a path-traced picture, and its queries."""
