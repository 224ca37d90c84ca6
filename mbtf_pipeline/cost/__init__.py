"""What accuracy costs in time: measured on the user's own material and machine."""
