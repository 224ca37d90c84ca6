"""``mbtf-fit preview``: a contact sheet of a fitted material, without a scene."""
