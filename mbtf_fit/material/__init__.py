"""The fitted material: its folder, its evaluation, its exports."""
