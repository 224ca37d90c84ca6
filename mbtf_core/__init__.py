"""What all packages share: errors, configuration, console, files and locks, directions, levels, statistics."""
