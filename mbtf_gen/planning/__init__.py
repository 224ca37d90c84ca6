"""What a run simulates and how many paths each query gets."""
