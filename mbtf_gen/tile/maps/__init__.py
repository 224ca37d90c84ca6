"""The maps of a material: recognized, read, checked, made tileable."""
