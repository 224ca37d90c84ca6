"""Reflection of the displaced surface: microfacets, sheen, and the BSDF as a Mitsuba plugin."""
