"""Tables and figures of papers, made from several runs of one recipe."""
