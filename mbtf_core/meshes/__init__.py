"""Triangle meshes as their files define them."""
