"""How rays find the surface of a tile: height fields, triangles, fibers."""
