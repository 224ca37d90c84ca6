"""What is known of the surface of a displaced tile: intersections, horizons, and prefiltered maps."""
