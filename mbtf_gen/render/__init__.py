"""Path tracing of the displaced tile in Mitsuba."""
