"""Configurations: typed sections, YAML files, and nested mappings."""
