"""Fitted materials: folder, evaluation, transmittance, exports."""
