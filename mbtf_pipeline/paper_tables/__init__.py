"""Tables and figures as the papers have them: one recipe runs several, and measures nothing by itself."""
