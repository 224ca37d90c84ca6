"""Materials as shaders: a Slang module, the texels that it reads, and other languages by Slang's compiler."""
