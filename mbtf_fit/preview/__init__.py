"""``mbtf-fit preview``: a contact sheet and a turntable of a fitted material, without a scene."""
