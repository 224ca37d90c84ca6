"""Effects of light: what each is, when a material has it, and how much bias leaving it out may add."""
