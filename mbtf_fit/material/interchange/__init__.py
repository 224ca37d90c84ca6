"""Materials as maps for programs that evaluate no networks: glTF, USD, MaterialX."""
