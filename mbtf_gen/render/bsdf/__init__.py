"""How the displaced surface reflects: microfacets, sheen, and the BSDF as a Mitsuba plugin."""
