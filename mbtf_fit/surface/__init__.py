"""What is known of the surface: heights, horizons, facets, prefiltered maps; lookups in textures."""
