"""Training: one fit from start to end, its schedule, its forecast, several fits at once."""
