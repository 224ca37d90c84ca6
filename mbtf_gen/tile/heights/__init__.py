"""Height grids: triangles, slopes, statistics."""
