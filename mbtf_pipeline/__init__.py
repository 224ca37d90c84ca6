"""Chain generation, fitting, comparison and reports."""
