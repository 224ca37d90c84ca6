"""Mitsuba and Dr.Jit: loading them, their types, their memory."""
