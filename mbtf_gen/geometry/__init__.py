"""The displaced tile: heights on a grid, its triangles, slopes and their statistics."""
