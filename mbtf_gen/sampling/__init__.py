"""Random numbers, low-discrepancy points, 7D queries and the light kernel."""
