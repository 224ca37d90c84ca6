"""The materials of this folder, one module each, and what they share."""
