"""Pictures for a first look at a material and at its queries, to be drawn or already stored."""
