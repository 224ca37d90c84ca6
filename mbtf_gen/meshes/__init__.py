"""Triangle meshes as tiles: what they are, and the files that hold them."""
