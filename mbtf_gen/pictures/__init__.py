"""Reference pictures and previews."""
