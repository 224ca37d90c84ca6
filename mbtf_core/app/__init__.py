"""Command lines: options from configurations, output, progress, errors and exit codes."""
