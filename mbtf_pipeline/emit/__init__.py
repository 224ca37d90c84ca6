"""Job files of a recipe, for clusters that run no daemon of their users."""
