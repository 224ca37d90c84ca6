"""What all packages share: errors, configuration, console, files, directions, levels, statistics."""
