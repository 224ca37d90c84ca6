"""Generate multi-resolution BTF data sets from displaced materials."""
