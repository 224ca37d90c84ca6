"""Materials as shaders, in GLSL and in Slang: one function per operation."""
