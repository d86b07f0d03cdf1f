"""Packaged scenes, data only: `p4dgs_ref.load_scene("bouncing")` finds them here."""
